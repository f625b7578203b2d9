"""Names that others chose reach the terminal as text, in every command that shows them."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from probe_kit._system.escaping import UNSAFE
from probe_kit.cli import app
from probe_kit.hooks import registry
from probe_kit.hooks.family import Family
from probe_kit.suite import Suite
from tests.support.little_run import write_little_run

NAME = "[bold]x[red] [no-end] \x1b[31m\u202e\x9b2J"
SHOWN = "[bold]x[red] [no-end] ␛[31m\ufffd\ufffd2J"
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in a folder of that name."""
    run_folder = tmp_path_factory.mktemp("hostile") / NAME
    return write_little_run(run_folder, small_suite.select(["color"]), episodes=8).path


def printed_text(*words: object) -> str:
    answer = CliRunner().invoke(app, list(map(str, words)))
    assert "InternalError" not in answer.output
    assert "Traceback" not in answer.output
    assert not UNSAFE.search(answer.output), answer.output
    return " ".join(answer.output.split())


@pytest.mark.parametrize(
    "words",
    [
        ("run", "verify"), ("run", "verify", "--deep"), ("run", "verify", "--json"), ("run", "show"),
        ("run", "show", "--json"), ("run", "verify", "--seal"), ("retention",), ("retention", "--format", "json"),
        ("retention", "--format", "csv"), ("retention", "--format", "latex"),
        ("retention", "--format", "markdown"),
        ("models", "--run"), ("train", "--views", "nothing"), ("run", "export", "--format", "nothing"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_run_of_a_hostile_name_is_shown_as_text(run: Path, words: tuple[str, ...]) -> None:
    printed_text(*words, run)


@pytest.mark.parametrize(
    "words",
    [
        ("run", "show", NAME), ("retention", NAME), ("train", NAME), ("run", "export", NAME, "--format", "h5"),
        ("models", "--run", NAME), ("suite", "show", "--counts", NAME), ("suite", "validate", NAME),
        ("suite", "show", NAME), ("extract", "--model", "expert", "--suite", NAME),
    ],
    ids=lambda words: " ".join(words[:2]),
)  # fmt: skip
def test_a_path_that_is_not_there_is_named_as_text(words: tuple[str, ...], tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert SHOWN in printed_text(*words)


def test_a_suite_in_a_folder_of_a_hostile_name_is_shown_as_text(small_suite: Suite, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(small_suite.folder, tmp_path / NAME))
    printed_text("suite", "show", "--counts", folder)
    (folder / "suite.json").write_text(f'{{"schema_version": "{SHOWN}"}}', encoding="utf-8")
    assert "[bold]x[red] [no-end]" in printed_text("suite", "validate", folder)


def test_what_a_third_party_says_of_its_family_is_shown_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    family = Family("mine", NAME, None, "x:y", streams=NAME, notes=NAME)
    package = SimpleNamespace(name="theirs", metadata={"Summary": NAME})
    entry = SimpleNamespace(name="mine", value="x:FAMILY", load=lambda: family, dist=package)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    assert printed_text("models", "mine").count(SHOWN) == 3
    assert "[bold]x" in printed_text("models")
