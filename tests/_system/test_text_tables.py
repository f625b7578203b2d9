"""Tables that people edit: labels, questions and reviews are read by one reader with one set of rules."""

import ast
import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from probe_kit._system.table_cells import DOUBTFUL, MISSING, group_names, plain_cell, truth_of
from probe_kit._system.text_tables import open_table
from probe_kit.errors import ProbeKitError, SuiteError, UsageError
from probe_kit.suite.converters import mmbench
from probe_kit.suite.converters.candidates import MmbenchOptions
from probe_kit.suite.converters.curation import read_curation
from probe_kit.suite.own_questions import read_rows
from probe_kit.train import Target
from tests.support.parsed import package_nodes
from tests.support.slow_cases import slow_but

ROOT = Path(__file__).parents[2]
Rows = Sequence[Sequence[str]]


def labels(file: Path) -> list[str]:
    read = Target.read(file, "tone")
    return [read.coded.classes[int(code)] for code in read.coded.values]


def questions(file: Path) -> list[str]:
    return [row.instruction for row in read_rows(file)]


def reviews(file: Path) -> list[str]:
    return [row["instruction"] for row in read_curation(file)]


def mmbench_names(file: Path) -> list[str]:
    read = mmbench.read(file, (), MmbenchOptions(include_real_faces=True))
    return [str(candidate.answer) for candidate in read.candidates]


READERS: dict[str, tuple[Callable[[Path], list[str]], list[str], Callable[[int, str], list[str]]]] = {
    "labels": (labels, ["episode_id", "tone"], lambda number, text: [f"e{number}", text]),
    "questions": (
        questions,
        ["instruction", "correct", "wrong", "object"],
        lambda number, text: [text, f"{number}.png", "other.png", text.split()[0]],
    ),
    "reviews": (
        reviews,
        ["candidate_id", "question_sha256", "status", "instruction"],
        lambda number, text: [f"c{number}", "0" * 64, "edited", text],
    ),
    "mmbench": (
        mmbench_names,
        ["index", "question", "A", "B", "C", "D", "answer", "category", "image"],
        lambda number, text: [str(number), "Who is this person?", text, "x", "y", "z", "A", KNOWN, "A" * 80],
    ),
}
KNOWN = "celebrity_recognition"
TEXTS = ["warm, thé", 'cold; "ice"', "grey"]

every_reader = pytest.mark.parametrize("reader", READERS)


def lines(rows: Rows, separator: str = ",", end: str = "\n") -> str:
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=separator, lineterminator=end, quoting=csv.QUOTE_ALL).writerows(rows)
    return text.getvalue()


def rows_of(reader: str, texts: Sequence[str]) -> list[list[str]]:
    _, heading, row = READERS[reader]
    return [heading, *(row(number, text) for number, text in enumerate(texts))]


def read(reader: str, content: bytes, folder: Path, ending: str = "csv") -> list[str]:
    file = folder / f"table.{ending}"
    file.write_bytes(content)
    return READERS[reader][0](file)


def refusal(reader: str, content: bytes, folder: Path) -> str:
    with pytest.raises(ProbeKitError) as refused:
        read(reader, content, folder)
    assert isinstance(refused.value, SuiteError if reader in ("reviews", "mmbench") else UsageError)
    return str(refused.value)


@pytest.mark.parametrize("reader", slow_but(["labels"], READERS))  # all read by one function, see below
@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le with mark", "utf-16-be with mark"]
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_each_reader_reads_each_encoding_separator_and_line_end(
    reader: str, separator: str, encoding: str, end: str, tmp_path: Path
) -> None:
    text = lines(rows_of(reader, TEXTS), separator, end)
    codec = encoding.removesuffix(" with mark")
    content = (("\ufeff" if codec != encoding else "") + text).encode(codec)
    assert read(reader, content, tmp_path) == TEXTS


@every_reader
@pytest.mark.parametrize(("declaration", "separator"), [("sep=;", ";"), ('"sep=,"', ","), ("SEP=\t", "\t")])
def test_a_first_line_as_excel_writes_it_declares_the_separator(
    reader: str, declaration: str, separator: str, tmp_path: Path
) -> None:
    text = f"{declaration}\r\n" + lines(rows_of(reader, TEXTS), separator, "\r\n")
    assert read(reader, text.encode(), tmp_path) == TEXTS
    cut = text.removesuffix("\r\n").rsplit(separator, 1)[0]
    assert ", line 5 has" in refusal(reader, cut.encode(), tmp_path), "lines are counted as an editor does"


@every_reader
@pytest.mark.parametrize("line_break", ["\n", "\r\n", "\r", "\v", "\f", "\x1c", "\x85", "\u2028", "\u2029"])
def test_a_line_break_in_a_cell_is_a_space_and_never_glues_words(
    reader: str, line_break: str, tmp_path: Path
) -> None:
    text = lines(rows_of(reader, [f"red{line_break}cube", f" blue {line_break}{line_break} cube ", "grey"]))
    assert read(reader, text.encode(), tmp_path) == ["red cube", "blue cube", "grey"]


@every_reader
def test_a_heading_that_occurs_twice_is_refused(reader: str, tmp_path: Path) -> None:
    heading, *rows = rows_of(reader, TEXTS)
    for name in heading[1:]:
        doubled = [[*heading, f" {name} "], *([*row, "other"] for row in rows)]
        if reader == "labels" or name in heading:
            assert f"line 1 has the column '{name}' twice" in refusal(reader, lines(doubled).encode(), tmp_path)


@every_reader
def test_a_row_with_more_or_fewer_cells_is_refused_with_its_line(reader: str, tmp_path: Path) -> None:
    heading, *rows = rows_of(reader, TEXTS)
    for row in ([*rows[1], "extra"], rows[1][:-1]):
        text = lines([heading, rows[0], row, rows[2]])
        expected = f"line 3 has {len(row)} fields, the heading has {len(heading)}"
        assert expected in refusal(reader, text.encode(), tmp_path)


@every_reader
def test_a_last_line_that_is_cut_off_is_refused_and_one_without_an_end_is_read(
    reader: str, tmp_path: Path
) -> None:
    text = lines(rows_of(reader, TEXTS)).rstrip("\n")
    assert read(reader, text.encode(), tmp_path) == TEXTS
    assert "line 4 has" in refusal(reader, text.rsplit(",", 1)[0].encode(), tmp_path)
    assert "is no CSV" in refusal(reader, (text + '\n"open').encode(), tmp_path)


@every_reader
def test_empty_rows_and_columns_as_spreadsheets_leave_them_are_passed_over(reader: str, tmp_path: Path) -> None:
    heading, *rows = rows_of(reader, TEXTS)
    padded = [[*heading, "", ""], *([*row, "", " "] for row in rows)]
    empty = ["" for _ in padded[0]]
    text = lines([*padded[:2], empty, *padded[2:], empty, []])
    assert read(reader, text.encode(), tmp_path) == TEXTS


@pytest.mark.parametrize("reader", ["questions", "reviews"])
def test_a_cell_without_a_heading_is_refused(reader: str, tmp_path: Path) -> None:
    heading, *rows = rows_of(reader, TEXTS)
    text = lines([[*heading, ""], [*rows[0], ""], [*rows[1], "note"]])
    assert "line 3 has 'note' in a column without a heading" in refusal(reader, text.encode(), tmp_path)


def test_the_index_that_pandas_writes_without_a_heading_is_no_label(tmp_path: Path) -> None:
    content = b",episode_id,tone\n0,a,warm\n1,b,cold\n"
    assert read("labels", content, tmp_path) == ["warm", "cold"]


@every_reader
@pytest.mark.parametrize(
    ("encoding", "expected"),
    [
        ("cp1252", "line 2 holds the byte 0xE9, which is not UTF-8 (perhaps Windows-1252)"),
        ("utf-16-le", "is in UTF-16 without a byte order mark"),
        ("utf-32", "is in UTF-32"),
    ],
)
def test_another_encoding_is_refused_by_name_with_what_to_do(
    reader: str, encoding: str, expected: str, tmp_path: Path
) -> None:
    message = refusal(reader, lines(rows_of(reader, TEXTS)).encode(encoding), tmp_path)
    assert expected in message
    assert "CSV file in UTF-8" in message


@every_reader
@pytest.mark.parametrize(
    ("start", "name"),
    [(b"PK\x03\x04", "XLSX"), (b"\xd0\xcf\x11\xe0", "XLS"), (b"PAR1", "Parquet"), (b"\x1f\x8b", "gzip")],
)
def test_a_file_that_is_no_text_is_refused_by_name(reader: str, start: bytes, name: str, tmp_path: Path) -> None:
    assert name in refusal(reader, start + bytes(100), tmp_path)


@every_reader
def test_a_separator_that_is_not_read_is_refused(reader: str, tmp_path: Path) -> None:
    refusal(reader, lines(rows_of(reader, TEXTS), "|").encode(), tmp_path)
    assert "declares the separator '|'" in refusal(reader, b"sep=|\na|b\n", tmp_path)


def test_the_separator_that_gives_the_keys_is_meant_where_a_heading_has_two(tmp_path: Path) -> None:
    content = b"episode_id;tone;share, percent\na;warm;1,5\nb;cold;2,5\n"
    assert read("labels", content, tmp_path) == ["warm", "cold"]
    (tmp_path / "both.csv").write_text("x,y;z\n", encoding="utf-8")
    with pytest.raises(UsageError, match="has commas and semicolons; expected one separator"):
        open_table(tmp_path / "both.csv", ("x", "z"))


@pytest.mark.parametrize("word", sorted(MISSING))
def test_a_missing_cell_is_missing_to_each_reader(word: str, tmp_path: Path) -> None:
    table = f"episode_id,tone\na,warm\nb, {word} \nc,cold\n"
    (tmp_path / "labels.csv").write_text(table, encoding="utf-8")
    read_labels = Target.read(tmp_path / "labels.csv", "tone")
    assert read_labels.coded.classes == ("cold", "warm")
    assert read_labels.contents == "tone (binary), 2 classes: cold 1, warm 1; 1 missing"
    table = f"instruction,correct,wrong,group\nPut it on red,a.png,b.png,{word}\nPut it on blue,c.png,d.png,7\n"
    (tmp_path / "questions.csv").write_text(table, encoding="utf-8")
    assert [row.group for row in read_rows(tmp_path / "questions.csv")] == ["", "7"]
    table = f"instruction,correct,wrong\nPut it on red,{word},b.png\n"
    (tmp_path / "questions.csv").write_text(table, encoding="utf-8")
    with pytest.raises(UsageError, match="line 2, column correct: it is empty"):
        read_rows(tmp_path / "questions.csv")
    table = f"candidate_id,question_sha256,status,recognisable\na,0,accept,{word}\n"
    (tmp_path / "review.csv").write_text(table, encoding="utf-8")
    assert read_curation(tmp_path / "review.csv")[0]["recognisable"] == ""
    (tmp_path / "review.csv").write_text(table.replace("accept", word), encoding="utf-8")
    with pytest.raises(SuiteError, match="line 2 has no status"):
        read_curation(tmp_path / "review.csv")


@pytest.mark.parametrize("word", [*sorted(DOUBTFUL), "None ", "NONE", "#REF!", "#DIV/0!"])
def test_a_cell_that_may_be_missing_is_never_a_class(word: str, tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text(f"episode_id,tone\na,warm\nb,{word}\nc,cold\n", encoding="utf-8")
    if plain_cell(word) in MISSING:
        assert Target.read(tmp_path / "labels.csv", "tone").coded.classes == ("cold", "warm")
    else:
        with pytest.raises(
            UsageError, match=r"labels\.csv, line 3, column 'tone'.*(missing value|failed formula)"
        ):
            Target.read(tmp_path / "labels.csv", "tone")


@pytest.mark.parametrize(
    ("cells", "names"),
    [
        (["7", "+8", "9.0"], ["7", "+8", "9.0"]),
        ([7, 7.0, "7"], ["7", "7", "7"]),
        (["007", "008"], ["007", "008"]),
        (["5e882100", "7e123400", "inf"], ["5e882100", "7e123400", "inf"]),
        (["a  b", "a b", "cafe\u0301", "café"], ["a b", "a b", "café", "café"]),
        (["2.5", "2.50"], ["2.5", "2.50"]),
    ],
)
def test_groups_are_texts_as_they_are_written(cells: list[object], names: list[str]) -> None:
    assert group_names(cells, str, UsageError) == names


@pytest.mark.parametrize(
    "cells",
    [
        ["7", "007"],
        ["7", "7.0"],
        ["7.0", "07"],
        ["Kitchen", "kitchen"],
        ["Straße", "STRASSE"],
        ["a", "-"],
        ["a", "none"],
    ],
)
def test_two_spellings_of_one_group_are_refused(cells: list[str]) -> None:
    with pytest.raises(UsageError, match="row 1"):
        group_names(cells, "row {}".format, UsageError)


@pytest.mark.parametrize(
    ("cell", "truth"),
    [
        ("yes", True), ("Y", True), ("TRUE", True), ("1", True), (True, True), ("no", False), ("N", False),
        ("False", False), ("0", False), (False, False), ("ja", None), ("maybe", None), ("", None),
    ],
)  # fmt: skip
def test_yes_and_no_are_read_in_the_usual_spellings(cell: object, truth: bool | None) -> None:
    assert truth_of(cell) is truth


def test_every_table_of_text_is_read_by_one_function() -> None:
    other_calls = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, call in package_nodes(ast.Call)
        if path.name != "text_tables.py"
        and isinstance(call.func, ast.Attribute)
        and (
            call.func.attr in ("DictReader", "read_csv", "read_table", "genfromtxt", "loadtxt", "Sniffer")
            or (call.func.attr == "reader" and getattr(call.func.value, "id", "") == "csv")
        )
    ]
    assert other_calls == []
