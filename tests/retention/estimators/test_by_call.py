"""Accuracy over captured calls, and counted from what happens in each episode."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from probe_kit.env.scoring import CHANNELS, EVENTS, Trajectory
from probe_kit.errors import UsageError
from probe_kit.retention.displays import CallCurveDisplay, aligned_curves, call_curves
from probe_kit.retention.displays.call_curves import CallCurves, event_calls
from probe_kit.train import ArrayRun, ProbeCurve, ProbeResults, load_results

EXECUTED = 4
GRASPS = (3, 11)
"""Action at which the first and second half of the episodes grasp: inference 0 and 2 come before."""


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.fixture
def by_call(probed_run: Callable[..., ArrayRun], curve_of: Callable[..., ProbeCurve]) -> dict[int, ProbeResults]:
    """The answer appears at call 2: nothing, nothing, 90 %, 90 %."""
    run = probed_run({"color": ([0.5, 0.5], [[0.5]])})
    first = load_results(run)
    accuracies = {0: 0.5, 1: 0.52, 2: 0.9, 3: 0.9}
    return {
        call: replace(
            first,
            settings=replace(first.settings, call=call),
            curves={("color", "mean"): curve_of(run.episodes, [0.5, accuracy], [[accuracy - 0.02]])},
        )
        for call, accuracy in accuracies.items()
    }


def still(held_from: int) -> Trajectory:
    """Nothing but a grasp."""
    frames = np.zeros((20, len(CHANNELS)), np.float32)
    frames[:, CHANNELS.index("tile_left.y")] = 0.155
    frames[held_from:, CHANNELS.index("held.bool")] = 1
    return Trajectory.of_frames(frames)


@pytest.fixture
def watched(by_call: dict[int, ProbeResults]) -> Any:
    """A run that keeps trajectories of the episodes that were probed."""
    episodes = by_call[0].curves["color", "mean"].episodes
    half = len(episodes) // 2
    return SimpleNamespace(
        has_trajectories=True,
        settings={"execute": EXECUTED},
        episodes=pd.DataFrame({"episode_id": episodes, "category": "color"}),
        trajectories=[still(GRASPS[number >= half]) for number in range(len(episodes))],
    )


def test_a_line_has_the_best_site_of_every_call_filled_where_it_is_evidence(
    by_call: dict[int, ProbeResults],
) -> None:
    curves = CallCurves.of(by_call, "color", "mean")
    assert curves.streams == ("backbone", "expert")
    line = curves.line("backbone")
    assert line.calls.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(line.accuracy[2:], 0.9)
    np.testing.assert_allclose(line.accuracy[:2], 0.5, atol=0.03, err_msg="without the luck of the best site")
    assert line.significant.tolist() == [False, False, True, True]
    assert ((line.low < line.accuracy) & (line.accuracy < line.high)).all()
    assert line.null == pytest.approx([0.59] * 4, abs=0.01)
    assert line.episodes.tolist() == [200] * 4
    assert curves.line("expert").part == "action"


def test_an_event_falls_to_the_inference_before_the_action_that_brought_it_about(watched: Any) -> None:
    calls = event_calls(watched)
    assert set(calls) == set(EVENTS)
    assert sorted(set(calls["grasp"].values())) == [0, 2]
    assert calls["release"] == {}
    for action, call in ((1, 0), (4, 0), (5, 1), (8, 1), (9, 2)):
        watched.trajectories = [still(action)] * len(watched.episodes)
        assert set(event_calls(watched)["grasp"].values()) == {call}, action


def test_aligned_accuracies_pool_the_calls_at_one_distance_from_the_event(
    by_call: dict[int, ProbeResults], watched: Any
) -> None:
    curves = CallCurves.of(by_call, "color", "mean", event_calls(watched))
    line = curves.aligned("backbone", "grasp")
    assert line is not None
    assert line.offsets.tolist() == [-2, -1, 0, 1, 2, 3]
    assert line.episodes.tolist() == [100, 100, 200, 200, 100, 100]
    probed = {call: call_results.curves["color", "mean"] for call, call_results in by_call.items()}
    right = {call: curve.nested_correct(curve.stream("backbone")) for call, curve in probed.items()}
    early, late = slice(None, 100), slice(100, None)
    expected = [
        right[0][late].mean(), right[1][late].mean(), (right[0][early].sum() + right[2][late].sum()) / 200,
        (right[1][early].sum() + right[3][late].sum()) / 200, right[2][early].mean(), right[3][early].mean(),
    ]  # fmt: skip
    np.testing.assert_allclose(line.accuracy, expected)
    assert curves.aligned("backbone", "release") is None
    (times,) = curves.event_times()
    assert (times.event, times.median, times.low, times.high, times.share) == ("grasp", 1.0, 0.0, 2.0, 1.0)


@pytest.mark.slow
def test_a_run_without_trajectories_has_curves_and_no_events(
    by_call: dict[int, ProbeResults], tmp_path: Path
) -> None:
    display = CallCurveDisplay.from_results(
        by_call, "color", events=event_calls(SimpleNamespace(has_trajectories=False))
    )
    assert display.events == ()
    with pytest.raises(UsageError, match="event 'grasp', or no trajectories; there are: none"):
        display.plot_aligned("grasp")
    display.plot().ax_.figure.savefig(tmp_path / "calls.png")


def test_figures_name_events_and_what_they_are_of(by_call: dict[int, ProbeResults], watched: Any) -> None:
    figure = call_curves(by_call, events=event_calls(watched))
    axes = figure.axes[0]
    assert "grasp" in {text.get_text() for text in axes.texts}
    assert axes.get_xlabel().startswith("call (captured inference")
    around = aligned_curves(by_call, "grasp", events=event_calls(watched))
    assert around.axes[0].get_title(loc="left") == "Color: grasp"
    assert "pi0" in around.caption  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="'release'"):
        aligned_curves(by_call, "release", events=event_calls(watched))


def test_one_call_is_no_curve(by_call: dict[int, ProbeResults]) -> None:
    with pytest.raises(UsageError, match="train --call all"):
        CallCurves.of({0: by_call[0]}, "color", "mean")
    with pytest.raises(UsageError, match="call 0 has no probes of category 'shape'"):
        CallCurves.of(by_call, "shape", "mean")
