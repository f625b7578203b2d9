"""What `probe-kit retention` refuses, and how it names probes, before it reads a run."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.commands import _keys
from probe_kit.runs import open_run
from probe_kit.train import ArrayRun
from probe_kit.train.results.inventory import inventory

PATHS = ["runs/pi0", "elsewhere/smolvla/", "s3://bucket/study/run"]


@pytest.mark.parametrize(
    ("chosen", "keys"),
    [
        ([], [None, None, None]),
        (["runs/pi0=abc"], ["abc", None, None]),
        (["./runs/pi0/=abc", "smolvla=def"], ["abc", "def", None]),
        (["s3://bucket/study/run=123"], [None, None, "123"]),
    ],
)
def test_a_run_goes_by_its_path_or_by_the_name_of_its_folder(chosen: list[str], keys: list[str | None]) -> None:
    assert _keys(PATHS, chosen) == keys


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (["abc"], "is not RUN=KEY"),
        (["runs/pi0="], "is not RUN=KEY"),
        (["other=abc"], "other is none of the runs"),
        (["pi0=abc", "runs/pi0=def"], "twice"),
    ],
)
def test_what_names_no_run_or_two_keys_is_refused(chosen: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        _keys(PATHS, chosen)


@pytest.mark.parametrize(
    "options",
    [
        ["nowhere", "--iterations", "first"],
        ["nowhere", "--epsilons", "wide"],
        ["nowhere", "--html", "."],
        ["nowhere", "--figures", __file__],
        ["nowhere", "--compare", "steps="],
        ["nowhere", "--compare", "vlm-vla=x"],
    ],
    ids=" ".join,
)
def test_options_are_checked_before_runs_are_opened(options: list[str]) -> None:
    """The run is not there either, but that is not what is said."""
    result = CliRunner().invoke(app, ["retention", *options])
    assert result.exit_code == 2
    assert "nowhere" not in result.stderr
    assert "UsageError" in result.stderr


def test_a_folder_that_is_no_run_has_nothing_to_show(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["run", "show", str(tmp_path)])
    assert result.exit_code == 2
    assert "is not a run" in result.stderr


def test_the_inventory_names_the_probes_of_a_table(
    probed_run: Callable[..., ArrayRun],
) -> None:
    run = probed_run({"color": ([0.5, 0.9], [[0.6]])})
    (probes,) = inventory(run).probes
    assert (probes.state, probes.views, probes.permutations) == ("used", ("mean",), 99)


@pytest.mark.parametrize(
    "options",
    [
        ["--compare", "groups"],
        ["--score", "order-balanced"],
        ["--compare", "vlm-vla"],
        ["--details", "all"],
        ["--html", "r.html"],
    ],
    ids=" ".join,
)
def test_the_papers_own_numbers_refuse_what_the_paper_does_not_have(options: list[str]) -> None:
    result = CliRunner().invoke(app, ["retention", "nowhere", "--as-paper", *options])
    assert result.exit_code == 2
    assert "--as-paper" in result.stderr


@pytest.mark.parametrize("style", ["table", "json", "csv", "markdown", "latex"])
def test_the_papers_own_numbers_are_printed_in_every_format(little_runs: Path, style: str) -> None:
    result = CliRunner().invoke(app, ["retention", str(little_runs / "run"), "--as-paper", "--format", style])
    assert result.exit_code == 0, result.stderr
    assert "color" in result.stdout.lower()
    if style == "json":
        rows = json.loads(result.stdout)
        table = retention_table([open_run(little_runs / "run")])
        assert [row["backbone"] for row in rows] == [row.backbone.peak for row in table.all_rows]
        assert all(row["margin"] == pytest.approx(0.98 / row["episodes"] ** 0.5, rel=1e-4) for row in rows[:1])
