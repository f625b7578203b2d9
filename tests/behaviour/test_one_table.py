"""What `demo`, `train`, `retention` and `intervene` print: one table at any width, and last the finding."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit._terminal.console import out
from probe_kit.cli import app
from probe_kit.demo.commands import print_demo
from probe_kit.demo.pipeline import Demo
from probe_kit.intervene import load_effects
from probe_kit.intervene.commands import print_result
from probe_kit.retention import retention_table
from probe_kit.runs import open_run

WIDTHS = (80, 100, 120, 200)
LAST = 40
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def run(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(little_runs / "run", tmp_path_factory.mktemp("printed") / "run")


def command(*arguments: str) -> str:
    answer = CliRunner().invoke(app, list(arguments))
    assert answer.exit_code == 0, answer.output
    return answer.stdout


def demo(run: Path) -> None:
    opened = open_run(run)
    print_demo(Demo(run.parent, opened, opened, retention_table([opened])))


PRINTED: dict[str, Callable[[Path], str | None]] = {
    "demo": demo,
    "train": lambda run: command("train", str(run), "--permutations", "2", "--views", "mean,last"),
    "train every call": lambda run: command("train", str(run), "--permutations", "2", "--call", "all"),
    "retention": lambda run: command("retention", str(run)),
    "intervene": lambda run: print_result(load_effects(open_run(run))),
}


def printed(name: str, run: Path, width: int, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(out, "_width", width)
    capsys.readouterr()
    return PRINTED[name](run) or capsys.readouterr().out


def tables_in(text: str) -> int:
    """Tables by the rules under their headings."""
    return len(re.findall(r"^─{20,} *$", text, re.MULTILINE))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PRINTED)
def test_a_command_prints_one_table_and_ends_on_a_sentence(
    name: str, width: int, run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, opens, viewer = printed(name, run, width, capsys, monkeypatch).partition("\nOpen ")
    assert bool(opens) == (name == "demo"), "the demo alone adds the command that opens the viewer"
    assert viewer.strip().startswith("probe-kit view ") or not opens
    assert tables_in(text) == 1, text
    assert max(map(len, text.split("category")[1].splitlines())) <= width
    *_, last = re.split(r"\nColor (?:\(| )", text)
    assert re.search(r"\.$|\nnext: probe-kit \w+", last.strip()), (
        "a sentence about the only category is last, then a command"
    )
    assert len(last.splitlines()) < LAST


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", ["train", "intervene"])
def test_columns_that_do_not_fit_are_named_and_details_prints_them(
    name: str, width: int, run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = " ".join(printed(name, run, width, capsys, monkeypatch).split())
    (left_out,) = re.findall(r"[Ww]ith --details or more room: ([^.]*?)\.? Color ", short) or [""]
    details: dict[str, Callable[[], str | None]] = {
        "train": lambda: command("train", str(run), "--permutations", "2", "--views", "mean,last", "--details"),
        "intervene": lambda: print_result(load_effects(open_run(run)), details=True),
    }
    whole = details[name]() or capsys.readouterr().out
    assert left_out or width > 80, short
    for heading in filter(None, left_out.split(", ")):
        assert heading in " ".join(whole.split())


def test_the_demo_fits_summary_and_sentences_on_its_last_lines(
    run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for width in WIDTHS:
        lines = printed("demo", run, width, capsys, monkeypatch).splitlines()[-LAST:]
        assert any(line.startswith("Summary: ") for line in lines)
        assert any(re.match(r"Color  \w.*: ", line) for line in lines)
