"""The consoles: text from elsewhere is shown, never obeyed."""

import io
import json
import re
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

import probe_kit
from probe_kit._tables import table as tables
from probe_kit._terminal.console import SafeConsole, counter, marked, print_json, print_text

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
    "shown",
    [
        HOSTILE,
        Text(HOSTILE),
        a_table(),
        marked("[bold]{}[/]", HOSTILE),
        tables.Table.of(HOSTILE, (HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)], notes=[HOSTILE]),
    ],
    ids=["text", "Text", "table", "marked", "fitting table"],
)
def test_markup_and_escapes_of_others_are_shown_and_not_obeyed(shown: object) -> None:
    console = terminal()
    console.print(shown)
    assert SHOWN in written(console)
    assert "\x1b[2J" not in written(console)
    assert "\u202e" not in written(console)


def test_our_own_styles_still_work() -> None:
    console = SafeConsole(file=io.StringIO(), force_terminal=True, width=80, color_system="standard")
    console.print(marked("[bold red]{}[/]: {}", "E", "[red]"))
    assert written(console) == "\x1b[1;31mE\x1b[0m: [red]\n"


def test_a_template_holds_as_many_values_as_places_and_none_is_read_again() -> None:
    assert marked("[dim]{}[/] and {}", "{} {}", "[/dim]").plain == "{} {} and [/dim]"


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
    said = capsys.readouterr().out
    assert not set("\x9b\u202e\x7f\ud800\x1b") & set(said)
    assert "Δ" in said
    assert json.loads(said) == {hostile: [hostile]}


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
