"""OK-VQA: photographs with a question about the animal or plant in them, for Living World."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit.errors import SuiteError
from probe_kit.suite.converters.benchmarks.living_nouns import COCO_CLASS, KIND_OF, singular
from probe_kit.suite.converters.candidates import Candidate, Reading, SourcePicture
from probe_kit.suite.converters.files import by_key, field_of, first_existing, photo, read_json
from probe_kit.suite.converters.options import OkVqaOptions
from probe_kit.suite.converters.rewriting import rewrite

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


@dataclass(frozen=True)
class _Boxes:
    """Per picture, the share of its area that the largest box of each COCO class covers."""

    largest: Mapping[int, Mapping[str, float]]

    def classes(self, image_id: int) -> frozenset[str]:
        return frozenset(self.largest.get(image_id, {}))


def read(root: Path, categories: Sequence[str], options: OkVqaOptions) -> Reading:
    """Every question of the two splits that are present. Raises SuiteError if neither is, or for a broken one."""
    del categories  # there is only one
    reading = Reading(
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


def _read_split(root: Path, split: str, questions: Path, options: OkVqaOptions, reading: Reading) -> None:
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
    """The records of a file by their question, in its order. Raises SuiteError for a question with two."""
    places = ((f"{name} {number} of {path.name}", record) for number, record in enumerate(_records(path, key)))
    entries = ((field_of(record, "question_id", int, SOURCE, where), record, where) for where, record in places)
    return by_key(entries, SOURCE, "question_id")


def _records(path: Path, key: str) -> list[Any]:
    value = read_json(path, SOURCE, "Unpack the questions and the annotations of the same release.")
    records: list[Any] = field_of(value, key, list, SOURCE, path.name)
    return records


def _answer(record: Any, question: str, options: OkVqaOptions, where: str) -> tuple[str, str | None]:
    """The answer people agree on, or why there is none to ask for."""
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
    boxes: _Boxes | None,
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
        share = boxes.largest.get(image_id, {}).get(coco, 0.0)
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
        shows=(boxes.classes(image_id) if boxes else frozenset()) | {noun},
        forbids=frozenset({coco, noun} if coco else {noun}),
        needs_person=boxes is None or coco is None,
    )


def _read_boxes(options: OkVqaOptions, split: str, reading: Reading) -> _Boxes | None:
    if options.instances is None:
        return None
    path = Path(options.instances) / f"instances_{split}.json"
    value = read_json(path, SOURCE, "Pass the folder with COCO's instances files, or leave the option out.")
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
    return _Boxes(largest)
