"""Scales are the same whatever is shown: an untrained network's best guess never looks like knowledge."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.retention import IterationMapDisplay, LayerCurveDisplay, RoleCurvesDisplay, retention_table
from probe_kit.retention.displays import (
    collect_figures,
    curves_side_by_side,
    iteration_maps,
    layer_curve,
    maps_side_by_side,
    model_depths,
)
from probe_kit.retention.displays.knowledge_action import KnowledgeActionDisplay
from probe_kit.train import ArrayRun, ProbeResults, load_results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ProbedRun = Callable[..., ArrayRun]
KNOWS = ([0.5, 1.0, 0.9], [[0.6, 0.8], [0.9, 1.0]])
GUESSES = ([0.5, 0.55, 0.45], [[0.5, 0.56], [0.52, 0.5]])
BELOW = ([0.5, 0.1, 0.5], [[0.5, 0.05], [0.5, 0.5]])


@pytest.fixture
def known_results(probed_run: ProbedRun) -> ProbeResults:
    return load_results(probed_run({"color": KNOWS}, "known"))


@pytest.fixture
def guessed(probed_run: ProbedRun) -> ProbeResults:
    return load_results(probed_run({"color": GUESSES}, "guessed", random_weights=True))


def drawn(axes: "Sequence[Axes]") -> "list[Axes]":
    return [panel for panel in axes if panel.get_visible() and (panel.lines or panel.images)]


def limits(figure: "Figure") -> set[tuple[float, float]]:
    return {tuple(round(float(end), 6) for end in axes.get_ylim()) for axes in drawn(figure.axes)}  # type: ignore[misc]


def colours(figure: "Figure") -> set[tuple[float, float]]:
    return {image.get_clim() for axes in figure.axes for image in axes.images if image.get_array().ndim == 2}  # type: ignore[union-attr]


@pytest.mark.slow
def test_maps_run_from_chance_to_100_percent_whatever_they_hold(
    known_results: ProbeResults, guessed: ProbeResults
) -> None:
    for results in (known_results, guessed):
        assert colours(iteration_maps(results)) == {(50.0, 100.0)}
        (image,) = IterationMapDisplay.from_results(results, "color").plot().ax_.images  # type: ignore[union-attr]
        assert image.get_clim() == (50.0, 100.0)


def test_the_best_guess_of_an_untrained_network_is_pale_and_full_knowledge_nearly_black(
    known_results: ProbeResults, guessed: ProbeResults
) -> None:
    darkest = []
    for results in (known_results, guessed):
        (image,) = IterationMapDisplay.from_results(results, "color").plot().ax_.images  # type: ignore[union-attr]
        grey_levels = image.to_rgba(image.get_array())[..., :3]
        darkest.append(float(grey_levels.sum(axis=-1).min()))
    assert darkest[0] < 0.5
    assert darkest[1] > 2.2


@pytest.mark.slow
def test_accuracies_have_one_axis_in_every_figure_alone_and_together(
    known_results: ProbeResults, guessed: ProbeResults
) -> None:
    figures = [layer_curve(results) for results in (known_results, guessed)]
    figures += [
        curves_side_by_side(some, [probe_results.settings.model for probe_results in some], "mean")
        for some in ([known_results, guessed], [guessed, known_results])
    ]
    for results in (known_results, guessed):
        figures += [
            display.plot().ax_.figure  # type: ignore[union-attr,misc]
            for display in (
                LayerCurveDisplay.from_results(results, "color"),
                RoleCurvesDisplay.from_results(results, "color"),
            )
        ]
    assert set.union(*map(limits, figures)) == {(20.0, 109.0)}


@pytest.mark.slow
def test_depth_and_knowledge_have_fixed_axes(
    probed_run: ProbedRun, known_results: ProbeResults, guessed: ProbeResults
) -> None:
    assert limits(model_depths([guessed])) == limits(model_depths([known_results, guessed])) == {(-30.0, 51.0)}
    for accuracies in (KNOWS, GUESSES):
        table = retention_table([probed_run({"color": accuracies}, "again")])
        axes = KnowledgeActionDisplay.from_table(table).plot().ax_
        assert axes is not None
        assert axes.get_xlim() == axes.get_ylim() == (-2, 102)


def test_a_value_outside_of_the_axis_is_marked_with_its_number(probed_run: ProbedRun) -> None:
    figure = layer_curve(load_results(probed_run({"color": BELOW})))
    marks = [line for axes in figure.axes for line in axes.lines if line.get_gid() == "below"]
    assert len(marks) == 2
    words = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert words >= {"10", "5"}


@pytest.mark.slow
def test_side_by_side_every_run_has_a_line_and_a_map_of_its_own(
    known_results: ProbeResults, guessed: ProbeResults
) -> None:
    names = ["known", "guessed (random weights)"]
    curves = curves_side_by_side([known_results, guessed], names, "mean")
    for axes in drawn(curves.axes):
        run_lines = [line for line in axes.lines if line.get_label() in names]
        assert [line.get_label() for line in run_lines] == names
        assert len({(line.get_color(), line.get_marker()) for line in run_lines}) == 2
    backbone = curves.axes[0]
    (line,) = [line for line in backbone.lines if line.get_label() == "known"]
    np.testing.assert_allclose(line.get_ydata(), [50, 100, 90])
    maps = maps_side_by_side([known_results, guessed], names, "mean")
    assert [axes.get_title(loc="left") for axes in drawn(maps.axes)][:2] == [f"Color: {name}" for name in names]
    assert colours(maps) == {(50.0, 100.0)}


def test_the_gallery_of_several_runs_names_each_apart(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": KNOWS}, "pi0"), probed_run({"color": GUESSES}, "untrained", random_weights=True)]
    exhibits = {exhibit.name: exhibit for exhibit in collect_figures(runs, retention_table(runs))}
    assert {"curves-side-by-side", "maps-side-by-side", "model-depths"} <= set(exhibits)
    assert not {"curves-side-by-side", "maps-side-by-side"} & {
        exhibit.name for exhibit in collect_figures(runs[:1], retention_table(runs[:1]))
    }
    with exhibits["model-depths"].drawn() as figure:
        labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert labels == {
        "pi0, 3 layers",
        "untrained (random weights), 3 layers",
        "pi0, 2 layers",
        "untrained (random weights), 2 layers",
    }
