"""MLLM-CompBench: two pictures and a question that compares them, for Emotion, Attribute and State."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from probe_kit.errors import SuiteError
from probe_kit.suite.converters.candidates import (
    Candidate,
    CompBenchOptions,
    SourceContent,
    SourcePicture,
    field_of,
    first_existing,
    photo,
    read_annotations,
)

SOURCE = "mllm-compbench"
CATEGORIES = ("emotion", "attribute", "state")

# Folder, file stem, prefixes the authors put before a picture's path, and the category if the record's type
# does not decide it.
_SETS: tuple[tuple[str, str, tuple[str, ...], str | None], ...] = (
    ("celebA_label", "celebA_0_141_rebalanced", (), "emotion"),
    ("fer2013_label", "fer2013_0_720_rebalanced", (), "emotion"),
    ("st_label", "State_Transform_merged0_0_1000", ("transformed_states",), None),
    ("vaw_label", "VAW_0_3133", ("vaw",), None),
    ("fashion_label", "fashion_0_179", ("fashionpedia",), "attribute"),
    ("cub_label", "CUB_0_1000_rebalanced_fixed_path", ("cub_200_2011",), "attribute"),
    ("Wildfish_label", "wildfish_0_60_500sample_rebalanced", (), "attribute"),
)
_FACES = ("celebA_label", "fer2013_label")
_REMEDY = "pass image_root (--image-root) or check that the processed archive is unpacked."


def read(root: Path, categories: Sequence[str], options: CompBenchOptions) -> SourceContent:
    """Read every comparison of the sets that are present.

    Raises:
        SuiteError: If no set is present, or if one is broken.
    """
    reading = SourceContent(
        license="LicenseRef-MLLM-CompBench-pictures",
        attribution="MLLM-CompBench (questions CC-BY-4.0; pictures under the terms of their own sets)",
        url="https://github.com/RaptorMai/MLLM-CompBench",
    )
    labels = root / "Labeled_data" if (root / "Labeled_data").is_dir() else root
    for folder, stem, prefixes, category in _SETS:
        if category and category not in categories:
            continue
        if folder == "fer2013_label" and not options.fer:
            reading.notes.append("FER-2013 left out by option fer")
            continue
        base = options.pictures_below(root)
        homes = [base / inner / prefix for inner in ("", "dataset") for prefix in ("", *prefixes)]
        for path in _annotation_files(labels / folder, stem):
            reading.files.append(path)
            _read_file(path, folder, homes, category, categories, options, reading)
    if not reading.files:
        raise SuiteError(
            f"{SOURCE}: no annotation file found below {labels}; looked for "
            f"{', '.join(f'{folder}/{stem}.json' for folder, stem, _, _ in _SETS)}. "
            "Unpack the archive `Annotations` there, or name the folder that holds it."
        )
    return reading


def _annotation_files(folder: Path, stem: str) -> list[Path]:
    """Return the whole file if present, else its parts; never both, as they have the same records."""
    if (folder / f"{stem}.json").is_file():
        return [folder / f"{stem}.json"]
    parts = [folder / f"{stem}{part}.json" for part in ("_test", "_val")]
    if not any(part.is_file() for part in parts):
        parts = [p for kind in ("_att", "_state") for p in sorted(folder.glob(f"{stem}{kind}*.json"))]
    return [part for part in parts if part.is_file()]


def _read_file(
    path: Path,
    folder: str,
    homes: Sequence[Path],
    category: str | None,
    categories: Sequence[str],
    options: CompBenchOptions,
    reading: SourceContent,
) -> None:
    records = read_annotations(path, SOURCE, "Unpack the archive `Annotations` again.", list)
    for number, record in enumerate(records):
        if record == {}:
            reading.reasons["empty record"] += 1
            continue
        where = f"record {number} of {path.name}"
        is_state = category is None and field_of(record, "type", str, SOURCE, where) == "State"
        slug = category or ("state" if is_state else "attribute")
        if slug not in categories:
            continue
        reading.pool[slug] += 1
        answer = field_of(record, "answer", str, SOURCE, where)
        if answer not in ("Left", "Right"):
            reading.reasons[f"answer is {answer!r}, not Left or Right"] += 1
            continue
        pictures = list(_pictures(record, where, folder, homes, options))
        target, distractor = pictures if answer == "Left" else pictures[::-1]
        question = field_of(record, "question", str, SOURCE, where)
        source_id = f"{folder}/{path.stem}/{number:05d}"
        reading.candidates.append(Candidate(source_id, slug, question, target, distractor))


def _pictures(
    record: Any, where: str, folder: str, homes: Sequence[Path], options: CompBenchOptions
) -> Iterator[SourcePicture]:
    for key in ("image_1", "image_2"):
        name = field_of(record, key, str, SOURCE, where).replace("\\", "/").lstrip("/")
        yield SourcePicture(
            image_id=f"{SOURCE}/{name}",
            load=photo(first_existing([home / name for home in homes], SOURCE, where, _REMEDY)),
            original=name,
            least_side=options.fer_min_side if folder == "fer2013_label" else None,
            real_face=folder in _FACES,
        )
