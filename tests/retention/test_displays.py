"""Displays: the numbers they carry are those of the run, and what they draw says where it comes from."""

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from probe_kit._tables.content import heat_colour
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention import layer_curve, retention_table
from probe_kit.retention.displays import (
    FinalPositionsDisplay,
    IterationMapDisplay,
    KnowledgeActionDisplay,
    LayerCurveDisplay,
    ModelDepthDisplay,
    PairedLayoutsDisplay,
    RoleCurvesDisplay,
    collect_figures,
    final_positions,
    iteration_maps,
    model_depths,
    role_curves,
    save_figures,
)
from probe_kit.retention.displays.display import FILLED, INTERVAL, OPEN, ProvenanceLine, caption
from probe_kit.retention.displays.knowledge_action import place_labels
from probe_kit.train import ArrayRun, load_results

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7], [0.5, 0.65]])
NOISE = ([0.5, 0.52, 0.5], [[0.5, 0.5], [0.5, 0.51]])


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


@dataclass(frozen=True)
class PlacedRun(ArrayRun):
    """Knows its scene, as recorded runs do."""

    @property
    def settings(self) -> dict[str, Any]:
        return {"scene": SceneSpec().to_json()}


def placed_run(folder: Path, outcome_table: Callable[..., pd.DataFrame]) -> PlacedRun:
    """Three right, two wrong, one unmoved and one beyond the frame; all for questions answered on the left."""
    scene = SceneSpec()
    episodes = outcome_table(3, 2, 3).iloc[:7].assign(side_correct="left")
    places = [scene.tile_left] * 3 + [scene.tile_right] * 2 + [scene.cube_xy, (3.0, 0.0)]
    episodes[["cube_x", "cube_y"]] = places
    episodes["never_moved"] = [False] * 5 + [True, False]
    return PlacedRun(folder, "pi0", "suite@1#0123456789ab", episodes, {})


# -- layer curves ----------------------------------------------------------------------------------------------


def test_one_panel_per_category_with_both_streams(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL, "traffic-sign": SIGNAL}))
    figure = layer_curve(results)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    titles = [axes.get_title(loc="left") for axes in panels if axes.get_title(loc="left")]
    assert titles == [
        f"{name}: {part}" for name in ("Color", "Traffic sign") for part in ("backbone", "action expert")
    ]
    labels = [label for axes in panels for label in axes.get_legend_handles_labels()[1]]
    assert {"backbone", "action expert, by iteration", "iteration 0", "iteration 1", "chance"} <= set(labels)
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert entries.count("bar: 95 % interval") == 1
    figure.savefig(io.BytesIO(), format="png")


def test_the_caption_names_model_weights_suite_sizes_and_random_weights(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL}, "pi0-tiny", random_weights=True))
    figure = layer_curve(results)
    for part in ("pi0-tiny", "RANDOM WEIGHTS", "suite@1#0123456789ab", "n = 200", results.key):
        assert part in figure.get_supxlabel()
        assert part in figure.caption  # type: ignore[attr-defined]


def test_a_layer_curve_carries_the_best_iteration_and_the_span_of_all(probed_run: ProbedRun) -> None:
    display = LayerCurveDisplay.from_results(load_results(probed_run({"color": SIGNAL})), "color")
    backbone, expert = display.streams
    np.testing.assert_allclose(backbone.score, [0.5, 0.9, 0.7])
    np.testing.assert_allclose(backbone.depth, [0, 0.5, 1])
    np.testing.assert_allclose(expert.score, [0.6, 0.7])
    assert (expert.iterations, backbone.iterations) == (2, 1)
    assert (backbone.low < backbone.score).all()
    assert (display.grounds[0].chance == 0.5).all()
    low, high = display.grounds[0].null_band or (None, None)
    assert low == pytest.approx(0.405, abs=0.002), "the null is even from 0.4 to 0.6"
    assert high == pytest.approx(0.595, abs=0.002)


def test_significant_sites_are_filled(probed_run: ProbedRun) -> None:
    axes = layer_curve(load_results(probed_run({"color": SIGNAL}))).axes[0]
    filled = [line for line in axes.lines if line.get_linestyle() == "None" and line.get_marker() == "o"]
    assert [layer for line in filled for layer in line.get_xdata()] == [1, 2]


def test_views_and_categories_that_were_not_probed_are_errors(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL}))
    with pytest.raises(UnknownSiteError, match="probed: mean"):
        layer_curve(results, "last")
    with pytest.raises(UnknownCategoryError, match="probed: color"):
        LayerCurveDisplay.from_results(results, "shape")
    with pytest.raises(UnknownSiteError, match="'vision' was not probed in mean; its probed views: none"):
        RoleCurvesDisplay.from_results(results, "color", "vision")
    with pytest.raises(UnknownSiteError, match="was not probed in tokens; its probed views: mean"):
        RoleCurvesDisplay.from_results(results, "color", "expert", views=("mean", "tokens"))
    with pytest.raises(UnknownSiteError, match="no iterations"):
        IterationMapDisplay.from_results(results, "color", stream="backbone")


def test_plot_draws_on_the_given_axes_and_returns_the_display(probed_run: ProbedRun) -> None:
    display = LayerCurveDisplay.from_results(load_results(probed_run({"color": SIGNAL})), "color")
    axes = Figure().subplots()
    assert display.plot(axes) is display
    assert display.ax_ is axes
    assert axes.lines
    new_axes = display.plot().ax_
    assert new_axes is not axes
    assert "settings" in new_axes.figure.caption


# -- maps, roles, depths ---------------------------------------------------------------------------------------


def test_an_iteration_map_holds_every_site_and_frames_the_best(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL, "shape": NOISE}))
    display = IterationMapDisplay.from_results(results, "color")
    np.testing.assert_allclose(display.accuracy, [[0.6, 0.7], [0.5, 0.65]])
    assert display.peaks == ((0, 1),)
    assert display.significant.tolist() == [[True, True], [False, True]]
    axes = display.plot().ax_
    (frame,) = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    assert frame.get_xy() == (0.5, -0.5)
    dots = [line.get_xydata().tolist()[0] for line in axes.lines]
    assert dots == [[0, 0], [1, 0], [1, 1]], "layer and iteration of every significant site"
    assert not IterationMapDisplay.from_results(results, "shape").significant.any()


def test_the_maps_of_one_figure_share_one_scale(probed_run: ProbedRun) -> None:
    figure = iteration_maps(load_results(probed_run({"color": SIGNAL, "shape": NOISE})))
    norms = [image.norm for axes in figure.axes for image in axes.images]
    assert [(norm.vmin, norm.vmax) for norm in norms] == [(50, 100)] * 2


@pytest.mark.slow
def test_role_curves_have_a_line_per_view(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL}))
    display = RoleCurvesDisplay.from_results(results, "color", "expert")
    np.testing.assert_allclose(display.curves["mean"].score, [0.6, 0.7])
    twice = RoleCurvesDisplay.from_results(results, "color", "expert", views=("mean", "mean"))
    assert list(twice.curves) == ["mean"]
    role_curves(results).savefig(io.BytesIO())


def test_models_are_compared_by_accuracy_above_chance_averaged_over_categories(probed_run: ProbedRun) -> None:
    deep = probed_run({"color": SIGNAL, "shape": NOISE}, "pi0")
    shallow = probed_run({"color": ([0.5, 0.6], [[0.5]]), "shape": ([0.5, 0.8], [[0.5]])}, "smolvla")
    results = [load_results(deep), load_results(shallow)]
    first, second = ModelDepthDisplay.from_results(results).models
    np.testing.assert_allclose(first.above_chance, [0, 0.21, 0.1])
    np.testing.assert_allclose(second.above_chance, [0, 0.2])
    np.testing.assert_allclose(second.depth, [0, 1])
    with pytest.raises(UsageError, match="vision"):
        ModelDepthDisplay.from_results(results, "vision")
    figure = model_depths(results)
    assert figure.get_supxlabel().startswith("pi0, smolvla · ")
    assert "pi0 · " in figure.caption  # type: ignore[attr-defined]
    assert "smolvla · " in figure.caption  # type: ignore[attr-defined]


# -- success against what probes read ------------------------------------------------------------------------


def test_a_run_without_probes_has_no_point(tmp_path: Path, outcome_table: Any) -> None:
    table = retention_table([placed_run(tmp_path, outcome_table)])
    with pytest.raises(UsageError, match="no run that acted has probes"):
        KnowledgeActionDisplay.from_table(table)


@pytest.mark.parametrize("value", [-0.3, 0.1, 0.3, 0.5, 0.7, 0.9, 1.4])
def test_black_text_is_readable_on_every_heat_colour(value: float) -> None:
    colour = heat_colour(value)
    channels = np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    assert (linear @ [0.2126, 0.7152, 0.0722] + 0.05) / 0.05 > 7, "WCAG AAA"


# -- behaviour -------------------------------------------------------------------------------------------------


def test_a_name_stands_once_beside_its_point_on_its_own_figure_and_on_given_axes(probed_run: ProbedRun) -> None:
    display = KnowledgeActionDisplay.from_table(retention_table([probed_run({"color": SIGNAL, "shape": NOISE})]))
    for axes in (display.plot().ax_, display.plot(Figure().subplots()).ax_):
        assert axes is not None
        texts = [text.get_text() for text in axes.texts]
        assert [texts.count(name) for name in ("Color", "Shape")] == [1, 1]


@pytest.mark.slow
def test_the_gap_has_a_point_per_category_and_marks_those_without_signal(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL, "shape": NOISE})])
    display = KnowledgeActionDisplay.from_table(table)
    assert [(p.category, p.accuracy, p.sr, p.significant) for p in display.points] == [
        (row.category, row.backbone.score, 0.6, row.category == "color") for row in table.rows
    ]
    assert display.points[0].accuracy == pytest.approx(0.9)
    axes = display.plot().ax_
    assert {"Color", "Shape"} <= {text.get_text() for text in axes.texts}
    words = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert words == ["pi0", INTERVAL, FILLED, OPEN]
    assert KnowledgeActionDisplay.from_table(table, "expert").points[0].accuracy == table.rows[0].action.score


def test_names_of_crowded_points_do_not_cover_each_other() -> None:
    figure = Figure(figsize=(6, 6))
    axes = figure.subplots()
    axes.set_xlim(0, 100)
    axes.set_ylim(0, 100)
    names = ["attribute", "celebrity", "color", "emotion", "living world", "shape"]
    place_labels(axes, [(50, 50), (51, 50), (50, 51), (99, 99), (99, 98), (1, 1)], names, ["black"] * 6)
    boxes = [text.get_window_extent().padded(-1) for text in axes.texts]
    assert not any(a.overlaps(b) for position, a in enumerate(boxes) for b in boxes[position + 1 :])
    frame = axes.get_window_extent().padded(2)
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes), "no name leaves the axes"


def test_names_avoid_error_bars_where_there_is_room() -> None:
    figure = Figure(figsize=(6, 6))
    axes = figure.subplots()
    axes.set_xlim(0, 100)
    axes.set_ylim(0, 100)
    bars = [((20, 50), (80, 50)), ((50, 20), (50, 80))]
    place_labels(axes, [(50, 50)], ["living world"], ["black"], bars)
    box = axes.texts[0].get_window_extent()
    for (left, low), (right, high) in bars:
        (x0, y0), (x1, y1) = axes.transData.transform([(left, low), (right, high)])
        assert x1 < box.x0 or box.x1 < x0 or y1 < box.y0 or box.y1 < y0


def test_the_caret_of_the_best_layer_stands_above_its_error_bar(probed_run: ProbedRun) -> None:
    axes = layer_curve(load_results(probed_run({"color": SIGNAL}))).axes[0]
    (caret,) = [line for line in axes.get_lines() if line.get_gid() == "peak"]
    best = LayerCurveDisplay.from_results(load_results(probed_run({"color": SIGNAL})), "color").streams[0].lines[0]
    highest = int(np.argmax(best.score))
    assert caret.get_xdata() == [best.layers[highest]]
    assert caret.get_ydata() == pytest.approx([100 * max(best.score[highest], best.high[highest])])


def test_paired_layouts_count_items_and_draw_their_shares(tmp_path: Path, outcome_table: Any) -> None:
    # Items in order: 3 right twice, 1 right and wrong, 2 wrong twice, 1 wrong and outside, 1 outside twice.
    run = ArrayRun(tmp_path, "pi0", "suite", outcome_table(7, 6, 3), {})
    display = PairedLayoutsDisplay.from_run(run)
    paired = display.items["color"]
    assert (paired.both, paired.exactly_one, paired.both_wrong, paired.none) == (3, 1, 2, 4)
    bars = display.plot().ax_.patches
    np.testing.assert_allclose([bar.get_width() for bar in bars], [37.5, 12.5, 25, 25])


def test_final_positions_lie_over_the_tiles_as_seen_from_behind_the_robot(
    tmp_path: Path, outcome_table: Any
) -> None:
    run = placed_run(tmp_path, outcome_table)
    display = FinalPositionsDisplay.from_run(run, "color")
    assert display.counts == {"correct": 3, "wrong": 2, "oob": 2}
    axes = display.plot().ax_
    right, wrong, neither = (collection.get_offsets() for collection in axes.collections)
    assert tuple(right[0]) == pytest.approx((-0.183, 0.397)), "+y is the robot's left, and left in the picture"
    assert tuple(wrong[0]) == pytest.approx((0.127, 0.397))
    assert len(neither) == 1
    assert "1 beyond the frame" in [text.get_text() for text in axes.texts]
    assert axes.get_xlabel() == "3 right · 2 wrong · 2 out (1 unmoved)"
    zones = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert [(zone.center, zone.radius) for zone in zones] == [((-0.183, 0.397), 0.065), ((0.127, 0.397), 0.065)]


def test_an_episode_without_a_position_does_not_lie_beyond_the_frame(tmp_path: Path, outcome_table: Any) -> None:
    run = placed_run(tmp_path, outcome_table)
    run.episodes.loc[run.episodes.index[0], ["cube_x", "cube_y"]] = np.nan
    texts = [text.get_text() for text in FinalPositionsDisplay.from_run(run, "color").plot().ax_.texts]
    assert "1 beyond the frame" in texts


def test_final_positions_need_positions_and_a_scene(tmp_path: Path, outcome_table: Any) -> None:
    bare = ArrayRun(tmp_path, "pi0", "suite", outcome_table(2, 2, 2), {})
    with pytest.raises(UsageError, match="cube_x"):
        final_positions(bare)
    with pytest.raises(UsageError, match="no episodes of category 'shape'"):
        FinalPositionsDisplay.from_run(placed_run(tmp_path, outcome_table), "shape")


# -- collect_figures -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_gallery_saves_every_figure_twice_and_keeps_none_open(probed_run: ProbedRun, tmp_path: Path) -> None:
    run = probed_run({"color": SIGNAL, "shape": SIGNAL})
    saved = list(save_figures(collect_figures([run], retention_table([run])), tmp_path / "figures"))
    assert [path.stem for path in saved] == [
        "knowledge-action", "pi0-paired-layouts", "pi0-layer-curves", "pi0-iteration-maps",
    ]  # fmt: skip
    assert all(path.stat().st_size > 5000 and path.with_suffix(".pdf").is_file() for path in saved)
    assert plt.get_fignums() == []


def test_runs_whose_folders_have_one_name_get_figures_of_their_own(tmp_path: Path, outcome_table: Any) -> None:
    runs = [placed_run(tmp_path / study / "run", outcome_table) for study in "abc"]
    names = [exhibit.name for exhibit in collect_figures(runs, retention_table(runs))]
    assert len(set(names)) == len(names)
    assert {"run-final-positions", "run-2-final-positions", "run-3-final-positions"} <= set(names)


def test_the_line_below_a_figure_has_no_hole_where_one_model_was_not_probed() -> None:
    probed = ProvenanceLine("pi0", False, "a" * 64, "suite@1", "n = 4 episodes", "s" * 64, "probes1", call=0)
    vlm_run = replace(probed, model="vlm", probes=None, call=None)
    figure = Figure()
    caption(figure, vlm_run, probed)
    assert not re.search(r"(^|·)\s*,|,\s*(·|$)", figure.get_supxlabel())
    assert "call 0" in figure.get_supxlabel()
