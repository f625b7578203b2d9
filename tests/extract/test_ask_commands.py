"""`probe-kit ask`: what it plans, prints and refuses."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from probe_kit.cli import app
from probe_kit.suite import Suite
from tests.support.prismatic_checkpoints import write_checkpoint


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("vlm") / "tiny", model_type="prismatic")


def ask(suite: Suite, folder: Path, *arguments: str) -> Result:
    few = ["--suite", str(suite.folder), "--categories", "color", "--items", "2", "--env-workers", "0"]
    model = ["--model", "prismatic", "--checkpoint", str(folder), "-M", "tokenizer=bytes"]
    return CliRunner().invoke(app, ["ask", *model, *few, *arguments])


def test_a_run_per_prompt_and_size_is_planned_and_nothing_is_written(
    small_suite: Suite, folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "runs"
    sizes = ("--picture-size", "224x224,560x480")
    result = ask(small_suite, folder, "--prompt", "p2,seen", *sizes, "--out", str(out), "--dry-run")
    assert result.exit_code == 0, result.output
    for name in ("p2-224x224", "p2-560x480", "seen-224x224", "seen-560x480"):
        assert name in "".join(result.output.split())
    assert not out.exists()


def test_it_says_how_answers_came_and_what_to_do_next(small_suite: Suite, folder: Path, tmp_path: Path) -> None:
    result = ask(small_suite, folder, "--prompt", "p1", "--picture", "none", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(tmp_path / "p1-224x224-none")
    said = " ".join(result.stderr.split())
    assert "p1 · no picture: " in said
    assert "option mass 0." in said
    assert "next: probe-kit retention" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--prompt", "p3"), "no prompt 'p3'; known: seen, p1, p2"),
        (("--prompt", ","), "--prompt is empty"),
        (("--picture-size", "big"), "not WIDTHxHEIGHT"),
        (("--query", "absent", "--prompt", "p2"), "p2 does not ask for yes or no"),
        (("--batch", "0"), "batch is 0; expected at least 1"),
    ],
)
def test_what_is_wrong_with_the_question_is_said_at_once(
    small_suite: Suite, folder: Path, arguments: tuple[str, ...], words: str
) -> None:
    result = ask(small_suite, folder, *arguments)
    assert result.exit_code == 2, result.output
    assert words in " ".join(result.stderr.split())
