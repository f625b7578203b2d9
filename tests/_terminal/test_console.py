"""The consoles: text from elsewhere is shown, never obeyed."""

import ast
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

import probe_kit
from probe_kit._system.line_breaks import keep_numbers_whole
from probe_kit._tables import table as tables
from probe_kit._terminal import console
from probe_kit._terminal.console import (
    EVERY,
    FIRST,
    Heartbeat,
    SafeConsole,
    counter,
    duration,
    markup,
    print_json,
    print_text,
)
from probe_kit._terminal.field_options import PanelledHelp

HOSTILE = "[bold red]x[/] [/unopened] \x1b[2J\u202e:warning:"
SHOWN = "[bold red]x[/] [/unopened] ␛[2J\ufffd:warning:"


def terminal() -> SafeConsole:
    return SafeConsole(file=io.StringIO(), force_terminal=True, width=300, color_system=None, legacy_windows=False)


def written(console: SafeConsole) -> str:
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def a_table() -> Table:
    table = Table(HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE)
    return table


@pytest.mark.parametrize(
    "content",
    [
        HOSTILE,
        Text(HOSTILE),
        a_table(),
        markup("[bold]{}[/]", HOSTILE),
        tables.Table.of(HOSTILE, (HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)], notes=[HOSTILE]),
    ],
    ids=["text", "Text", "table", "marked", "fitting table"],
)
def test_markup_and_escapes_of_others_are_shown_and_not_obeyed(content: object) -> None:
    console = terminal()
    console.print(content)
    assert SHOWN in written(console)
    assert "\x1b[2J" not in written(console)
    assert "\u202e" not in written(console)


def test_our_own_styles_still_work() -> None:
    console = SafeConsole(file=io.StringIO(), force_terminal=True, width=80, color_system="standard")
    console.print(markup("[bold red]{}[/]: {}", "E", "[red]"))
    assert written(console) == "\x1b[1;31mE\x1b[0m: [red]\n"


def test_a_template_holds_as_many_values_as_places_and_none_is_read_again() -> None:
    assert markup("[dim]{}[/] and {}", "{} {}", "[/dim]").plain == "{} {} and [/dim]"


def test_a_bar_and_a_waiting_line_show_names_as_they_are() -> None:
    from rich.progress import Progress, TextColumn

    console = terminal()
    with Progress(TextColumn("{task.description}", markup=False), console=console) as bar:
        bar.add_task(HOSTILE, total=1)
    assert SHOWN[:30] in written(console)


def test_where_no_terminal_is_lines_are_said_of_work(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.progress import Progress

    advance = counter(Progress(), HOSTILE)
    advance(2, 2)
    assert "\x1b" not in capsys.readouterr().err


def test_json_keeps_every_sign_and_lets_none_out(capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "\x9b31m\u202e\x7f\ud800 \x1b Δ"
    print_json({hostile: [hostile]})
    output = capsys.readouterr().out
    assert not set("\x9b\u202e\x7f\ud800\x1b") & set(output)
    assert "Δ" in output
    assert json.loads(output) == {hostile: [hostile]}


def test_other_formats_are_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    print_text("a,b\nc\x1b[31m,d")
    assert capsys.readouterr().out == "a,b\nc␛[31m,d\n"


def test_a_next_step_can_be_copied_because_two_spaces_end_the_command() -> None:
    package = Path(probe_kit.__file__).parent
    sources = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    tails = [
        (path.name, tail)
        for path, text in sources.items()
        for tail in re.findall(r'next: \[bold\][^"]*?\[/\]([^"]*)"', text)
    ]
    assert len(tails) > 5
    # An option that follows is part of the command; a semicolon ends a command of the shell.
    assert [entry for entry in tails if not re.match(r"$|  \S| --|; ", entry[1])] == []


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def lines_of(steps: list[tuple[float, int]], total: int) -> list[str]:
    """What is said when `done` of `total` are finished at each time."""
    clock, lines = Clock(), list[str]()
    beat = Heartbeat("episodes", lines.append, clock)
    for seconds, finished in steps:
        clock.seconds = seconds
        beat(finished, total, "correct")
    return lines


def test_the_last_line_is_said_once_however_many_events_bring_the_end() -> None:
    """The eight episodes of one answer of a Ray worker are all counted before the first of them is printed."""
    assert len(lines_of([(1.0, 2), (2.0, 10), (2.0, 10), (2.1, 10), (100.0, 10)], 10)) == 1


def test_long_work_says_a_line_now_and_then_and_one_at_the_end() -> None:
    lines = lines_of([(second, second) for second in range(1, 601)], 600)
    assert len(lines) == 1 + int((600 - FIRST) // EVERY) + 1
    assert lines[0] == "episodes: 10/600 after 10 s, 1.0 per s, about 9 min 50 s left"
    assert lines[-1] == "episodes: 600/600 after 10 min 00 s, 1.0 per s"


def test_short_work_says_one_line() -> None:
    assert lines_of([(1.0, 1), (2.0, 2)], 2) == ["episodes: 2/2 after 2 s, 1.0 per s"]


def test_what_an_earlier_process_did_does_not_raise_the_rate() -> None:
    assert lines_of([(30.0, 901), (60.0, 902), (120.0, 904)], 1000)[-1] == (
        "episodes: 904/1000 after 2 min 00 s, 2.0 per min, about 48 min 00 s left"
    )


def test_a_slow_site_is_counted_by_the_hour() -> None:
    assert lines_of([(7200.0, 1), (14400.0, 2)], 3)[-1] == (
        "episodes: 2/3 after 4 h 00 min, 0.5 per h, about 2 h 00 min left"
    )


def test_loading_a_model_is_no_part_of_the_rate() -> None:
    lines = lines_of([(40.0, 1), (41.0, 2), (100.0, 61)], 100)
    assert lines[0] == "episodes: 1/100 after 40 s"
    assert lines[-1] == "episodes: 61/100 after 1 min 40 s, 1.0 per s, about 39 s left"


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "0 s"), (59.6, "1 min 00 s"), (3599.9, "1 h 00 min")])
def test_durations_carry_over(seconds: float, words: str) -> None:
    assert duration(seconds) == words


@pytest.mark.parametrize("terminal", [True, False])
def test_bars_are_for_terminals_and_lines_for_logs(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=output, force_terminal=terminal, width=80, markup=False))
    with console.progress() as bar:
        console.counter(bar, "drawing [items]")(3, 3)
    assert ("━" in output.getvalue()) is terminal
    assert ("drawing [items]: 3/3" in output.getvalue()) is not terminal


COMMANDS = (
    ("--help",), ("--version",), ("models",), ("models", "--json"), ("run", "show", "{run}"),
    ("run", "show", "{run}", "--json"), ("run", "verify", "{run}"), ("retention", "{run}"),
    ("retention", "{run}", "--format", "json"), ("retention", "{run}", "--format", "csv"), ("suite", "list"),
    ("study", "run", "embedded", "--dry-run"),
)  # fmt: skip


def run_command(words: tuple[str, ...], run: Path, redirection: str) -> subprocess.CompletedProcess[str]:
    command = " ".join([sys.executable, "-m", "probe_kit", *(word.format(run=run) for word in words)])
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        ["bash", "-c", f"{command} {redirection}"],
        capture_output=True,
        encoding="utf-8",
        env=environment,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("redirection", ["| true", "| head -c 1", ">&-", ">&- 2>&-", "> /dev/full"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_no_command_ends_in_a_traceback(little_runs: Path, words: tuple[str, ...], redirection: str) -> None:
    completed = run_command(words, little_runs / "run", redirection)
    assert "Traceback" not in completed.stderr
    assert "InternalError" not in completed.stderr
    assert "Exception ignored" not in completed.stderr


def test_a_table_without_a_reader_ends_without_a_traceback(tmp_path: Path) -> None:
    test_no_command_ends_in_a_traceback(tmp_path, ("models",), "| true")


STYLE = re.compile(r"\[(?:/|/?(?:bold|dim|italic|underline|red|green|yellow|cyan|magenta|blue|white)\b[^\[\]]*)\]")
"""A mark of rich's markup, which the consoles print as it is."""


def unread_marks(source: str) -> list[str]:
    """The texts with marks that `markup` does not read; docstrings are no output."""
    tree = ast.parse(source)
    read: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "markup":
            read |= {id(part) for argument in node.args[:1] for part in ast.walk(argument)}
        if isinstance(node, ast.Expr):
            read.add(id(node.value))
    texts = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    return [node.value for node in texts if id(node) not in read and STYLE.search(node.value)]


def test_every_style_of_a_printed_line_is_read_as_one_and_no_values_styles_are() -> None:
    package = Path(probe_kit.__file__).parent
    sources = {file.name: file.read_text(encoding="utf-8") for file in package.rglob("*.py")}
    unread = {name: unread_marks(source) for name, source in sources.items() if STYLE.search(source)}
    assert {name: texts for name, texts in unread.items() if texts} == {}
    assert unread_marks('say("next: [bold]probe-kit demo[/]")') == ["next: [bold]probe-kit demo[/]"]
    assert markup("[bold]{}[/]", "[red]mine[/]").plain == "[red]mine[/]"


# -- numbers and their units ----------------------------------------------------------------------------------

QUANTITIES = [
    "65 %",
    "0.62 [0.55, 0.70]",
    "12.5 cm",
    "3 h",
    "12 min",
    "p = 0.03",
    "p < 0.001",
    "1,024 GB",
    "± 0.2",
]
PROSE = " so ".join(f"it says that {quantity} stays" for quantity in QUANTITIES * 4)
WIDTHS = pytest.mark.parametrize("width", [40, 60, 80])


def assert_numbers_are_whole(text: str) -> None:
    rows = [" ".join(line.strip(" │").split()) for line in text.splitlines()]
    assert len(rows) > 10, "the text was wrapped"
    for quantity in QUANTITIES:
        # an interval stays whole, but may stand below its value
        interval = re.search(r"\[.*\]", quantity)
        assert sum(row.count(interval[0] if interval else quantity) for row in rows) == 4, quantity


@WIDTHS
def test_sentences_and_cells_break_no_line_between_a_number_and_its_unit(width: int) -> None:
    for renderable in (
        PROSE,
        Text(PROSE, style="dim"),
        tables.Table.of("t", ("n", "text"), [("a", PROSE)], overflow="wrap"),
    ):
        stream = io.StringIO()
        SafeConsole(file=stream, width=width).print(renderable)
        assert_numbers_are_whole(stream.getvalue())
        assert stream.getvalue().isprintable() or set(stream.getvalue()) <= set(PROSE + "antex \n─━│╶")


@pytest.mark.parametrize(("width", "of_command"), [(40, True), (60, False), (80, False)])
def test_help_breaks_no_line_between_a_number_and_its_unit(
    width: int, of_command: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer()

    @app.command(cls=PanelledHelp, help=PROSE if of_command else "Measure.")
    def measure(limit: int = typer.Option(1, help="Most." if of_command else PROSE)) -> None:
        """Measure."""

    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", width)
    with pytest.raises(SystemExit):
        app(["--help"])
    assert_numbers_are_whole(capsys.readouterr().out)


@pytest.mark.parametrize("text", ["a = b", "items = 12", "m 5 steps", "5 m/s", "24 items", "[1, 2, 3] 4", "x % 2"])
def test_only_blanks_within_a_quantity_are_held(text: str) -> None:
    held = keep_numbers_whole(text, "~")
    assert held.replace("~", " ") == text
    assert "~" not in held.replace("~%", "").replace(",~3]", "")
