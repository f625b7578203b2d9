"""Foreign text in CSV and Markdown is computed by no spreadsheet and is no markup."""

import ast
import csv
import io
import re
import shlex
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from probe_kit._system.escaping import (
    as_argument,
    csv_of_frame,
    csv_of_rows,
    escape_formula,
    markdown_safe,
    terminal_safe,
    unescape,
    without_folders,
)
from probe_kit._system.table_cells import plain_cell
from probe_kit._system.text_tables import open_table
from probe_kit._terminal.notebook import facts_html, rows_html
from probe_kit.errors import SuiteError
from probe_kit.hooks import load_model
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.retention import retention_table
from probe_kit.retention.report import report_html
from probe_kit.suite import Suite
from probe_kit.suite.converters.curation import read_curation
from probe_kit.suite.manifest import save_suite
from tests.retention.asked_runs import SaidRun, acted, answer_run
from tests.support.parsed import package_nodes

ROOT = Path(__file__).parents[2]
FORMULAS = [
    "=1+1",
    "+1",
    "-1",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "\n=1",
    " =1",
    "=cmd|' /C calc'!A0",
    "'=1",
    "''@x",
    "＝1",
]
texts = st.text(st.sampled_from("=+-@'\t\r\n ,\"aé＝0"), max_size=6)


@pytest.mark.parametrize("text", FORMULAS)
def test_a_text_that_would_be_computed_gets_a_mark_in_front(text: str) -> None:
    assert escape_formula(text) == f"'{text}"
    assert unescape(escape_formula(text)) == text


@pytest.mark.parametrize("cell", [-0.5, -3, float("nan"), None, True, "", "a=b", "x-1", "'quoted'", "5 − 2"])
def test_numbers_and_plain_texts_stay_as_they_are(cell: object) -> None:
    assert escape_formula(cell) is cell


@given(texts)
def test_every_text_comes_back(text: str) -> None:
    assert unescape(escape_formula(text)) == text
    assert not escape_formula(text).lstrip().startswith(("=", "+", "-", "@"))


@given(rows=st.lists(st.tuples(texts, texts), max_size=4))
def test_rows_come_back_from_csv_as_cells(
    rows: list[tuple[str, str]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """White space around a cell and line breaks in it are all that is lost, and rows without a text."""
    path = tmp_path_factory.mktemp("rows") / "rows.csv"
    written = [dict(zip(("=a", "b"), row, strict=True)) for row in rows]
    path.write_text(csv_of_rows(("=a", "b"), written), encoding="utf-8", newline="")
    expected = [{name: plain_cell(cell) or None for name, cell in row.items()} for row in written]
    read = [row for _, row in open_table(path, ("=a",)).rows()]
    assert [row for row in read if any(row.values())] == [row for row in expected if any(row.values())]


def test_a_frame_keeps_its_numbers_and_marks_its_texts() -> None:
    frame = pd.DataFrame(
        {
            "@name": ["=1+1", "plain", None],
            "share": [-0.5, np.nan, 1e-9],
            "count": [-1, 2, 3],
            "mixed": ["-x", -1, None],
            "kind": pd.Categorical(["+a", "b", "+a"]),
        }
    )
    before = frame.copy(deep=True)
    header, *rows = csv.reader(io.StringIO(csv_of_frame(frame)))
    assert header == ["'@name", "share", "count", "mixed", "kind"]
    assert rows == [
        ["'=1+1", "-0.5", "-1", "'-x", "'+a"],
        ["plain", "", "2", "-1", "b"],
        ["", "1e-09", "3", "", "'+a"],
    ]
    pd.testing.assert_frame_equal(frame, before)


def test_a_frame_without_such_texts_is_written_as_pandas_writes_it() -> None:
    frame = pd.DataFrame({"a": [None, 1], "b": ["x", "y, z"], "c": [True, False], "d": [[1], [2]]}, dtype=object)
    assert csv_of_frame(frame) == frame.to_csv(index=False)


@pytest.mark.parametrize("name", ["runs/a", "my run", "-x", "--out", "it's", "a;b", "s3://bucket/my run#2"])
def test_a_path_in_a_printed_command_is_one_word_and_no_option(name: str) -> None:
    (word,) = shlex.split(as_argument(name))
    assert word == (f"./{name}" if name.startswith("-") else name)


def test_every_csv_of_the_package_goes_through_one_function() -> None:
    other_calls = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, call in package_nodes(ast.Call)
        if path.name != "escaping.py"
        and isinstance(call.func, ast.Attribute)
        and (
            call.func.attr in ("DictWriter", "savetxt")
            or (call.func.attr == "writer" and getattr(call.func.value, "id", "") == "csv")
            or (call.func.attr == "to_csv" and call.keywords)
        )
    ]
    assert other_calls == []


def test_the_attribution_of_a_suite_is_no_formula(small_suite: Suite, tmp_path: Path) -> None:
    items = tuple(replace(item, attribution="=HYPERLINK(0)") for item in small_suite.items)
    pictures = {
        item.file_name(side): item.picture(side).read_bytes()
        for item in small_suite.items
        for side in ("left", "right")
    }
    saved_suite = save_suite(replace(small_suite, items=items), pictures, {}, tmp_path / "suite")
    rows = list(csv.DictReader((saved_suite.folder / "ATTRIBUTION.csv").open(encoding="utf-8", newline="")))
    assert {row["attribution"] for row in rows} == {"'=HYPERLINK(0)"}


def test_a_curation_file_that_is_no_csv_is_named(tmp_path: Path) -> None:
    path = tmp_path / "review.csv"
    path.write_text('candidate_id\n"' + "x" * 200_000, encoding="utf-8")
    with pytest.raises(SuiteError, match=r"review\.csv, line 2 is no CSV: field larger"):
        read_curation(path)


def test_a_carriage_return_in_a_cell_is_no_end_of_a_row() -> None:
    text = csv_of_frame(pd.DataFrame({"a": ["x\ry", "x\r\ny"], "b": [1, 2]}))
    assert text == 'a,b\n"x\ry",1\n"x\r\ny",2\n'


PARSER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
HOSTILE = [
    "<img src=x onerror=alert(1)>", "<!-- gone -->", "<https://evil.example>", "<script>alert(1)</script>",
    "[text](https://evil.example)", "![picture](https://evil.example/x.png)", "[text][1]", "[1]: https://evil.example",
    "**bold**", "_emphasis_", "__strong__", "*a*", "~~gone~~", "# heading", "> quotation", "- entry", "+ entry",
    "1. entry", "12) entry", "a | b", "&lt;script&gt;", "&#60;b&#62;", "\\<b>", "\\\\<b>", "a\\", "```", "~~~",
    "a\nb", "a\n\n# heading", "===", "---x", "$x$", "a_b", "snake_case_name", "[0.41, 0.63]", "p < 0.05",
    "−0.3 ± 0.1", "0.65*", "a > b", "r'(x)'",
]  # fmt: skip


def rendered_text(markdown: str) -> str:
    """The text that a reader sees, if the parser makes nothing but one paragraph of text; else its HTML."""
    tokens = PARSER.parse(markdown)
    if [token.type for token in tokens] != ["paragraph_open", "inline", "paragraph_close"]:
        return PARSER.render(markdown)
    children = tokens[1].children or []
    if {child.type for child in children} - {"text", "text_special", "code_inline", "softbreak"}:
        return PARSER.render(markdown)
    return "".join(f"`{token.content}`" if token.type == "code_inline" else token.content for token in children)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_is_shown_as_it_is(text: str) -> None:
    assert rendered_text(markdown_safe(text)) == re.sub(r"\s*\n+\s*", " ", text)


@pytest.mark.parametrize(
    "text", ["snake_case_name", "suite@1#0123", "[0.41, 0.63]", "p < 0.05", "−0.3 ± 0.1", "0.65 (n = 3)"]
)
def test_names_and_numbers_are_written_without_escapes(text: str) -> None:
    assert markdown_safe(text) == text


@settings(max_examples=200, deadline=None)
@given(st.text("abX1 _*~<>[]()!#|\\&;:/.@-+=$'\"", min_size=1, max_size=24).map(str.strip).filter(bool))
def test_no_text_becomes_markup_and_none_ends_a_cell(text: str) -> None:
    assert rendered_text(markdown_safe(text)) == text
    page = PARSER.render(f"| heading |\n| --- |\n| {markdown_safe(text)} |\n")
    assert page.count("<td>") == 1
    assert not re.search(r"<(?!/?(table|thead|tbody|tr|th|td)>)", page)


@given(st.text("ab0 ~", min_size=1, max_size=16))
def test_no_tilde_is_left_that_github_strikes_text_out_by(text: str) -> None:
    """GitHub's renderer takes single tildes too, as in `0~50 and 60~90`; the parser of these tests does not."""
    assert not re.search(r"(?<!\\)~", markdown_safe(text))


@pytest.mark.parametrize("text", ["https://evil.example/x", "http://x", "www.evil.example", "me@evil.example"])
def test_no_address_becomes_a_link_by_itself(text: str) -> None:
    """GitHub and the hub make links of `scheme://`, `www.` and `name@` that stand in the source."""
    assert not re.search(r"://|www\.|\w@\w", markdown_safe(text))
    assert rendered_text(markdown_safe(text)) == text


@pytest.mark.parametrize(
    ("hostile", "harmless"),
    [
        ("\x1b[31mred\x1b[0m", "␛[31mred␛[0m"),
        ("\x1b]0;title\x07", "␛]0;title␇"),
        ("\x9b31m", "\ufffd31m"),
        ("over\rwritten", "over␍written"),
        ("gone\x08\x7f", "gone␈␡"),
        ("user\u202egnp.exe", "user\ufffdgnp.exe"),
        ("\u2066isolate\u2069", "\ufffdisolate\ufffd"),
        ("half \ud800", "half \ufffd"),
        ("line\u2028line", "line\ufffdline"),
    ],
)
def test_nothing_is_left_that_a_terminal_obeys(hostile: str, harmless: str) -> None:
    assert terminal_safe(hostile) == harmless


@pytest.mark.parametrize("text", ["plain", "Δ, π and ×", "two\nlines\tand a tab", "日本語", "[bold]brackets[/]"])
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert terminal_safe(text) == text


RIGHT = {"color": np.random.default_rng(0).random((12, 2)) < 0.7}
MACHINE = {
    "checkpoint": "/home/jane doe/models/my fine-tune",
    "audit": {"file": "/home/jane/models/model.safetensors", "cache": "~/.cache/huggingface/hub"},
    "note": "read from /opt/data/weights.bin, see C:\\Users\\jane\\notes.txt",
}


def runs(folder: Path) -> list[SaidRun]:
    """Without probes, with items left out, with other first frames: each makes a note that names a run."""
    policy = acted(folder / "a policy", RIGHT, "pi0 · tokenizer=/home/jane/tokenizers/mine")
    policy = replace(
        policy, certificate={"policy": MACHINE}, settings={"suite": {"folder": str(folder / "suite")}}
    )
    policy.episodes["first_frame_sha256"] = "other"
    return [policy, answer_run(folder / "a VLM", RIGHT, worded=True)]


def leaks(page: str, folder: Path) -> list[str]:
    """Places of this machine in a page; figures are bytes in which any letters may stand together."""
    text = re.sub(r"data:[\w/+-]+;base64,[\w+/=]+", "", page)
    return [
        prefix
        for prefix in (
            str(folder),
            str(Path.home()) + "/",
            tempfile.gettempdir() + "/",
            "/home/",
            "Users",
            "/opt/",
        )
        if prefix in text
    ]


def test_no_path_of_this_machine_stands_in_the_report(tmp_path: Path) -> None:
    report_runs = runs(tmp_path)
    table = retention_table(report_runs, vlm_vla=True)
    assert leaks("\n".join(table.notes), tmp_path), "the notes of this table must name runs by their places"
    page = report_html(report_runs, table)
    assert leaks(page, tmp_path) == []
    assert "Success rates only: acted has no activations to probe" in page
    assert "Answers only" not in page, "a model that was only asked lacks nothing"
    assert "my fine-tune" in page  # of a path its last part is kept
    assert "model.safetensors" in page


def test_no_path_of_this_machine_stands_in_a_notebook(tmp_path: Path) -> None:
    assert leaks(retention_table(runs(tmp_path))._repr_html_(), tmp_path) == []


def test_no_path_of_this_machine_stands_in_what_notebooks_show_of_runs_and_models(tmp_path: Path) -> None:
    facts = facts_html("Run of /opt/models/a", {"weights": MACHINE["note"], "at": str(tmp_path)}, "see ~/runs/a")
    rows = rows_html("Probes", ("/opt/data/x",), [(str(tmp_path / "a"),)], str(tmp_path))
    copied = tmp_path / "my models" / "copy"
    shutil.copytree(embedded_checkpoint("pi0-tiny"), copied)
    model = load_model("pi0-tiny", str(copied))._repr_html_()
    assert "copy" in model
    assert leaks(facts + rows + model, tmp_path) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("in /home/jane/runs/a: 3 episodes", "in a: 3 episodes"),
        ('{"folder": "/data/my runs/b"}', '{"folder": "b"}'),
        ("see ~/runs/a, then", "see a, then"),
        ("from file:///home/jane/x.bin", "from x.bin"),
        (r"on C:\Users\jane\a.bin now", "on a.bin now"),
        ("`probe-kit train /data/runs/a` fits", "`probe-kit train a` fits"),
    ],
)
def test_of_a_path_the_last_part_is_kept(text: str, expected: str) -> None:
    assert without_folders(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "n/a",
        "left / right",
        "s3://bucket/runs/a",
        "https://example.org/a/b",
        "Qwen/Qwen3-VL-4B",
        "</s>",
        "a/b/c",
        "/",
    ],
)
def test_a_text_that_is_no_path_keeps_its_folders(text: str) -> None:
    assert without_folders(text) == text
