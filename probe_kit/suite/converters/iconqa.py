"""IconQA: pictures to choose from, and pictures to count in, for Shape, Symmetry, Counting and Time."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from probe_kit._system.table_cells import is_count
from probe_kit.errors import SuiteError
from probe_kit.hashing import derive_seed
from probe_kit.suite.converters.candidates import (
    Candidate,
    IconQaOptions,
    SourceContent,
    SourcePicture,
    Wording,
    by_key,
    field_of,
    first_existing,
    read_annotations,
    trimmed_art,
)
from probe_kit.suite.pictures import decode_picture, pixels_sha256

SOURCE = "iconqa"
CATEGORIES = ("shape", "symmetry", "counting", "time")

_REMEDY = "check that iconqa_data.zip is unpacked completely."
_SUB_TASKS = ("choose_img", "choose_txt", "fill_in_blank")
_SUB_TASK_SIZES = {"choose_img": 57_672, "choose_txt": 31_578, "fill_in_blank": 18_189}
_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_DEICTIC = re.compile(
    r"\b(this|these|that|those|above|below|shown|same|match|matches|next|missing|pattern|what comes|the picture)\b"
)
_SHAPES = re.compile(
    r"\b(circle|oval|triangle|square|rectangle|trapezoid|parallelogram|rhombus|diamond|pentagon|hexagon|octagon|"
    r"sphere|cube|cone|cylinder|pyramid|prism)s?\b"
)
_SYMMETRY = re.compile(r"symmetr|mirror")
_CLOCK = re.compile(r"clock|o'clock|half past|quarter|\d{1,2}:\d\d")
_DIGITAL = re.compile(r"\bdigital\b|\b[ap]\.?m\.?\b")
_NUMBER = re.compile(rf"\d|\b({'|'.join(_NUMBERS)}|ten)\b")
_HOW_MANY = re.compile(
    r"how many (?P<things>[a-z][a-z -]*?)(?: are there| are in (?:the|this) picture| (?:do|can) you see)?$"
)


def read(root: Path, categories: Sequence[str], options: IconQaOptions) -> SourceContent:
    """Read every self-contained problem of the requested categories.

    Raises:
        SuiteError: For a tree that is not IconQA's.
    """
    base = root / "iconqa_data" if (root / "iconqa_data").is_dir() else root
    reading = SourceContent(
        license="LicenseRef-CC-BY-NC-SA-4.0",
        attribution="IconQA (Lu et al.), CC BY-NC-SA 4.0",
        url="https://github.com/lupantech/IconQA",
    )
    problems = _mapping(base / "problems.json", reading)
    splits = _mapping(base / "pid_splits.json", reading)
    skills = _mapping(base / "pid2skills.json", reading)
    home = by_key(
        ((pid, name, name) for name, pids in sorted(splits.items()) if _is_home(name) for pid in pids),
        SOURCE,
        "pid",
    )
    for name, expected in _SUB_TASK_SIZES.items():
        count = sum(problem.get("ques_type") == name for problem in problems.values() if isinstance(problem, dict))
        if count != expected:
            reading.notes.append(f"{name} has {count} problems; the published release has {expected}")
    for pid in sorted(problems, key=str):
        problem, where = problems[pid], f"problem {pid} of problems.json"
        category = _category_of(problem, skills.get(pid, []), where)
        if category is None or category not in categories:
            continue
        reading.pool[category] += 1
        reason = _reason_against(problem, category)
        if reason is None and pid not in home:
            reason = "problem is in no split"
        if reason:
            reading.reasons[reason] += 1
            continue
        folder = _problem_folder(base, home[pid], str(pid))
        reading.candidates += _candidates(problem, category, str(pid), folder, where, options, reading)
    return reading


def _mapping(path: Path, reading: SourceContent) -> dict[str, Any]:
    value: dict[str, Any] = read_annotations(
        path, SOURCE, f"Name the folder that holds problems.json, and {_REMEDY}"
    )
    reading.files.append(path)
    return value


def _is_home(split: str) -> bool:
    """Whether a split names a folder, such as `choose_img_train`; `mini…` and `…trainval` repeat others."""
    return split.rpartition("_")[0] in _SUB_TASKS and split.endswith(("_train", "_val", "_test"))


def _category_of(problem: Any, skills: Sequence[str], where: str) -> str | None:
    question = field_of(problem, "question", str, SOURCE, where).lower()
    if _SYMMETRY.search(question) or _SYMMETRY.search(str(problem.get("label", "")).lower()):
        return "symmetry"
    if "geometry" in skills and _SHAPES.search(question) and "which" in question:
        return "shape"
    if "time" in skills and _CLOCK.search(question):
        return "time"
    if "counting" in skills and (_NUMBER.search(question) or "how many" in question):
        return "counting"
    return None


def _reason_against(problem: Any, category: str) -> str | None:
    question = problem["question"].lower()
    kind = problem.get("ques_type")
    if kind != "choose_img":
        if category == "counting" and _HOW_MANY.search(_plain(question)):
            return None
        return f"{kind} has no pictures to choose from"
    if category == "shape" and "same shape as" in question:
        return "question refers to the stem"
    if category == "time" and _DIGITAL.search(question):
        return "digital clock or half of the day"
    return None


def _plain(question: str) -> str:
    return re.sub(r"\s+", " ", question).strip().rstrip("?.").strip().lower()


def _problem_folder(base: Path, split: str, pid: str) -> Path:
    """Return the folder of a problem: with the inner `iconqa/` of the newer archive, or without."""
    task, _, part = split.rpartition("_")
    inner = base / "iconqa" / part / task / pid
    return inner if inner.is_dir() else base / part / task / pid


def _candidates(
    problem: Any, category: str, pid: str, folder: Path, where: str, options: IconQaOptions, reading: SourceContent
) -> Iterator[Candidate]:
    if problem["ques_type"] != "choose_img":
        yield from _counted_stem(problem, pid, folder, where, options, reading)
        return
    choices = field_of(problem, "choices", list, SOURCE, where)
    answer = field_of(problem, "answer", int, SOURCE, where)
    if not 0 <= answer < len(choices):
        raise SuiteError(
            f"{SOURCE}: {where}: answer {answer} of {len(choices)} choices; expected a 0-based index. "
            "Check that problems.json belongs to this release."
        )
    pictures = [_picture(folder / str(name), f"{pid}/{name}", where) for name in choices]
    if _DEICTIC.search(problem["question"].lower()) and not _stem_is_idle(folder / "image.png", pictures):
        reading.reasons["question refers to the stem"] += 1
        return
    wrong = [picture for number, picture in enumerate(pictures) if number != answer]
    if not options.all_distractors:
        wrong = [wrong[derive_seed(SOURCE, pid) % len(wrong)]]
    for number, distractor in enumerate(wrong):
        source_id = f"{pid}/{number}" if options.all_distractors else pid
        yield Candidate(
            source_id,
            category,
            problem["question"],
            pictures[answer],
            distractor,
            construction="choice_vs_distractor",
        )


def _stem_is_idle(stem: Path, pictures: Sequence[SourcePicture]) -> bool:
    """Whether nothing is lost without the question's own picture: it is absent, blank, or one of the choices."""
    if not stem.is_file():
        return True
    image = decode_picture(stem)
    if image.convert("L").getextrema()[0] == image.convert("L").getextrema()[1]:
        return True
    trimmed = pixels_sha256(trimmed_art(stem))
    return any(pixels_sha256(picture.load()) == trimmed for picture in pictures)


def _counted_stem(
    problem: Any, pid: str, folder: Path, where: str, options: IconQaOptions, reading: SourceContent
) -> Iterator[Candidate]:
    """Yield the candidate of a picture that shows a known number of known things; pairs are made of two such."""
    match = _HOW_MANY.search(_plain(problem["question"]))
    count = _count_of(problem, where)
    if match is None or not options.cross_items or count is None:
        reading.reasons["no number from one to nine to ask for"] += 1
        return
    plural = match["things"].strip()
    word = _NUMBERS[count - 1]
    noun = _singular(plural) if count == 1 else plural
    yield Candidate(
        pid,
        "counting",
        problem["question"],
        _picture(folder / "image.png", f"{pid}/image.png", where),
        answer=word,
        wording=Wording(f"picture with {word} {noun}", "count"),
        concept=f"{word} {plural}",
        construction="cross_item",
        family=plural,
    )


def _count_of(problem: Any, where: str) -> int | None:
    answer: Any = problem.get("answer")
    if problem["ques_type"] == "choose_txt":
        choices = field_of(problem, "choices", list, SOURCE, where)
        index = field_of(problem, "answer", int, SOURCE, where)
        answer = choices[index] if 0 <= index < len(choices) else None
    text = str(answer).strip().lower()
    if text in _NUMBERS:
        return _NUMBERS.index(text) + 1
    return int(text) if is_count(text) and 1 <= int(text) <= 9 else None


def _singular(noun: str) -> str:
    endings = {"ies": "y", "ches": "ch", "shes": "sh", "xes": "x", "sses": "ss", "s": ""}
    for plural, singular in endings.items():
        if noun.endswith(plural):
            return noun.removesuffix(plural) + singular
    return noun


def _picture(path: Path, name: str, where: str) -> SourcePicture:
    first_existing([path], SOURCE, where, _REMEDY)
    return SourcePicture(
        image_id=f"{SOURCE}/{name}",
        load=lambda: trimmed_art(path),
        original=name,
        operation="flattened on white, trimmed, padded to a square with 8 % margin",
    )
