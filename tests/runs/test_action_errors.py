"""Predicted beside recorded actions: numbers by hand, and refusals where the two are not the same."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import r2_score
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.runs import ActionErrors, Run, compare_actions, open_run
from probe_kit.runs.layout import DATASET, OTHER_ACTIONS
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.train.builtin_columns import label_frame
from tests.support.recorded_run import ACTION, CALLS, CHUNK, EVERY, SHORT, recorded_plan, write_recorded_run


@pytest.fixture(scope="module")
def errors(shown_run: Run) -> ActionErrors:
    return compare_actions(shown_run)


def actions(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """(n, chunk, D) recorded and predicted, of the shown frames."""
    assert run.inputs is not None
    recorded, predicted = (run.inputs.read(kind).astype(np.float64) for kind in ("action", "prediction"))
    shown = np.isfinite(recorded[:, :, 0, 0])
    return recorded[shown], predicted[shown]


def test_the_error_of_a_number_is_what_its_r2_says(shown_run: Run, errors: ActionErrors) -> None:
    """In deviations of what was recorded, the squared error is 1 − R²: the mean recorded action has 1."""
    recorded, predicted = actions(shown_run)
    table = errors.by_number.set_index("number")
    assert list(table.index) == ["dx", "grip"]
    for place, name in enumerate(table.index):
        expected = 1 - r2_score(recorded[:, 0, place], predicted[:, 0, place])
        assert table.loc[name, "first"] ** 2 == pytest.approx(expected)
        assert table.loc[name, "deviation"] == pytest.approx(recorded[:, 0, place].std())
        squares = ((predicted - recorded)[:, :, place] / recorded[:, 0, place].std()) ** 2
        assert table.loc[name, "chunk"] == pytest.approx(np.sqrt(squares.mean()))


def test_frames_and_episodes_have_errors_of_their_own(shown_run: Run, errors: ActionErrors) -> None:
    frames, episodes = errors.by_frame, errors.by_episode
    assert len(frames) == 12 * CALLS - 1
    assert list(frames["frame"][:CALLS]) == [EVERY * call for call in range(CALLS)]
    recorded, predicted = actions(shown_run)
    scaled = (predicted - recorded) / recorded[:, 0].std(axis=0)
    np.testing.assert_allclose(frames["first"], np.sqrt((scaled[:, 0] ** 2).mean(axis=1)))
    np.testing.assert_allclose(frames["chunk"], np.sqrt((scaled**2).mean(axis=(1, 2))))
    assert episodes["frames"].tolist() == [CALLS - (number == SHORT) for number in range(12)]
    own = frames[frames["source_episode"] == 3]["first"]
    assert episodes["first"][3] == pytest.approx(np.sqrt((own**2).mean()))


def test_the_error_of_a_frame_is_a_label(shown_run: Run, errors: ActionErrors) -> None:
    np.testing.assert_allclose(label_frame(shown_run)["dataset.action_error"], errors.by_frame["first"])


def test_steps_behind_the_end_of_a_recording_and_constant_numbers_count_nowhere(errors: ActionErrors) -> None:
    cut = errors.errors.copy()
    cut[0, 0, 1:] = np.nan
    found = replace(errors, errors=cut, deviations=np.array([errors.deviations[0], 0.0]))
    assert found.by_frame["chunk"][0] == pytest.approx(found.by_frame["first"][0])
    assert np.isnan(found.by_number["first"][1])
    assert np.isfinite(found.by_frame["first"]).all()


@pytest.mark.parametrize(
    ("inputs", "reason", "message"),
    [
        ({"action": [CHUNK, ACTION + 1]}, None, "the policy predicts 2 numbers, the data set has 3"),
        ({}, "recorded actions lie outside the statistics", "not compared: recorded actions lie outside"),
        ({"action": None}, None, "the data set has no actions"),
    ],
)
def test_actions_that_are_not_the_same_numbers_are_not_compared(
    tmp_path: Path, inputs: dict[str, list[int] | None], reason: str | None, message: str
) -> None:
    plan = recorded_plan(3)
    data_set, chosen = plan.identity[DATASET], plan.selection["recording"]
    shapes = {name: shape for name, shape in {**data_set["inputs"], **inputs}.items() if shape is not None}
    plan = replace(
        plan,
        identity={DATASET: {**data_set, "inputs": shapes}},
        selection={"recording": {**chosen, OTHER_ACTIONS: reason}},
    )
    settings = {
        "model": "shown", "weights_sha256": "0" * 64, "random_weights": False, "captured_calls": CALLS,
        "tokens": "pooled", "codec": "zstd", "seed": 0, "capture_only": True, **plan.identity,
    }  # fmt: skip
    RunWriter(locate(tmp_path / "run"), plan, settings)
    with pytest.raises(UsageError, match=message):
        compare_actions(open_run(tmp_path / "run", allow_partial=True))


def test_a_run_of_scenes_has_no_recorded_actions(labelled_run: Path) -> None:
    with pytest.raises(UsageError, match="no recorded actions"):
        compare_actions(open_run(labelled_run))


def test_the_command_prints_a_line_per_number_and_json_every_episode(
    tmp_path: Path,
) -> None:
    run = write_recorded_run(tmp_path / "run", 3)
    command = ["run", "show", str(run.path), "--action-errors"]
    shown = CliRunner().invoke(app, command).stdout
    assert "dx" in shown
    assert "12 frames" in shown
    found = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert [row["number"] for row in found["numbers"]] == ["dx", "grip"]
    assert [row["source_episode"] for row in found["episodes"]] == [0, 1, 2]
