"""Dose and response: what the figure shows is what is stored."""

from collections.abc import Callable
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.outcomes import FORMAT
from probe_kit.retention import retention_table
from probe_kit.retention.displays import DoseResponseDisplay, collect_figures, dose_response
from probe_kit.retention.displays.dose_response import _share
from probe_kit.train import ArrayRun
from tests.intervene.answers import follower, outcomes_of, store_outcomes

mpl.use("agg")
SIGNAL = ([0.5, 0.9], [[0.7]])
EPISODES = 48


@pytest.fixture
def run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    return probed_run({"color": SIGNAL})


def steered(run: ArrayRun) -> None:
    """Toward the wrong side: half of the pushed turn at dose 2, all at dose 4; the control turns one in eight."""
    answers = outcomes_of({"color": follower(EPISODES)})
    plain, item = answers.of("clean"), np.arange(EPISODES)
    turned = {
        "mean-difference|0": item < 0, "mean-difference|2": item < EPISODES / 2, "mean-difference|4": item >= 0,
        "control-1|2": item < 0, "control-1|4": item % 8 == 0,
    }  # fmt: skip
    lateral = np.vstack([plain, *(np.where(which, -plain, plain) for which in turned.values())])
    answers = replace(
        answers,
        conditions=("clean", *(f"backbone.01|image|{name}" for name in turned)),
        displacement=lateral,
        max_action_change=np.abs(lateral - lateral[0]),
        edit_log=np.ones((*lateral.shape, 5)),
    )
    settings = {
        "format": FORMAT, "kind": "steer", "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": ["color"], "target_side": "wrong",
    }  # fmt: skip
    store_outcomes(run.location, run.suite, settings, answers)


def test_it_shows_episodes_that_turn_by_dose_and_side_beside_controls(run: ArrayRun) -> None:
    steered(run)
    display = DoseResponseDisplay.from_run(run, "color").plot()
    assert display.position == "backbone.01 image"
    np.testing.assert_allclose(display.coefficients, [0, 2, 4])
    np.testing.assert_allclose(display.net, [0, 50, 100])
    np.testing.assert_allclose((display.net_left + display.net_right) / 2, display.net)
    np.testing.assert_allclose(display.controls, [[np.nan, 0, 12.5]])
    np.testing.assert_allclose(display.relative_change, 1)
    assert display.significant.tolist() == [False, True, True]
    assert display.ax_ is not None
    labels = [line.get_label() for line in display.ax_.get_lines()]
    assert {"all episodes", "pushed to the left", "pushed to the right"} <= set(labels)
    assert len(display.ax_.collections) == 1
    assert [tick.get_text() for tick in display.ax_.get_xticklabels()] == ["0\n100 %", "2\n100 %", "4\n100 %"]
    names = [exhibit.name for exhibit in collect_figures([run], retention_table([run]))]
    assert any(name.endswith("doses") for name in names)
    assert len(dose_response(run).axes) == 1


def test_without_a_steering_there_is_no_such_figure(run: ArrayRun) -> None:
    for draw in (lambda: dose_response(run), lambda: DoseResponseDisplay.from_run(run, "color")):
        with pytest.raises(NoInterventionsError, match="--kind steer"):
            draw()
    assert not any(exhibit.name.endswith("doses") for exhibit in collect_figures([run], retention_table([run])))
    steered(run)
    with pytest.raises(NoInterventionsError, match=r"it has it at backbone\.01 image"):
        DoseResponseDisplay.from_run(run, "color", "backbone.02 image")


@pytest.mark.parametrize(
    ("ratio", "text"), [(0, "0 %"), (0.00006, "<0.1 %"), (0.0071, "0.71 %"), (0.24, "24 %"), (2.5, "250 %")]
)
def test_small_changes_of_the_tokens_are_not_written_as_none(ratio: float, text: str) -> None:
    assert _share(ratio) == text
