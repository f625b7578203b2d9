"""Windows that begin at an event: which inferences they hold, and what corresponds between episodes."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.runs import Run, open_run
from probe_kit.train import Target, train_probes
from probe_kit.train.controls.features import step_features
from probe_kit.train.data.samples import read_samples
from probe_kit.train.problem import make_problem
from probe_kit.train.target_samples import target_samples
from tests.support.labelled_run import CALLS
from tests.train.conftest import settings_of

GRASPED = 2
"""The inference at frame 6 is the first at which the cube is held."""


@pytest.fixture(scope="module")
def run(labelled_run: Path) -> Run:
    return open_run(labelled_run)


def table_of(run: Run) -> pd.DataFrame:
    """An event at inference 0, 1 or 2 of each episode in turn; the label is the number of inferences since."""
    rows = [
        {"episode_id": name, "inference": call, "open": call >= number % 3, "since": float(call - number % 3)}
        for number, name in enumerate(run.episodes["episode_id"])
        for call in range(CALLS if number + 1 < len(run.episodes) else 2)
    ]
    return pd.DataFrame(rows)


def test_a_window_begins_where_the_cube_is_first_held(run: Run) -> None:
    labels, event = Target.of_run(run, "sim.tool_y"), Target.of_run(run, "sim.held")
    samples = target_samples(run, labels, None, 0, None, event)
    assert samples.window == CALLS - GRASPED
    assert set(samples.inferences.tolist()) == {GRASPED, GRASPED + 1}
    assert samples.left_out == {
        "episodes in which sim.held is never true": 1,
        "labels outside the window of 2": GRASPED * (len(run.episodes) - 1),
    }
    expected = [
        run.trajectory(int(row)).tool[3 * call, 1]
        for row, call in zip(samples.rows, samples.inferences, strict=True)
    ]
    np.testing.assert_allclose(samples.values, expected, rtol=1e-6)
    features = read_samples(run, "mean", run.sites("backbone")[1], samples.rows, samples.inferences).features
    np.testing.assert_allclose(features[:, 3], 10 * samples.values, rtol=1e-5)


def test_an_event_may_be_a_value_of_a_column_of_classes(run: Run) -> None:
    phase = Target.of_run(run, "sim.phase")
    samples = target_samples(run, Target.of_run(run, "sim.tool_y"), None, 0, None, phase.equal_to("after release"))
    assert (samples.window, set(samples.inferences.tolist())) == (1, {3})
    assert samples.left_out == {
        "episodes in which sim.phase=after release is never true": 1,
        "labels outside the window of 1": 3 * (len(run.episodes) - 1),
    }
    with pytest.raises(UsageError, match="no value 'landed'; it has after release, before grasp, holding"):
        phase.equal_to("landed")
    with pytest.raises(UsageError, match="quantities, not classes"):
        Target.of_run(run, "sim.tool_y").equal_to("0")


def test_inferences_correspond_by_their_place_behind_the_event(run: Run) -> None:
    table = table_of(run)
    labels, event = Target.read(table, "since", "continuous"), Target.read(table, "open")
    samples = target_samples(run, labels, None, 0, 2, event)
    assert (samples.values == samples.steps).all()
    assert set(samples.inferences.tolist()) == {0, 1, 2, 3}
    assert (step_features(samples).argmax(axis=1) == samples.steps).all()
    with pytest.warns(UserWarning, match="the same in every group"):
        problem = make_problem(run, labels, samples, "all", settings_of(19))
    columns = np.column_stack([problem.labels, problem.permuted_labels])
    assert (columns == samples.steps[:, None]).all(), "labels of one place stay at that place"


def test_episodes_that_end_too_soon_behind_the_event_are_left_out(run: Run) -> None:
    table = table_of(run)
    labels, event = Target.read(table, "since", "continuous"), Target.read(table, "open")
    samples = target_samples(run, labels, None, 0, 3, event)
    late = sum(number % 3 == 2 for number in range(len(run.episodes) - 1))
    assert samples.left_out["episodes that end within 3 inferences of it"] >= late
    assert np.bincount(samples.rows)[np.unique(samples.rows)].tolist() == [3] * np.unique(samples.rows).size


def test_what_is_no_event_is_refused(run: Run) -> None:
    table = table_of(run)
    labels = Target.read(table, "since", "continuous")
    with pytest.raises(UsageError, match=r"'since' .*aligned to .*sim.phase.*expected .* true and false"):
        target_samples(run, labels, None, 0, None, Target.of_run(run, "sim.phase"))
    with pytest.raises(UsageError, match="expected labels per inference"):
        target_samples(run, Target.of_run(run, "item.named"), None, 0, None, Target.read(table, "open"))
    said = CliRunner().invoke(app, ["train", str(run.path), "--align-to", "sim.held"])
    assert "--align-to is for labels of your own" in " ".join(said.stderr.split())


def test_the_event_is_part_of_the_results_key(run: Run, tmp_path: Path) -> None:
    copy = open_run(shutil.copytree(run.path, tmp_path / "run"))
    labels, event = Target.of_run(copy, "sim.tool_y"), Target.of_run(copy, "sim.held")
    plain = train_probes(copy, target=labels, permutations=0, controls=(), window=2)
    aligned = train_probes(copy, target=labels, permutations=0, controls=(), window=2, align_to=event)
    assert plain.key != aligned.key
    assert plain.settings.align_to == ""
    assert aligned.settings.align_to.startswith("sim.held#")
    answer = CliRunner().invoke(
        app,
        ["train", str(copy.path), "--target", "sim.tool_y", "--align-to", "sim.phase=holding", "--permutations",
         "0", "--window", "2", "--controls", "none"],
        env={"COLUMNS": "200"},
    )  # fmt: skip
    assert "from sim.phase=holding on" in " ".join(answer.stdout.split())
