"""Suites of a user's own questions: from a table with a row per question, or from pairs of pictures.

instruction,correct,wrong,group,category
Put the cube on the ripe fruit,banana-3.jpg,banana-1.jpg,banana,ripeness
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path

from probe_kit._system.table_cells import group_names, problem_of
from probe_kit._system.text_tables import TextTable, open_table
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.suite.categories import check_slug
from probe_kit.suite.items import Item, Side, instruction_for, side_words, with_groups
from probe_kit.suite.manifest import check_foreign_folder, save_suite
from probe_kit.suite.pictures import RESTORE, load_picture
from probe_kit.suite.rules import LOADING_RULES, SIDES, listing, pictures_unchanged
from probe_kit.suite.suite import Picture, Suite, make_item, new_suite, squared_picture

COLUMNS = ("instruction", "correct", "wrong")
FURTHER = ("group", "category", "object", "other_object")
DEFAULT_CATEGORY = "questions"


@dataclass(frozen=True)
class Terms:
    """The terms of use of the pictures; the names are those of an item's fields."""

    license: str
    attribution: str
    redistributable: bool = False
    contains_real_face: bool = False


@dataclass(frozen=True)
class PicturePair:
    """Two pictures that lie side by side, and the name of each.

    Attributes:
        category: One of the paper's or any name of your own, such as `ripe-fruit`. It is the row of a table in
            which the questions are counted.
        phrase: Name of the picture that completes "Put the cube on the …", such as `fox` or `open door`.
        picture: File that Pillow reads; it is padded to a white square of 224 to 512 pixels.
        other_phrase: Name of the other picture, in the same form.
        other_picture: File of the other picture.
    """

    category: str
    phrase: str
    picture: Path
    other_phrase: str
    other_picture: Path


@dataclass(frozen=True)
class QuestionLine:
    """One line of the table.

    Attributes:
        line: Number of the line in the file, from 1.
        instruction: The imperative.
        correct: File of the correct picture; a relative path starts at the table's folder.
        wrong: File of the wrong picture, likewise.
        group: Name of a group; rows of one group are never in training and test at once. Empty where pictures
            alone decide.
        object: Name of the correct picture, part of the instruction.
        other_object: Name of the wrong picture; empty for its name in its twin, or else for its file's name.
    """

    line: int
    instruction: str
    correct: Path
    wrong: Path
    group: str
    category: str
    object: str
    other_object: str


class _Questions:
    def __init__(self, folder: Path, name: str, version: str, rule: str, terms: Terms) -> None:
        check_foreign_folder(folder)
        self._folder, self._name, self._version, self._rule, self._terms = folder, name, version, rule, terms
        self._pictures: dict[str, bytes] = {}
        self.items: list[Item] = []

    def picture(self, path: Path) -> Picture:
        """Return the picture in a file as it is stored.

        Raises:
            SuiteError: If the file is missing or Pillow cannot decode it.
        """
        stored = squared_picture("", load_picture(path))
        self._pictures[stored.file_name] = stored.png
        return replace(stored, image_id=f"{path.name}-{stored.pixels_sha256[:16]}")

    def pair_id(self, category: str, content: Sequence[object]) -> str:
        """Return the id of the twins with this content."""
        return f"{self._name}-{category}-{sha256_json(content)[:12]}"

    def ask(
        self, item_id: str, pair_id: str, category: str, instruction: str, article: str, side: Side,
        correct: tuple[Picture, str], wrong: tuple[Picture, str],
    ) -> None:  # fmt: skip
        """Add a question.

        Args:
            item_id: Id of the item.
            pair_id: Id that the item shares with its twin.
            category: Name of the item's category.
            instruction: The imperative.
            article: Article of the object, as in `instruction_for`.
            side: Side of the correct picture in the original layout.
            correct: The correct picture, and its name.
            wrong: The wrong picture, and its name.
        """
        origin = {"benchmark": self._name, "version": self._version, "split": "eval"}
        item = make_item(
            item_id,
            category,
            side,
            (correct[0], wrong[0]) if side == "left" else (wrong[0], correct[0]),
            construction="native_pair",
            instruction=instruction,
            object_phrase=correct[1],
            object_article=article,
            target_concept=correct[1],
            distractor_concept=wrong[1],
            pair_id=pair_id,
            rule_id=self._rule,
            curation_status="accepted",
            side_word=bool(side_words(correct[1])),
            source={**origin, "source_id": pair_id, "url": ""},
            **asdict(self._terms),
        )
        self.items.append(item)

    def save(
        self, options: Mapping[str, int], groups: Mapping[str, str] | None = None,
        places: Mapping[str, str] | None = None,
    ) -> Suite:  # fmt: skip
        """Write the suite.

        Args:
            options: Number of pairs or rows, for the suite's card.
            groups: By item id, the group that a user gave; None without such groups.
            places: By item id, the line of the table with the question, for messages; None without a table.

        Raises:
            SuiteError: For a broken rule of the format, before anything is written.
        """
        suite = new_suite(self._name, self._version, with_groups(self.items, groups), options)
        findings = [
            replace(finding, where=(places or {}).get(finding.where.removeprefix("item "), finding.where))
            for rule in LOADING_RULES
            if rule is not pictures_unchanged  # no file is written yet
            for finding in rule(suite)
        ]
        if findings:
            raise SuiteError(
                f"these questions break the rules of the format:\n{listing(findings)}\n"
                "Change the phrases or the pictures. Nothing was written"
            )
        stats = {category: {"pool": n, "emitted": n} for category, n in suite.card["counts"].items()}
        return save_suite(suite, self._pictures, stats, self._folder)


def suite_from_pictures(
    folder: Path | str,
    pairs: Sequence[PicturePair],
    *,
    name: str,
    version: str = "1.0.0",
    license: str,  # noqa: A002 -- as the field of an item is called
    attribution: str,
    redistributable: bool = False,
    contains_real_face: bool = False,
) -> Suite:
    """Make a suite in `folder` in which every pair is asked for both ways: neither pictures nor words alone tell.

    The first picture lies left and right in turn. Pairs that share a file share a group, and folds never separate
    them.

    pair = PicturePair("living-world", "fox", Path("fox.jpg"), "hare", Path("hare.jpg"))
    suite = suite_from_pictures("suites/mine", [pair], name="mine", license="CC-BY-4.0", attribution="me")

    Args:
        folder: Folder to write; new or empty, or with this very suite. After an error, nothing is written.
        pairs: Pairs of pictures, each once; the suite asks every pair both ways.
        name: Name of the suite.
        version: Version of the suite, such as `1.0.0`.
        license: SPDX name of a licence, or another text that says what others may do with the pictures.
        attribution: Author to credit for the pictures.
        redistributable: Whether others may pass the pictures on.
        contains_real_face: Whether some pictures show real people.

    Raises:
        UsageError: For no pair, a pair asked twice or an impossible category name.
        SuiteError: For a picture that cannot be read, for questions that break a rule of the format, or if
            `folder` contains anything else.
    """
    if not pairs:
        raise UsageError("no pair of pictures given; expected at least one PicturePair")
    for category in {pair.category for pair in pairs}:
        check_slug(category)
    met: set[frozenset[tuple[str, str]]] = set()
    for pair in pairs:
        both_sides = frozenset({(pair.phrase, str(pair.picture)), (pair.other_phrase, str(pair.other_picture))})
        if both_sides in met:
            raise UsageError(f"{pair} is given twice; every pair is asked both ways by itself. Leave one out")
        met.add(both_sides)
    terms = Terms(license, attribution, redistributable, contains_real_face)
    questions = _Questions(Path(folder), name, version, "own-pictures", terms)
    for number, pair in enumerate(pairs):
        both = [
            (questions.picture(path), phrase)
            for path, phrase in ((pair.picture, pair.phrase), (pair.other_picture, pair.other_phrase))
        ]
        left, right = both if number % 2 == 0 else both[::-1]
        content = sorted((phrase, picture.pixels_sha256) for picture, phrase in both)
        pair_id = questions.pair_id(pair.category, content)
        for side, correct, wrong in zip(SIDES, (left, right), (right, left), strict=True):
            instruction = instruction_for(correct[1], "the")
            questions.ask(f"{pair_id}-{side}", pair_id, pair.category, instruction, "the", side, correct, wrong)
    return questions.save({"pairs": len(pairs)})


def suite_from_csv(
    table: Path | str,
    folder: Path | str,
    *,
    name: str | None = None,
    version: str = "1.0.0",
    category: str = DEFAULT_CATEGORY,
    terms: Terms,
) -> Suite:
    """Make a suite in `folder` of the questions in the rows of `table`; the answer lies left and right in turn.

    Columns `instruction`, `correct` and `wrong` are needed. Optional columns are `group`, `category` (otherwise
    the argument `category`), `object` (otherwise the words after "on the" in the instruction) and `other_object`.

    Two rows over the same two pictures that ask the other way round are twins.

    Args:
        table: CSV file with a row per question; paths of pictures are relative to it.
        folder: Folder to write; new or empty, or with this very suite. After an error, nothing is written.
        name: Name of the suite; None for the table's file name.
        version: Version of the suite, such as `1.0.0`.
        category: Category of rows that name none.
        terms: Terms of use of the pictures.

    Raises:
        UsageError: For a table that cannot be used; the message names the line.
        SuiteError: For a picture that cannot be read, questions that break a rule, or a `folder` that contains
            anything else.
    """
    table = Path(table)
    rows = read_rows(table, category)
    questions = _Questions(Path(folder), name or table.stem, version, "own-table", terms)
    drawn = [
        (row, _picture(questions, table, row, "correct"), _picture(questions, table, row, "wrong")) for row in rows
    ]
    _ask_rows(questions, drawn)
    ids = [item.item_id for item in questions.items]
    groups = {item_id: row.group for item_id, row in zip(ids, rows, strict=True) if row.group}
    lines = {item_id: f"{table}, line {row.line}" for item_id, row in zip(ids, rows, strict=True)}
    return questions.save({"rows": len(rows)}, groups, lines)


def _ask_rows(questions: _Questions, drawn: Sequence[tuple[QuestionLine, Picture, Picture]]) -> None:
    pixels = [(row.category, correct.pixels_sha256, wrong.pixels_sha256) for row, correct, wrong in drawn]
    together = Counter((category, frozenset(both)) for category, *both in pixels)
    phrases = {key: row.object for (row, *_), key in zip(drawn, pixels, strict=True)}
    turns = dict[str, Iterator[int]]()
    for (row, correct, wrong), (category, right_pixels, wrong_pixels) in zip(drawn, pixels, strict=True):
        twins = (
            together[category, frozenset((right_pixels, wrong_pixels))] == 2
            and (category, wrong_pixels, right_pixels) in phrases
        )
        # A picture has one name in both questions, so that labels of its concept are the same in both.
        other = phrases[category, wrong_pixels, right_pixels] if twins else f"what {row.wrong.stem} shows"
        content = sorted((right_pixels, wrong_pixels)) + ([] if twins else [row.instruction])
        pair_id = questions.pair_id(category, content)
        side: Side = "right" if next(turns.setdefault(category, count())) % 2 else "left"
        if twins:  # the pictures lie where they lay when they were asked the other way round
            side = "left" if right_pixels < wrong_pixels else "right"
        article = "the" if f"the {row.object}" in row.instruction else "none"
        item_id = f"{pair_id}-{sha256_json([row.instruction, right_pixels])[:8]}"
        questions.ask(
            item_id, pair_id, category, row.instruction, article, side, (correct, row.object),
            (wrong, row.other_object or other),
        )  # fmt: skip


def _picture(questions: _Questions, table: Path, row: QuestionLine, column: str) -> Picture:
    """Return the picture in one column of a row.

    Raises:
        SuiteError: If it cannot be read; the message names the line, the column and the folder that was searched.
    """
    path = row.correct if column == "correct" else row.wrong
    where = f"{table}, line {row.line}, column {column}"
    if not path.is_file():
        written = path.relative_to(table.parent) if path.is_relative_to(table.parent) else path
        raise SuiteError(
            f"{where}: there is no picture {written} in {path.parent.resolve()}. Paths are relative to the table"
        )
    try:
        return questions.picture(path)
    except SuiteError as error:
        raise SuiteError(f"{where}: {str(error).replace(RESTORE, 'Give another file.')}") from error


def read_rows(table: Path, category: str = DEFAULT_CATEGORY) -> list[QuestionLine]:
    """Read the rows of the table, one per question.

    Raises:
        UsageError: For a line that cannot be used; the message names it.
    """
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
    grouped = [row for row in rows if row.group]
    names = group_names(  # accents are composed, and two spellings of one group refused
        [row.group for row in grouped], lambda number: opened.where(grouped[number].line, "group"), UsageError
    )
    by_line = {row.line: name for row, name in zip(grouped, names, strict=True)}
    return [replace(row, group=by_line.get(row.line, "")) for row in rows]


def _check_contradictions(rows: Sequence[QuestionLine], table: Path) -> None:
    """Refuse a question that is asked twice, or with another answer.

    Raises:
        UsageError: For a question that comes twice, with the same answer or the opposite one.
    """
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


def _row(record: Mapping[str, str | None], line: int, opened: TextTable, category: str) -> QuestionLine:
    where, table = opened.where(line), opened.path
    cells = {column: cell or "" for column, cell in record.items()}
    empty = [column for column in COLUMNS if not cells[column]]
    if empty:
        columns = f"{'column' if len(empty) == 1 else 'columns'} {' and '.join(empty)}"
        raise UsageError(f"{where}, {columns}: it is empty; every question needs {', '.join(COLUMNS)}")
    for column, cell in cells.items():
        if problem := problem_of(cell):
            raise UsageError(f"{where}, column {column}: {problem}")
    phrase = cells.get("object") or _object_of(cells["instruction"])
    if phrase is None or phrase not in cells["instruction"]:
        raise UsageError(
            f"{where}, column instruction: no target can be parsed from {cells['instruction']!r}. Write it as "
            "'Put the cube on the …', or name the words in a column `object`"
        )
    correct, wrong = (table.parent / cells[column] for column in ("correct", "wrong"))
    other = cells.get("other_object") or ""
    try:
        slug = check_slug(cells.get("category") or category)
    except UsageError as error:
        if not cells.get("category"):
            raise
        raise UsageError(f"{where}, column category: {error}") from error
    return QuestionLine(line, cells["instruction"], correct, wrong, cells.get("group", ""), slug, phrase, other)


def _object_of(instruction: str) -> str | None:
    """Return the words behind the first "on" or "onto", without their article."""
    words = instruction.split()
    for number, word in enumerate(words):
        if word.lower() in ("on", "onto"):
            phrase = words[number + 1 :]
            return " ".join(phrase[1:] if phrase and phrase[0].lower() in ("the", "a", "an") else phrase) or None
    return None
