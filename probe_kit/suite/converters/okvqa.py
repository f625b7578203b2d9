"""OK-VQA: photographs with a question about the animal or plant in them, for Living World."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from probe_kit.errors import SuiteError
from probe_kit.suite.converters.candidates import (
    Candidate,
    OkVqaOptions,
    SourceContent,
    SourcePicture,
    by_key,
    field_of,
    first_existing,
    photo,
    read_annotations,
)
from probe_kit.suite.converters.rewriting import rewrite

_SINGLE_WORDS = {
    "dog breed": "labrador poodle beagle collie dachshund bulldog pug terrier husky chihuahua dalmatian corgi "
    "boxer retriever shepherd rottweiler greyhound schnauzer spaniel mastiff",
    "mammal": "dog cat horse sheep cow elephant bear zebra giraffe goat pig deer rabbit squirrel monkey lion "
    "tiger camel donkey llama bison buffalo ox bull moose elk fox wolf kangaroo whale dolphin seal otter hamster "
    "mouse rat leopard cheetah hippo rhino panda",
    "bird": "duck goose swan chicken rooster turkey owl eagle hawk falcon pigeon dove seagull gull parrot "
    "parakeet macaw peacock penguin flamingo heron crane stork ostrich robin sparrow finch cardinal crow raven "
    "hummingbird pelican cockatoo cockatiel canary woodpecker",
    "fish": "shark trout salmon goldfish tuna koi",
    "insect": "butterfly bee ant spider moth dragonfly wasp ladybug",
    "reptile": "snake lizard turtle tortoise crocodile alligator frog iguana",
    "flower": "rose tulip daisy lily sunflower orchid carnation daffodil iris lavender hydrangea chrysanthemum "
    "peony lilac poppy pansy",
    "tree": "palm pine oak maple willow birch cedar spruce elm fir",
    "plant": "cactus fern ivy bamboo grass aloe succulent moss clover",
}
_TWO_WORDS = {
    "dog breed": ("golden retriever", "german shepherd", "border collie"),
    "mammal": ("polar bear", "grizzly bear", "brown bear", "black bear", "sea lion"),
    "tree": ("palm tree", "pine tree", "oak tree"),
}
KIND_OF: dict[str, str] = {
    **{name: kind for kind, words in _SINGLE_WORDS.items() for name in words.split()},
    **{name: kind for kind, names in _TWO_WORDS.items() for name in names},
}
# Answers that COCO's boxes can confirm or rule out, with the name of the box.
COCO_CLASS: dict[str, str] = {
    **{name: name for name in ["cat", "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe"]},
    **dict.fromkeys(("polar bear", "grizzly bear", "brown bear", "black bear"), "bear"),
    **dict.fromkeys(("bull", "ox"), "cow"),
}


def singular(answer: str) -> str:
    """Return the listed noun whose plural an answer is, such as "horses" or "butterflies"; else the answer."""
    for plural, ending in (("ies", "y"), ("ches", "ch"), ("es", ""), ("s", "")):
        if answer not in KIND_OF and answer.endswith(plural) and answer.removesuffix(plural) + ending in KIND_OF:
            return answer.removesuffix(plural) + ending
    return answer


SOURCE = "ok-vqa"
CATEGORIES = ("living-world",)

_PLANTS_AND_ANIMALS = "eight"
_SPLITS = ("train2014", "val2014")
_MOST_WORDS = 2
_NAMES_A_KIND = re.compile(
    r"\b(kind|species|breed|type|name|variety|sort)s?\b.*\b(animal|bird|dog|cat|tree|flower|plant|fish|insect|horse)s?\b"
    r"|^(what|which) (animal|bird|dog|flower|tree|plant)s?\b"
)
_OTHER_MATTER = re.compile(
    r"\b(eat|eats|diet|food|how many|where|live|lives|native|doing|sound|used for|why|when)\b"
)


Boxes = Mapping[int, Mapping[str, float]]
"""The share of a picture's area that the largest box of each COCO class covers, by picture."""


def read(root: Path, categories: Sequence[str], options: OkVqaOptions) -> SourceContent:
    """Read every question of those of the two splits that are present.

    Raises:
        SuiteError: If no split is present, or if one is broken.
    """
    del categories  # there is only one
    reading = SourceContent(
        license="LicenseRef-COCO-Flickr",
        attribution="OK-VQA (Marino et al.) on COCO 2014; each picture under its own Flickr licence",
        url="https://okvqa.allenai.org",
        split="train2014, val2014",
    )
    for split in _SPLITS:
        questions = root / f"OpenEnded_mscoco_{split}_questions.json"
        if questions.is_file():
            _read_split(root, split, questions, options, reading)
    if not reading.files:
        raise SuiteError(
            f"{SOURCE}: no OpenEnded_mscoco_<split>_questions.json in {root} for {' or '.join(_SPLITS)}. "
            "Unpack the questions and the annotations there."
        )
    if options.instances is None:
        reading.notes.append("without COCO instances no pair can show that the answer is absent: all stay pending")
    return reading


def _read_split(root: Path, split: str, questions: Path, options: OkVqaOptions, reading: SourceContent) -> None:
    annotations = root / f"mscoco_{split}_annotations.json"
    texts = _by_question(questions, "questions", "question")
    boxes = _read_boxes(options, split, reading)
    reading.files += [questions, annotations]
    for number, (question_id, record) in enumerate(_by_question(annotations, "annotations", "annotation").items()):
        where = f"annotation {number} of {annotations.name}"
        if str(record.get("question_type")) != _PLANTS_AND_ANIMALS:
            continue
        reading.pool["living-world"] += 1
        if question_id not in texts:
            raise SuiteError(
                f"{SOURCE}: {where}: question {question_id} is not in {questions.name}. Use one release."
            )
        question = field_of(texts[question_id], "question", str, SOURCE, where)
        answer, reason = _answer(record, question, options, where)
        if reason:
            reading.reasons[reason] += 1
            continue
        candidate = _candidate(record, question, answer, split, root, options, boxes, where)
        if isinstance(candidate, str):
            reading.reasons[candidate] += 1
        else:
            reading.candidates.append(candidate)


def _by_question(path: Path, key: str, name: str) -> dict[int, Any]:
    """Return the records of a file by their question, in the file's order.

    Raises:
        SuiteError: For a question with two records.
    """
    value = read_annotations(path, SOURCE, "Unpack the questions and the annotations of the same release.")
    records = enumerate(field_of(value, key, list, SOURCE, path.name))
    places = ((f"{name} {number} of {path.name}", record) for number, record in records)
    entries = ((field_of(record, "question_id", int, SOURCE, where), record, where) for where, record in places)
    return by_key(entries, SOURCE, "question_id")


def _answer(record: Any, question: str, options: OkVqaOptions, where: str) -> tuple[str, str | None]:
    """Return the answer that people agree on, or why there is none."""
    plain = question.lower()
    if not _NAMES_A_KIND.search(plain) or _OTHER_MATTER.search(plain):
        return "", "question asks for something else than a kind"
    answers = field_of(record, "answers", list, SOURCE, where)
    raw = Counter(field_of(entry, "raw_answer", str, SOURCE, where).strip().lower() for entry in answers)
    (modal, votes), *_ = sorted(raw.items(), key=lambda entry: (-entry[1], entry[0])) or [("", 0)]
    modal = re.sub(r"^(a|an|the)\s+", "", modal)
    if not votes or votes / len(answers) < options.min_agreement:
        return "", "people do not agree on the answer"
    if len(modal.split()) > _MOST_WORDS or singular(modal) not in KIND_OF:
        return "", "answer is no listed animal or plant"
    return modal, None


def _candidate(
    record: Any,
    question: str,
    answer: str,
    split: str,
    root: Path,
    options: OkVqaOptions,
    boxes: Boxes | None,
    where: str,
) -> Candidate | str:
    image_id = field_of(record, "image_id", int, SOURCE, where)
    name = f"COCO_{split}_{image_id:012d}.jpg"
    base = options.pictures_below(root)
    tried = [base / split / name, base / name, base / "images" / split / name]
    path = first_existing(tried, SOURCE, where, f"unpack COCO's {split} pictures there, or pass image_root.")
    noun = singular(answer)
    coco = COCO_CLASS.get(noun)
    if boxes and coco:
        share = boxes.get(image_id, {}).get(coco, 0.0)
        if share < options.min_object_share:
            return "object too small or not boxed"
    return Candidate(
        source_id=str(record["question_id"]),
        category="living-world",
        question=question,
        target=SourcePicture(f"coco/{image_id}", photo(path), name),
        answer=answer,
        wording=rewrite(question, answer),
        concept=noun,
        construction="cross_item",
        family=KIND_OF[noun],
        shows=frozenset((boxes or {}).get(image_id, {})) | {noun},
        forbids=frozenset({coco, noun} if coco else {noun}),
        needs_person=boxes is None or coco is None,
    )


def _read_boxes(options: OkVqaOptions, split: str, reading: SourceContent) -> Boxes | None:
    if options.instances is None:
        return None
    path = Path(options.instances) / f"instances_{split}.json"
    value = read_annotations(path, SOURCE, "Pass the folder with COCO's instances files, or leave the option out.")
    reading.files.append(path)
    names = {entry["id"]: entry["name"] for entry in field_of(value, "categories", list, SOURCE, path.name)}
    areas = {
        entry["id"]: entry["width"] * entry["height"]
        for entry in field_of(value, "images", list, SOURCE, path.name)
    }
    largest: dict[int, dict[str, float]] = {}
    for entry in field_of(value, "annotations", list, SOURCE, path.name):
        _, _, width, height = entry["bbox"]
        shares = largest.setdefault(entry["image_id"], {})
        name = names[entry["category_id"]]
        shares[name] = max(shares.get(name, 0.0), width * height / areas[entry["image_id"]])
    return largest
