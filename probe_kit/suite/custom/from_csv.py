"""Suites from a table of questions: instruction, correct picture, wrong picture, group.

instruction,correct,wrong,group,category
Put the cube on the ripe fruit,banana-3.jpg,banana-1.jpg,banana,ripeness
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from probe_kit._system.table_cells import group_names, problem_of
from probe_kit._system.text_tables import TextTable, open_table
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.suite.card import new_suite
from probe_kit.suite.categories import check_slug
from probe_kit.suite.custom.own_items import Origin, Shown, Terms, check_broken, own_item, shown, statistics_of
from probe_kit.suite.grouping import with_groups
from probe_kit.suite.items import Item, Side
from probe_kit.suite.manifest import check_foreign_folder, save_suite
from probe_kit.suite.pictures import RESTORE
from probe_kit.suite.suite import Suite

COLUMNS = ("instruction", "correct", "wrong")
FURTHER = ("group", "category", "object", "other_object")
DEFAULT_CATEGORY = "questions"
_RULE = "own-table"


@dataclass(frozen=True)
class Row:
    """One line of the table.

    line: its number in the file, from 1. instruction: the imperative. correct, wrong: files, beside the table.
    group: rows of one group are never in training and test at once; empty where pictures alone decide. object:
    what the correct picture is called, part of the instruction. other_object: what the wrong one is called; empty
    for its file's name.
    """

    line: int
    instruction: str
    correct: Path
    wrong: Path
    group: str
    category: str
    object: str
    other_object: str


def suite_from_csv(
    table: Path | str,
    folder: Path | str,
    *,
    name: str | None = None,
    version: str = "1.0.0",
    category: str = DEFAULT_CATEGORY,
    terms: Terms,
) -> Suite:
    """The suite in `folder` that asks what the rows of `table` say; the answer lies left and right in turn.

    Columns `instruction`, `correct` and `wrong` are needed; `group`, `category` (otherwise `category`), `object`
    (otherwise what follows "on the" in the instruction) and `other_object` may be there. name: of the suite; None
    for the table's. Two rows over the same two pictures that ask the other way round are twins.
    Raises UsageError naming the line for a table that cannot be used, and SuiteError for a picture that cannot be
    read, questions that break a rule, or a `folder` that holds anything else. Nothing is written then.
    """
    table, folder = Path(table), Path(folder)
    rows = read_rows(table, category)
    check_foreign_folder(folder)
    name = name or table.stem
    pictures: dict[str, bytes] = {}
    drawn: list[tuple[Row, Shown, Shown]] = []
    for row in rows:
        correct, wrong = (_shown(table, row, column) for column in ("correct", "wrong"))
        pictures |= {correct.file_name: correct.png, wrong.file_name: wrong.png}
        drawn.append((row, correct, wrong))
    items = list(_items(name, version, drawn, terms))
    groups = {item.item_id: row.group for item, row in zip(items, rows, strict=True) if row.group}
    suite = new_suite(name, version, with_groups(items, groups), {"rows": len(rows)})
    lines = {item.item_id: f"{table}, line {row.line}" for item, row in zip(items, rows, strict=True)}
    check_broken(suite, lines)
    return save_suite(suite, pictures, statistics_of(suite), folder)


def _shown(table: Path, row: Row, column: str) -> Shown:
    """A row's picture. Raises SuiteError naming line, column and the folder that was searched."""
    path, phrase = (row.correct, row.object) if column == "correct" else (row.wrong, row.other_object)
    where = f"{table}, line {row.line}, column {column}"
    if not path.is_file():
        written = path.relative_to(table.parent) if path.is_relative_to(table.parent) else path
        raise SuiteError(
            f"{where}: there is no picture {written} in {path.parent.resolve()}. Paths are relative to the table"
        )
    try:
        return shown(path, phrase)
    except SuiteError as error:
        raise SuiteError(f"{where}: {str(error).replace(RESTORE, 'Give another file.')}") from error


def read_rows(table: Path, category: str = DEFAULT_CATEGORY) -> list[Row]:
    """The rows of the table, one per question. Raises UsageError, naming the line that cannot be used."""
    opened = open_table(table, COLUMNS)
    headings = [column for column in opened.names if column]
    missing = [column for column in COLUMNS if column not in headings]
    unknown = [column for column in headings if column not in (*COLUMNS, *FURTHER)]
    if missing or unknown:
        wrong = [f"lacks {', '.join(missing)}"] * bool(missing)
        wrong += [f"has {', '.join(map(repr, unknown))}, which no table has"] * bool(unknown)
        raise UsageError(
            f"{table}, line {opened.line}, {' and '.join(wrong)}; expected {', '.join(COLUMNS)} and, where "
            f"wanted, {', '.join(FURTHER)}"
        )
    rows = [_row(cells, line, opened, category) for line, cells in opened.rows()]
    if not rows:
        raise UsageError(f"{table} has no line below its heading; expected one per question")
    _check_contradictions(rows, table)
    return _with_group_names(rows, opened)


def _check_contradictions(rows: Sequence[Row], table: Path) -> None:
    """Raise UsageError for a question that is asked twice, or with another answer."""
    lines: dict[tuple[str, Path, Path], int] = {}
    for row in rows:
        first = lines.setdefault((row.instruction, row.correct, row.wrong), row.line)
        if first != row.line:
            raise UsageError(f"{table}, lines {first} and {row.line} are the same question. Leave one out")
        opposite = lines.get((row.instruction, row.wrong, row.correct))
        if opposite is not None and row.correct != row.wrong:
            raise UsageError(
                f"{table}, lines {opposite} and {row.line} are the same question with opposite answers. Correct "
                "one, or leave it out"
            )


def _with_group_names(rows: Sequence[Row], opened: TextTable) -> list[Row]:
    """The rows with one spelling of every group, such as 7 for 7.0."""
    grouped = [row for row in rows if row.group]
    names = group_names(
        [row.group for row in grouped], lambda number: opened.where(grouped[number].line, "group"), UsageError
    )
    by_line = {row.line: name for row, name in zip(grouped, names, strict=True)}
    return [replace(row, group=by_line.get(row.line, "")) for row in rows]


def _row(record: Mapping[str, str | None], line: int, opened: TextTable, category: str) -> Row:
    where, table = opened.where(line), opened.path
    cells = {column: cell or "" for column, cell in record.items()}
    empty = [column for column in COLUMNS if not cells[column]]
    if empty:
        columns = f"{'column' if len(empty) == 1 else 'columns'} {' and '.join(empty)}"
        raise UsageError(f"{where}, {columns}: it is empty; every question needs {', '.join(COLUMNS)}")
    for column, cell in cells.items():
        if problem := problem_of(cell):
            raise UsageError(f"{where}, column {column}: {problem}")
    asked = cells.get("object") or _object_of(cells["instruction"])
    if asked is None or asked not in cells["instruction"]:
        raise UsageError(
            f"{where}, column instruction: no target can be parsed from {cells['instruction']!r}. Write it as "
            "'Put the cube on the …', or name the words in a column `object`"
        )
    correct, wrong = (table.parent / cells[column] for column in ("correct", "wrong"))
    other = cells.get("other_object") or f"what {wrong.stem} shows"
    try:
        slug = check_slug(cells.get("category") or category)
    except UsageError as error:
        if not cells.get("category"):
            raise
        raise UsageError(f"{where}, column category: {error}") from error
    return Row(line, cells["instruction"], correct, wrong, cells.get("group", ""), slug, asked, other)


def _object_of(instruction: str) -> str | None:
    """The words behind the first "on" or "onto", without their article."""
    words = instruction.split()
    for number, word in enumerate(words):
        if word.lower() in ("on", "onto"):
            rest = words[number + 1 :]
            return " ".join(rest[1:] if rest and rest[0].lower() in ("the", "a", "an") else rest) or None
    return None


def _items(name: str, version: str, drawn: list[tuple[Row, Shown, Shown]], terms: Terms) -> Iterator[Item]:
    asked = Counter((row.category, frozenset((one.pixels, other.pixels))) for row, one, other in drawn)
    orders = {(row.category, one.pixels, other.pixels) for row, one, other in drawn}
    turns: dict[str, Iterator[int]] = {}
    for row, correct, wrong in drawn:
        twins = (
            asked[row.category, frozenset((correct.pixels, wrong.pixels))] == 2
            and (row.category, wrong.pixels, correct.pixels) in orders
        )
        content = sorted((correct.pixels, wrong.pixels)) + ([] if twins else [row.instruction])
        pair_id = f"{name}-{row.category}-{sha256_json(content)[:12]}"
        side: Side = "right" if next(turns.setdefault(row.category, count())) % 2 else "left"
        if twins:  # the pictures lie where they lay when they were asked the other way round
            side = "left" if correct.pixels < wrong.pixels else "right"
        both = (correct, wrong) if side == "left" else (wrong, correct)
        article = "the" if f"the {row.object}" in row.instruction else "none"
        origin = Origin(name, version, row.category, pair_id, _RULE)
        item_id = f"{pair_id}-{sha256_json([row.instruction, correct.pixels])[:8]}"
        yield own_item(item_id, origin, row.instruction, article, both, side, terms)
