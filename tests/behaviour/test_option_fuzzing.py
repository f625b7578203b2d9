"""Whatever stands on the command line: a message and an exit code of the contract, never a traceback."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from probe_kit._system.escaping import UNSAFE
from probe_kit.cli import app, commands_of
from probe_kit.suite import Suite
from tests.support.little_run import write_little_run

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
HOSTILE = (
    "", " ", "-", "--", "-1", "0", "1", "3", "1.5", "nan", "inf", "-inf", "1e309", "9" * 40, "9" * 5000, "²", "٣",
    "a,b,,a", "=", "a=", "=b", "a=b", "x=x=x", "a=[[[", "color", "color,color", "mean", "tokens:x", "all",
    "none", "json", "csv", "h5", "cpu", "cuda:99", "float16", "[bold]x[/] [/b]", "\x1b[31mred", "\x1b]0;t\x07",
    "user\u202egnp", "\udcff\udc80", "two\nlines", "é" * 300, "a" * 5000, "s3://", "s3://x", "http://x/y", "file:///",
    "../../..", "/dev/null", "/dev/full", "/proc/self/mem", "/proc/1/root", "~nobody/x", "a-file", "a-file/below",
    "a-folder", "damaged", "a-run", "a-run/run.json", "SUITE", "224x224", "99999x99999", "axb", "expert",
)  # fmt: skip
ELSEWHERE = ("demo", "doctor", "verify", "power")
"""Commands that load or compute for long with any options; each has tests of its own."""
COMMANDS = {
    path: command for path, command in commands_of(typer.main.get_command(app), None) if path not in ELSEWHERE
}
ALWAYS = {"extract": ["--dry-run"], "ask": ["--dry-run"], "suite build": ["--n", "2", "--categories", "color"]}
NEVER = {
    "--baselines",
    "--power",
    "--suite",
    "--workers",
    "--dry-run",
    "--ray",
    "--jobs",
    "--help",
    "--emit-curation",
    "--model",
    "--checkpoint",
}
"""Options that would build the whole embedded suite, start processes or load networks; they come below."""


@pytest.fixture(scope="module", autouse=True)
def places(tmp_path_factory: pytest.TempPathFactory, small_suite: Suite) -> Iterator[Path]:
    """A folder to stand in, with files, folders, a run and a damaged one."""
    folder = tmp_path_factory.mktemp("fuzzed")
    (folder / "a-file").write_bytes(b"\x00\xff[[[")
    (folder / "a-folder").mkdir()
    write_little_run(folder / "runs" / "little", small_suite.select(["color"]), episodes=8)
    (folder / "a-run").symlink_to(folder / "runs" / "little")
    (folder / "damaged").mkdir()
    (folder / "damaged" / "run.json").write_bytes(b"[" * 99_999)
    (folder / "SUITE").symlink_to(small_suite.folder)
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


def option(parameter: Any) -> st.SearchStrategy[list[str]]:
    """One way to give a parameter, mostly a wrong one."""
    name = [] if parameter.param_type_name == "argument" else [[*parameter.opts, *parameter.secondary_opts][0]]
    if getattr(parameter, "is_flag", False):
        return st.just(name)
    return st.sampled_from(HOSTILE).map(lambda value: [*name, value])


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    path = draw(st.sampled_from(sorted(COMMANDS)))
    optional_folder = any(
        parameter.name == "folder" and not parameter.required for parameter in COMMANDS[path].params
    )
    usable = [
        parameter
        for parameter in COMMANDS[path].params
        if not NEVER & set(parameter.opts) and not (optional_folder and parameter.name == "folder")
    ]
    required = [parameter for parameter in usable if parameter.required]
    optional = [parameter for parameter in usable if not parameter.required] or usable
    extras = draw(st.lists(st.sampled_from(optional), max_size=3)) if optional else []
    given_options = [word for parameter in [*required, *extras] for word in draw(option(parameter))]
    if any("--model" in parameter.opts for parameter in COMMANDS[path].params):
        given_options += ["--model", draw(st.sampled_from(("expert", "pi0-tyni", "\x1b[31m", "[red]", "")))]
    if any("--suite" in parameter.opts for parameter in COMMANDS[path].params):
        given_options += ["--suite", draw(st.sampled_from(("SUITE", "SUITE", "a-file", "a-folder", "\x1b[31m")))]
    if optional_folder:
        given_options += [draw(st.sampled_from(("SUITE", "a-file", "a-folder", "\x1b[31m", "a" * 5000)))]
    hostile_words = draw(st.lists(st.sampled_from(HOSTILE), max_size=1))
    return [*path.split(), *ALWAYS.get(path, []), *given_options, *hostile_words]


def holds(words: list[str]) -> None:
    answer = CliRunner().invoke(app, words)
    printed = answer.output
    assert answer.exception is None or isinstance(answer.exception, SystemExit), words
    assert answer.exit_code in (0, 1, 2, 3), (words, printed)
    assert "Traceback" not in printed, (words, printed)
    assert "InternalError" not in printed, (words, printed)
    assert not UNSAFE.search(printed), (words, printed)


FUZZED = {"deadline": None, "suppress_health_check": list(HealthCheck), "print_blob": True}


@given(command_lines())
@settings(max_examples=15, **FUZZED)
def test_any_command_line_ends_in_a_message(words: list[str]) -> None:
    holds(words)


@pytest.mark.slow
@given(command_lines())
@settings(max_examples=3000, **FUZZED)
def test_any_of_thousands_of_command_lines_ends_in_a_message(words: list[str]) -> None:
    holds(words)


@pytest.mark.parametrize(
    "words",
    [
        ["retention", "a-run", "--iterations", "²"],
        ["retention", "a-run", "--epsilons", "nan"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--picture-size", "²x²", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--light-level", "inf", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--light-level", "nan", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--max-steps", "9" * 40, "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--batch", "999999999", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--label", "\x1b[31m", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--background", "/proc/self/mem", "--dry-run"],
        ["extract", "--model", "expert", "--suite", "SUITE", "--arm-urdf", "a-file", "--dry-run"],
        ["power", "--items", "²"],
        ["power", "--signal", "nan"],
        ["power", "--power", "nan"],
        ["power", "--width", "nan"],
        ["suite", "convert", "iconqa", "--root", "a-folder", "--out", "new", "-o", "a=1", "-o", "a=2"],
        ["verify", "pi0", "a-folder"],
        ["verify", "pi0", "--keys", "a-folder"],
    ],
    ids=" ".join,
)
def test_values_that_no_number_or_file_can_be_are_wrong_usage(words: list[str]) -> None:
    holds(words)
    assert CliRunner().invoke(app, words).exit_code == 2
