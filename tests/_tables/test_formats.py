"""Every format shows every cell of a table as the text that it is: a parser of each format reads it."""

import ast
import csv
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

from probe_kit._system.escaping import without_folders
from probe_kit._tables import content
from probe_kit._tables.formats import names, render
from probe_kit._tables.formats.latex import _SPECIAL, MOST_COLUMNS
from probe_kit._tables.html import sort_key
from probe_kit._tables.numbers import number
from probe_kit._tables.table import Cell, Heading, Legend, Table, TableRow, absent, group_headings

HOSTILE = [
    "<img src=x onerror=alert(1)>", "</script><b>", "[text](https://evil.example)", "**bold**", "a | b",
    "&lt;b&gt;", "\\input{secret}", "100 % & $x$ #1 {a}_b^c~", "[red]x[/red]", "[/]", "=1+1", "a_b", "x\\",
    "λ|π × 2", "'; DROP", "–",
]  # fmt: skip
CELLS = st.one_of(
    st.sampled_from(HOSTILE),
    st.text("abX1 _*~<>[]()!#|\\&;:/.@-+=$'\"%{}^αΔ±", min_size=1, max_size=14).map(str.strip).filter(bool),
)
SETTINGS = settings(max_examples=40, deadline=None)


@st.composite
def tables(draw: st.DrawFn) -> Table:
    """Tables of hostile names: some means, differences, bold, red and coloured cells, equal headings."""
    width, names = draw(st.integers(2, 5)), draw(st.integers(1, 2))
    headings = [Heading(draw(CELLS), group=draw(st.sampled_from(["", "first", "a|b"]))) for _ in range(width)]
    rows = [
        TableRow(
            tuple(
                Cell(draw(CELLS), heat=draw(st.sampled_from([None, 0.1, 0.9])), alarm=draw(st.booleans()))
                for _ in range(width)
            ),
            is_mean=draw(st.booleans()),
            is_difference=draw(st.booleans()),
        )
        for _ in range(draw(st.integers(1, 4)))
    ]
    return Table(draw(CELLS), tuple(headings), tuple(rows), min(names, width - 1), (draw(CELLS),))


def words(text: str) -> str:
    return "".join(text.split())


# -- one property per format -------------------------------------------------------------------------------------


@SETTINGS
@given(tables())
def test_markdown_is_one_table_of_the_same_cells(table: Table) -> None:
    parser = MarkdownIt("commonmark", {"html": True}).enable("table")
    tokens = parser.parse(table.to_markdown())
    assert [token.type for token in tokens].count("table_open") == 1
    inside = [token for token in tokens if token.type == "inline"]
    plain = [
        "".join(
            child.content
            for child in token.children or []
            if child.type in ("text", "text_special", "code_inline")
        )
        for token in inside
    ]
    assert all({child.type for child in token.children or []} <= ALLOWED for token in inside)
    count, rows = len(table.headings), len(table.rows)
    cells = plain[1 + count : 1 + count + rows * count]
    expected_cells = [
        cell.text if not cell.alarm else f"🔴 {cell.text}" for row in table.rows for cell in row.cells
    ]
    assert [words(cell).replace("`", "") for cell in cells] == [
        words(cell).replace("`", "") for cell in expected_cells
    ]


ALLOWED = {"text", "text_special", "strong_open", "strong_close", "softbreak"}


@pytest.mark.slow
@SETTINGS
@given(tables())
def test_latex_has_a_line_per_row_whose_cells_read_back(table: Table) -> None:
    text = table.to_latex()
    body = text.partition(r"\midrule")[2].partition(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\").strip() for line in body.strip().splitlines() if line != r"\midrule"]
    assert len(lines) == len(table.rows)
    back = {code: character for character, code in _SPECIAL.items() if character not in "\n\r\0"} | {"-{}": "-"}
    pattern = re.compile("|".join(re.escape(code) for code in sorted(back, key=len, reverse=True)))
    for line, row in zip(lines, table.rows, strict=True):
        cells = re.split(r"(?<!\\) ?& ?", line)
        assert len(cells) == len(row.cells)
        for latex_cell, cell in zip(cells, row.cells, strict=True):
            bare = re.sub(r"\\cellcolor\{\w+\} ?", "", latex_cell)
            if r"\textcolor{red}{" in bare:
                bare = bare.replace(r"\textcolor{red}{", "", 1).removesuffix("}")
            assert words(pattern.sub(lambda match: back[match[0]], bare)) == words(cell.text)
    assert bool(re.search(r"\\cellcolor", text)) == any(
        c.heat is not None for row in table.rows for c in row.cells
    )


class Reader(HTMLParser):
    """The texts of cells and headings, and the names of all elements."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.cells: list[str] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        assert not [name for name, _ in attrs if name.startswith("on")]
        self._inside |= tag in ("td", "th")
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside &= tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.cells[-1] += data


@SETTINGS
@given(tables())
def test_html_holds_the_cells_as_text_and_no_element_of_theirs(table: Table) -> None:
    reader = Reader()
    reader.feed(table._repr_html_())
    assert set(reader.elements) <= {
        "style", "div", "table", "caption", "thead", "tbody", "tfoot", "tr", "th", "td", "span", "button",
    }  # fmt: skip
    ordered = [*(row for row in table.rows if not row.is_mean), *(row for row in table.rows if row.is_mean)]
    cells = [words(text).replace("\u00a0", "") for text in reader.cells[len(table.headings) :]]
    assert sorted("".join(sorted(cell)) for cell in cells) == sorted(
        # A page names no folder of this machine: of a path, it has the last part.
        "".join(sorted(words(without_folders(cell.text))))
        for row in ordered
        for cell in row.cells
    )


@SETTINGS
@given(tables(), st.sampled_from([20, 40, 80, 200]))
def test_a_console_of_any_width_truncates_nothing_and_runs_markup_as_text(table: Table, width: int) -> None:
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= width
    printed_words = words(text)
    for row in table.rows:
        for cell in row.cells[table.names :]:
            assert words(cell.text) in printed_words


@SETTINGS
@given(st.lists(st.fixed_dictionaries({"name": CELLS, "ci": st.sampled_from([(0.1, 0.2), None])}), min_size=1))
def test_json_and_csv_hold_the_numbers_and_no_cell_that_a_spreadsheet_computes(numbers: list[dict]) -> None:
    table = Table.of("t", ("name",), [("x",)], numbers=tuple(numbers))
    plain = [{"name": record["name"], "ci": record["ci"] and list(record["ci"])} for record in numbers]
    assert json.loads(table.to_json()) == plain
    for line, record in zip(csv.DictReader(io.StringIO(table.to_csv())), numbers, strict=True):
        assert line["name"].lstrip("'") == record["name"].lstrip("'")
        assert line["name"][0] not in "=+-@"
        if any(other["ci"] for other in numbers):
            assert (line["ci_low"], line["ci_high"]) == (("0.1", "0.2") if record["ci"] else ("", ""))


# -- what single formats promise ---------------------------------------------------------------------------------

WIDE = Table.of(
    "Rates: a model",
    (Heading("system"), Heading("category"), *group_headings(("first", ("rate %",)), ("second", ("interval",)))),
    [
        ("a policy with a long name", "color", "98.1", "[90, 99]"),
        ("a policy with a long name", "mean", "72.5", "[60, 80]"),
        ("another", "color", "3.4", "[1, 9]"),
    ],
    names=2,
    mean="mean",
    notes=["a note"],
)


def printed(table: Table, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def test_rows_stand_below_the_name_of_their_section_which_is_written_once() -> None:
    assert printed(WIDE, 80)[3:10] == [
        "a policy with a long name",
        "  color            98.1    [90, 99]",
        "  mean             72.5    [60, 80]",
        "another",
        "  color            3.4     [1, 9]",
        "A note.",
        "",
    ]


@pytest.mark.parametrize("width", [20, 30, 36, 44, 80])
def test_sections_are_named_and_no_value_is_cut_at_any_width(width: int) -> None:
    text = " ".join(" ".join(printed(WIDE, width)).split())
    for value in ("98.1", "72.5", "3.4", "[90, 99]", "[60, 80]", "[1, 9]"):
        assert text.count(value) == 1
    assert "another" in text
    assert "a policy with a long name" in text


def test_a_column_of_numbers_stands_right_whatever_its_texts_look_like() -> None:
    """Not by the text: a name may begin with a digit, and a number with a letter."""
    rows = [
        ("a", Cell(3.0, "n = {:.0f}".format), "3 of 4", Cell(None), absent("n/a"), Cell(0.5, interval=(0.1, 0.9))),
        ("b", Cell(None), "[1, 2]", Cell("–"), Cell(7, after=" of 9"), Cell(float("nan"), number, (0.1, 0.9))),
    ]
    table = Table.of("t", tuple("abcdef"), rows)
    assert table.are_numeric == (False, True, False, True, True, True)
    assert table.texts[0] == ("a", "n = 3", "3 of 4", "–", "n/a", "0.5 [0.1, 0.9]")
    assert table.texts[1] == ("b", "–", "[1, 2]", "–", "7 of 9", "–")
    assert "{lrlrrr}" in table.to_latex()
    assert '<span class="limits">[0.1,\u00a00.9]</span>' in table._repr_html_()
    assert '<span class="limits">[1, 2]</span>' not in table._repr_html_()
    assert [sort_key(cell, True) for cell in (rows[0][1], rows[1][1], rows[1][5])] == [3.0, None, None]


def test_tables_of_the_same_cells_are_equal() -> None:
    once, again = (Table("", (Heading("n"),), (TableRow((absent("n/a"),)),)) for _ in range(2))
    assert once == again
    assert once != Table("", (Heading("n"),), (TableRow((absent("none"),)),))


def test_no_table_searches_a_text_for_its_values() -> None:
    """LaTeX alone uses expressions, to escape texts and to spell its label."""
    for file in Path(content.__file__).parent.rglob("*.py"):
        imports = [
            node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Import)
        ]
        assert file.stem == "latex" or "re" not in [name.name for node in imports for name in node.names], file


RATE = Cell(98, interval=(90, 99), after=" ✓")


def test_intervals_fold_below_their_values_before_a_table_is_divided() -> None:
    table = Table.of("t", ("category", "rate %", "verdict"), [("color", RATE, "a, b")], overflow="fold")
    assert printed(table, 80)[3] == "color     98 [90, 99] ✓  a, b"
    assert printed(table, 30)[3:5] == ["color     98 ✓      a,", "          [90, 99]  b"]


def test_columns_that_do_not_fit_are_left_out_by_name() -> None:
    columns = ("category", *(f"column {number}" for number in range(9)))
    table = Table.of("t", columns, [("color", *"123456789")], overflow="leave out")
    text = " ".join(printed(table, 40))
    assert "column 2" in text.partition("With --details")[0]
    assert text.endswith("more room: column 3, column 4, column 5, column 6, column 7, column 8. ")


def test_a_wide_tabular_is_divided_between_groups_and_each_has_its_lines_width() -> None:
    heads = (("a", 6), ("b", 6), ("c", 2), ("", 2))
    names = iter(f"c{at}" for at in range(1, 17))
    columns = (
        Heading("c0"),
        *group_headings(*((head, [next(names) for _ in range(count)]) for head, count in heads)),
    )
    text = Table.of("wide", columns, [("0", *map(Cell, range(1, 17)))]).to_latex()
    counts = [line.count("&") + 1 for line in text.splitlines() if line.startswith(("c0", "0 "))]
    assert counts == [MOST_COLUMNS, MOST_COLUMNS, 5, 5]
    assert text.count(r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%") == 2
    assert text.count(r"\begin{table}") == 1
    assert r"\multicolumn{6}{c}{a}" in text
    assert r"\begin{tabular}{lrrrrrrrrrrrr}" in text, "words to the left, numbers to the right"


def test_every_table_of_a_page_has_a_label_of_its_own_and_colours_are_asked_for_where_they_are_used() -> None:
    bare, coloured = (
        Table.of("Rates", ("a", "b"), [("x", "1")]),
        Table.of("Rates", ("a", "b"), [("x", Cell("1", heat=0.5))]),
    )
    assert re.findall(r"\\label\{(.*)\}", render("latex", [bare, bare])) == ["tab:rates", "tab:rates-2"]
    assert "xcolor" not in render("latex", [bare])
    assert r"\usepackage[table]{xcolor}" in render("latex", [coloured])
    assert r"\definecolor{pkheat3}" in render("latex", [coloured])


def test_columns_without_content_and_those_that_need_room_are_left_out() -> None:
    table = Table.of("t", ("a", Heading("b", is_detail=True), "c"), [("x", "1", "–"), ("y", "2", "")]).filled()
    assert table.columns == ("a", "b")
    assert table.details(False) is None
    assert (detailed_table := table.details(True)) is not None
    assert detailed_table.columns == ("a", "b")


def test_equal_headings_are_told_apart_by_the_name_over_them_where_a_page_has_one_line() -> None:
    table = Table.of(
        "t", group_headings(("", ["n"]), ("left", ["rate"]), ("right", ["rate", "p"])), [("x", "1", "2", "3")]
    )
    assert table.full_headings == ("n", "left rate", "right rate", "p")


def test_formats_are_the_files_of_their_folder() -> None:
    assert names() == ("latex", "markdown")


def test_a_legend_explains_only_the_columns_that_are_there() -> None:
    headings = (
        "edit",
        Heading("effect", term="effect: share: n/a without one"),
        Heading("net rate, % [95 %]", term="net rate: flips; minus returns"),
        Heading("p", term="p: exact"),
    )
    legend = Legend(("every edit",), {"*": "by construction"}, ("no verdict",))
    table = Table.of("Edits", headings, [("a", Cell(1, after="*"), "2", "3")], legend=legend, notes=["a note"])
    effect, rate, p = (heading.term for heading in table.headings[1:])
    every = f"every edit; {effect}; {rate}; {p}; *: by construction; no verdict"
    assert table.all_notes == (every, "a note")
    assert table.sentences == (f"E{every[1:]}.", "A note.")
    assert table.only([0, 2]).all_notes == (f"every edit; {rate}; no verdict", "a note")


def test_a_mark_that_no_cell_has_is_not_explained() -> None:
    for cell, notes in (("0.9*", ("*: by construction.",)), ("0.9", ())):
        legend = Legend(marks={"*": "by construction"})
        table = Table.of("Edits", ("edit", "net rate"), [("a", cell)], legend=legend, notes=["net rate: flips"])
        assert table.sentences == (*notes, "Net rate: flips.")


def test_a_table_of_words_wraps_its_texts_and_neither_names_nor_numbers() -> None:
    rows = [("a.long.name.of.a.target", "120,000", "48 words " * 12), ("short", "7", "none")]
    table = Table.of("words", ("target", "count", "values"), rows, overflow="wrap")
    file = io.StringIO()
    Console(file=file, width=60).print(table)
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= 60
    assert any(line.startswith("a.long.name.of.a.target  120,000") for line in lines)
    assert file.getvalue().count("words") == 1 + 12
