"""`--help` fits a screen, and `--help-all` has every option."""

import re
import subprocess
import sys
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from probe_kit._terminal.field_options import HELP_ALL, MOST_OPTIONS
from probe_kit.cli import app, commands_of

LEAVES: dict[str, Any] = dict(commands_of(typer.main.get_command(app), None))
LONG = sorted(name for name, command in LEAVES.items() if len(command.params) > MOST_OPTIONS)
SCREEN = 66


def help_page(command: str, flag: str, width: int = 80) -> str:
    answer = CliRunner().invoke(app, [*command.split(), flag], env={"COLUMNS": str(width)})
    assert answer.exit_code == 0, answer.output
    return answer.stdout


def options_in(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))


@pytest.mark.parametrize("command", sorted(LEAVES))
def test_help_fits_a_screen_of_80_columns(command: str) -> None:
    assert len(help_page(command, "--help").splitlines()) <= SCREEN


@pytest.mark.parametrize("command", LONG)
def test_help_names_the_panels_that_only_help_all_shows_and_these_have_every_option(command: str) -> None:
    short, full = help_page(command, "--help", 300), help_page(command, HELP_ALL, 300)
    declared = {
        (*parameter.opts, *parameter.secondary_opts)[0]
        for parameter in LEAVES[command].params
        if parameter.param_type_name == "option"
    }
    assert {option for option in declared if option.startswith("--")} <= options_in(full)
    panels = {
        parameter.rich_help_panel
        for parameter in LEAVES[command].params
        if getattr(parameter, "rich_help_panel", None)
    }
    assert panels
    assert HELP_ALL in short
    for panel in panels:
        assert f"─ {panel} ─" in full
        assert f"─ {panel} ─" not in short
        assert panel in short


@pytest.mark.parametrize("command", sorted(set(LEAVES) - set(LONG)))
def test_a_command_with_few_options_shows_all_of_them(command: str) -> None:
    declared = {
        (*parameter.opts, *parameter.secondary_opts)[0]
        for parameter in LEAVES[command].params
        if parameter.param_type_name == "option"
    }
    assert declared <= options_in(help_page(command, "--help", 300))


@pytest.mark.parametrize("command", ["extract", "intervene"])
def test_help_begins_with_what_is_used_most_and_has_examples(command: str) -> None:
    text = help_page(command, "--help")
    assert f"probe-kit {command} " in text.split("─ Options ─")[0], "an example"
    assert len(options_in(text.split("─ Options ─")[1])) <= MOST_OPTIONS + 2


@pytest.mark.parametrize("flag", [pytest.param("--help", marks=pytest.mark.slow), HELP_ALL])
def test_a_reader_of_help_that_has_enough_is_no_error(flag: str) -> None:
    command = [sys.executable, "-m", "probe_kit", "extract", flag]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert running.stdout is not None
    running.stdout.close()
    assert b"Error" not in running.communicate()[1]
