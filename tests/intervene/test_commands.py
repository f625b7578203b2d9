"""`probe-kit intervene`: what it prints of what is stored, and what it refuses before anything is loaded."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.intervene import ImageSwap
from probe_kit.intervene.settings import settings_of
from probe_kit.runs import Run
from tests.intervene.answers import follower, habit, outcomes_of, store_outcomes


@pytest.fixture
def run(recorded_run: Run, tmp_path: Path) -> Run:
    """With a stored intervention whose answers are made up."""
    from probe_kit.runs import open_run

    copy = open_run(shutil.copytree(recorded_run.path, tmp_path / "run"))
    outcomes = outcomes_of({"color": follower(24), "shape": habit(24)})
    settings = settings_of(ImageSwap(), copy)
    certificate = {"replay": {"episodes": 48, "compared": 48, "equal": 47, "largest_difference": 1e-7}}
    store_outcomes(copy.location, copy.seed_text, settings, outcomes, certificate)
    return copy


def ask(run: Run | str, *options: str) -> tuple[int, str, str]:
    answer = CliRunner().invoke(app, ["intervene", str(run if isinstance(run, str) else run.path), *options])
    return answer.exit_code, answer.stdout, answer.stderr


def test_the_table_says_what_follows(run: Run) -> None:
    code, output, message = ask(run)
    assert code == 0
    assert "follow %" in output
    assert "100.0" in output
    assert "random weights" in output
    assert "47 of 48 clean inferences" in message


@pytest.mark.slow
def test_intervene_says_that_it_loads_stored_results_whatever_policy_is_named(run: Run) -> None:
    code, _, message = ask(run, "--checkpoint", "/nowhere", "--suite", "/nowhere")
    assert code == 0
    assert "loaded the stored result; no model was run" in " ".join(message.split())


def test_json_holds_settings_and_effects(run: Run) -> None:
    code, output, _ = ask(run, "--format", "json")
    answer = json.loads(output)
    assert code == 0
    assert [row["category"] for row in answer["effects"]] == ["color", "shape"]
    assert answer["effects"][0]["follow_p"] == 2.0**-12
    assert answer["settings"]["kind"] == "image-swap"


def test_csv_is_what_is_stored_with_the_verdict(run: Run) -> None:
    _, output, _ = ask(run, "--format", "csv")
    header, first, *_ = output.splitlines()
    assert header.endswith("verdict,behaviour,reversed,reason,where,tie")
    assert first.startswith("color,24,12,12,1.0,0.0,1.0,")


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (("--kind", "wish"), 2, "is not one of"),
        (("--format", "xml"), 2, "is not one of"),
        (("--categories", "colour"), 2, "color, shape"),
        (("--items", "0"), 2, "at least 1"),
        (("--wording", "named"), 2, "no wording"),
        (("--items", "3", "--suite", "nowhere"), 2, "is not a suite"),
    ],
)
def test_intervene_refuses_impossible_options(run: Run, options: tuple[str, ...], code: int, words: str) -> None:
    ended, _, message = ask(run, *options)
    assert ended == code
    assert words in message


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    code, _, message = ask(str(tmp_path))
    assert code == 2
    assert "is not a run" in message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--coefficients", "1"), "--coefficients does not apply to --kind image-swap"),
        (("--kind", "interchange", "--target-side", "left"), "--target-side does not apply"),
        (("--kind", "steer"), "needs --sites"),
        (("--kind", "steer", "--sites", "backbone.02", "--roles", "image,language"), "one of --roles"),
        (
            ("--kind", "steer", "--sites", "backbone.02", "--roles", "image", "--coefficients", "much"),
            "expected numbers",
        ),
        (("--kind", "interchange", "--controls", "2"), "choose --direction"),
        (("--kind", "erase"), "needs --sites"),
        (("--kind", "erase", "--sites", "backbone.02", "--direction", "zap"), "expected leace"),
        (
            ("--kind", "erase", "--sites", "backbone.02", "--coefficients", "1"),
            "--coefficients does not apply to --kind erase",
        ),
    ],
)
def test_options_of_another_kind_are_refused(run: Run, options: tuple[str, ...], words: str) -> None:
    code, _, message = ask(run, *options)
    assert code == 2
    assert words in " ".join(message.split())


@pytest.mark.slow
def test_a_closed_loop_needs_a_located_place_or_a_named_one(run: Run) -> None:
    for options, words in (
        ((), "--kind interchange"),
        (("--roles", "image"), "go with --sites"),
        (("--coefficients", "1"), "--coefficients does not apply to --kind closed-loop"),
        (("--sites", "backbone.02", "--direction", "none", "--controls", "1"), "--controls 0"),
        (("--sites", "backbone.02", "--suite", "nowhere"), "is not a suite"),
    ):
        code, _, message = ask(run, "--kind", "closed-loop", *options)
        assert code == 2
        assert words in " ".join(message.split())
