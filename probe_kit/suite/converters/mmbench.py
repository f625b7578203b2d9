"""MMBench: named people, for Celebrity. It shows real faces, so it is converted only on request."""

import base64
import binascii
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from PIL import Image

from probe_kit._system.table_cells import is_count, number_of
from probe_kit._system.text_tables import open_table
from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite.converters.candidates import Candidate, MmbenchOptions, SourceContent, SourcePicture
from probe_kit.suite.converters.rewriting import rewrite
from probe_kit.suite.pictures import decode_bytes

SOURCE = "mmbench"
CATEGORIES = ("celebrity",)

_FILES = ("MMBench_DEV_EN.tsv", "MMBench_DEV_EN_V11.tsv", "MMBench_DEV_EN_legacy.tsv")
_CATEGORY = "celebrity_recognition"
_CIRCULAR_STEP = 1_000_000
_LONGEST_REFERENCE = 64  # a shorter picture cell is the index of the row that holds the picture
_COLUMNS = ("index", "question", "A", "B", "answer", "category", "image")
_FURTHER = ("C", "D")
_MOST_CHARACTERS = (1 << 31) - 1  # a picture is one cell

Row = Mapping[str, str]


def read(root: Path, categories: Sequence[str], options: MmbenchOptions) -> SourceContent:
    """Read every identity question.

    Raises:
        UsageError: Unless real faces are requested.
        SuiteError: For a broken file.
    """
    del categories  # there is only one
    if not options.include_real_faces:
        raise UsageError(
            f"{SOURCE}: Celebrity shows real people, and was not asked for. Pass include_real_faces "
            "(--include-real-faces) if you may use these pictures; they stay in your folder."
        )
    path = _file(root)
    rows = _read_rows(path)
    reading = SourceContent(
        license="LicenseRef-MMBench-pictures",
        attribution="MMBench (questions CC-BY-4.0; rights in the pictures are not stated)",
        url="https://github.com/open-compass/MMBench",
        split="dev",
        files=[path],
    )
    for index, row in sorted(rows.items(), key=lambda entry: entry[0]):
        if row["category"] != _CATEGORY:
            continue
        reading.pool["celebrity"] += 1
        if index >= _CIRCULAR_STEP:
            reading.reasons["circular copy"] += 1
            continue
        candidate = _candidate(index, row, rows, path, reading)
        if candidate:
            reading.candidates.append(candidate)
    if not reading.pool["celebrity"]:
        raise SuiteError(
            f"{SOURCE}: {path} has 0 rows of category {_CATEGORY} among {len(rows)}. "
            "Name the folder that holds the whole MMBench_DEV_EN.tsv."
        )
    return reading


def _file(root: Path) -> Path:
    if root.is_file():
        return root
    for name in _FILES:
        if (root / name).is_file():
            return root / name
    if list(root.glob("MMBench_TEST*.tsv")):
        raise SuiteError(
            f"{SOURCE}: {root} holds only a TEST file, whose answers are not published. Use {_FILES[0]}."
        )
    raise SuiteError(f"{SOURCE}: no {' or '.join(_FILES)} in {root}. Name the file or its folder.")


def _read_rows(path: Path) -> dict[int, Row]:
    """Read the rows by their index.

    Raises:
        SuiteError: For a row that is cut off or has no index of its own; the message names its line.
    """
    table = open_table(path, _COLUMNS, SuiteError, most_characters=_MOST_CHARACTERS)
    missing = [name for name in _COLUMNS if name not in table.names]
    if missing:
        raise SuiteError(
            f"{SOURCE}: {path} lacks {', '.join(missing)}; it has {', '.join(table.names)}. "
            "Use the published TSV, tab separated, with its header."
        )
    rows: dict[int, Row] = {}
    lines: dict[int, int] = {}
    for line, cells in table.rows([name for name in (*_COLUMNS, *_FURTHER) if name in table.names]):
        row = {name: cell or "" for name, cell in cells.items()}
        index = number_of(row["index"])
        if index is None or not float(index).is_integer():
            raise SuiteError(f"{SOURCE}: {table.where(line)}: index is {row['index']!r}; expected a number.")
        if (first := lines.setdefault(int(index), line)) != line:
            raise SuiteError(
                f"{SOURCE}: {table.where(line)}: the index {int(index)} is that of line {first} too; expected one "
                "row per index. Download the file again."
            )
        rows[int(index)] = row
    return rows


def _candidate(
    index: int, row: Row, rows: Mapping[int, Row], path: Path, reading: SourceContent
) -> Candidate | None:
    where = f"row with index {index} of {path.name}"
    answer = row["answer"]
    if not answer:
        raise SuiteError(f"{SOURCE}: {where}: no answer. TEST files are scored on a server; use {_FILES[0]}.")
    name = row.get(answer, "")
    if answer not in "ABCD" or not name:
        raise SuiteError(
            f"{SOURCE}: {where}: answer is {answer!r}, which is not an option. Download the file again."
        )
    wording = rewrite(row["question"], name, options_are_names=True)
    if wording is None or wording.rule_id != "R10":
        reading.reasons["not an identity question"] += 1
        return None
    holder, encoded = _picture_cell(index, rows, where)
    picture = SourcePicture(
        image_id=f"{SOURCE}/{holder}",
        load=partial(_decode, encoded, where),
        original=f"row {holder}",
        real_face=True,
    )
    concept = re.sub(r"\s+", " ", name).casefold()
    return Candidate(
        str(index),
        "celebrity",
        row["question"],
        picture,
        answer=name,
        wording=wording,
        concept=concept,
        construction="cross_item",
    )


def _picture_cell(index: int, rows: Mapping[int, Row], where: str) -> tuple[int, str]:
    """Return the row that contains the picture, and the picture as base64; references may point to references."""
    holder, visited = index, set()
    while len(rows[holder]["image"].strip()) <= _LONGEST_REFERENCE:
        visited.add(holder)
        reference = rows[holder]["image"].strip()
        if not is_count(reference) or int(reference) not in rows or int(reference) in visited:
            raise SuiteError(
                f"{SOURCE}: {where}: its picture is in row {reference!r}, which holds none. Use the whole file."
            )
        holder = int(reference)
    return holder, rows[holder]["image"]


def _decode(encoded: str, where: str) -> Image.Image:
    name = f"{SOURCE}: {where}, image:"
    try:
        content = base64.b64decode("".join(encoded.split()), validate=True)
    except binascii.Error as problem:
        raise SuiteError(f"{name} not base64 ({problem}). Download it again.") from problem
    return decode_bytes(content, name, remedy="Download it again.")
