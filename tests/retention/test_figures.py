"""What a stranger sees: nothing clipped, the width used, marks that mean the same, colours that differ."""

import io
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import invalidate_caches
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgb
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image

from probe_kit._tables.content import HEAT
from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, displays, layer_curve, retention_table
from probe_kit.retention.displays import (
    IterationMapDisplay,
    LayerCurveDisplay,
    ModelDepthDisplay,
    collect_figures,
    save_figures,
)
from probe_kit.retention.displays.display import FILLED, INTERVAL, OPEN
from probe_kit.train import ArrayRun, ProbeResults, load_results, save_results
from tests.retention.conftest import runs_in

ProbedRun = Callable[..., ArrayRun]
STEPS = [[0.5, 0.55, 0.6], [0.5, 0.6, 0.7], [0.6, 0.7, 0.9], [0.6, 0.9, 0.9]]
SIGNAL = ([0.5, 0.9, 0.9, 0.7], STEPS)
NOISE = ([0.5, 0.52, 0.5, 0.51], [[0.5, 0.5, 0.51]] * 4)
TWELVE = (
    "attribute", "celebrity", "color", "counting", "facial_emotion", "landmark", "living_world", "shape",
    "spatial", "state", "traffic_sign", "weather",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


def in_two_views(run: ArrayRun) -> ArrayRun:
    results = load_results(run)
    views = ("mean", "mean:image.base_camera")
    curves = {(category, view): curve for (category, _), curve in results.curves.items() for view in views}
    save_results(ProbeResults(replace(results.settings, views=views), curves), run.path)
    return run


Drawn = tuple[RetentionTable, dict[str, Figure]]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("one category", marks=pytest.mark.slow),
        "two categories and two models",
        pytest.param("twelve categories and two models", marks=pytest.mark.slow),
    ],
)
def drawn(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    """A table and, by name, every figure that it and its runs allow."""
    probed_run = runs_in(tmp_path_factory.mktemp("exhibited"))
    if request.param == "one category":
        runs = [in_two_views(probed_run({"color": SIGNAL}, "pi0"))]
    else:
        categories = TWELVE[:2] if "two categories" in request.param else TWELVE
        names = {name: SIGNAL if at % 2 else NOISE for at, name in enumerate(categories)}
        runs = [
            in_two_views(probed_run(names, "pi0-with-a-rather-long-name", random_weights=True)),
            in_two_views(probed_run(names, "smolvla", suite="another-suite-with-a-name@1.0.0#ba9876543210")),
        ]
    table = retention_table(runs)
    return table, {exhibit.name: exhibit.draw() for exhibit in collect_figures(runs, table)}


@pytest.mark.slow
def test_nothing_is_clipped_and_the_width_is_used(drawn: Drawn) -> None:
    table, figures = drawn
    for name, figure in figures.items():
        figure.draw_without_rendering()
        inked, width, height = figure.get_tightbbox(), figure.get_figwidth(), figure.get_figheight()
        assert min(inked.x0, inked.y0) > -0.02, f"{name} is clipped left or below"
        assert inked.x1 < width + 0.02, f"{name} is clipped right"
        assert inked.y1 < height + 0.02, f"{name} is clipped above"
        assert inked.width > 0.9 * width, f"{name} leaves its sides empty"
        frame = figure.bbox.padded(1.5)
        for legend in [*figure.legends, *(axes.get_legend() for axes in figure.axes)]:
            if legend is not None:
                box = legend.get_window_extent()
                assert frame.x0 <= box.x0 < box.x1 <= frame.x1, f"{name}: legend"
                assert frame.y0 <= box.y0 < box.y1 <= frame.y1, f"{name}: legend"
        below = figure._supxlabel.get_window_extent()  # type: ignore[attr-defined]
        assert frame.x0 <= below.x0 < below.x1 <= frame.x1, f"{name}: caption"
        assert all(below.y1 < axes.bbox.y0 for axes in figure.axes if axes.get_visible()), f"{name}: caption"
        suites = {row.run.suite for row in table.rows}
        assert any(suite in figure.caption for suite in suites), name  # type: ignore[attr-defined]


@pytest.mark.slow
def test_saved_pixels_are_fit_for_print_and_carry_their_caption(probed_run: ProbedRun, tmp_path: Path) -> None:
    run = probed_run({"color": SIGNAL})
    for path in save_figures(collect_figures([run], retention_table([run])), tmp_path / "figures"):
        with Image.open(path) as picture:
            assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.1)
            assert "settings" in picture.text["Description"]  # type: ignore[attr-defined]
        assert path.with_suffix(".pdf").stat().st_size > 0
    file = io.BytesIO()
    layer_curve(load_results(run)).savefig(file, format="png")
    assert Image.open(file).info["dpi"] == pytest.approx((300, 300), abs=0.1)


# -- layer curves ------------------------------------------------------------------------------------------------


@pytest.fixture
def results(probed_run: ProbedRun) -> ProbeResults:
    return load_results(probed_run({"color": SIGNAL}))


@pytest.mark.parametrize(
    ("iterations", "expected_iterations", "accuracy"),
    [
        ("all", [0, 1, 2, 3], [0.6, 0.9, 0.9]),
        ("best", [None], [0.6, 0.9, 0.9]),
        ("last", [3], [0.6, 0.9, 0.9]),
        (1, [1], [0.5, 0.6, 0.7]),
    ],
)
def test_iterations_choose_the_lines_in_figures_as_they_do_in_tables(
    results: ProbeResults, iterations: str | int, expected_iterations: list[int | None], accuracy: list[float]
) -> None:
    display = LayerCurveDisplay.from_results(results, "color", iterations=iterations)  # type: ignore[arg-type]
    backbone, expert = display.streams
    assert [line.iteration for line in expert.lines] == expected_iterations
    assert [line.iteration for line in backbone.lines] == [None]
    np.testing.assert_allclose(expert.score, accuracy)
    display.plot()


@pytest.mark.slow
def test_the_figures_of_a_table_show_the_iterations_of_the_table(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    for iterations, expected in (("all", 4), ("best", 0), ("last", 0), (2, 0)):
        table = retention_table([run], iterations=iterations)  # type: ignore[arg-type]
        (curves,) = [exhibit for exhibit in collect_figures([run], table) if exhibit.name == "pi0-layer-curves"]
        with curves.drawn() as figure:
            labels = [label for axes in figure.axes for label in axes.get_legend_handles_labels()[1]]
            assert sum(label.startswith("iteration") for label in labels) == expected
            if isinstance(iterations, int):
                assert "action expert, iteration 2" in labels
    with pytest.raises(UsageError, match="iterations 0 to 3, not 7"):
        LayerCurveDisplay.from_results(load_results(run), "color", iterations=7)


@pytest.mark.slow
def test_layers_are_whole_numbers_and_the_backbone_stands_beside_the_action(results: ProbeResults) -> None:
    figure = layer_curve(results)
    figure.draw_without_rendering()
    backbone, expert = figure.axes[:2]
    assert [axes.get_title(loc="left") for axes in (backbone, expert)] == [
        "Color: backbone",
        "Color: action expert",
    ]
    for axes, last in ((backbone, 3), (expert, 2)):
        assert axes.get_xlabel() == "layer"
        ticks = [tick for tick in axes.get_xticks() if axes.get_xlim()[0] <= tick <= axes.get_xlim()[1]]
        assert ticks == list(range(last + 1))
        band = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
        assert len(band) == 1, "the band of probes of permuted labels"


@pytest.mark.slow
def test_every_site_that_ties_at_the_peak_is_marked(results: ProbeResults) -> None:
    display = LayerCurveDisplay.from_results(results, "color")
    backbone, expert = display.streams
    assert backbone.peaks == ((1, None), (2, None))
    assert set(expert.peaks) == {(2, 2), (1, 3), (2, 3)}
    figure = layer_curve(results)
    marked = [line.get_xdata() for axes in figure.axes for line in axes.lines if line.get_gid() == "peak"]
    assert [list(layers) for layers in marked] == [[1, 2], [1, 2]]
    maps = IterationMapDisplay.from_results(results, "color")
    assert set(maps.peaks) == {(2, 2), (3, 1), (3, 2)}
    frames = [patch for patch in maps.plot().ax_.patches if isinstance(patch, Rectangle)]  # type: ignore[union-attr]
    assert len(frames) == 3


def test_iterations_get_darker_one_by_one(results: ProbeResults) -> None:
    axes = layer_curve(results).axes[1]
    lines = [line for line in axes.lines if str(line.get_label()).startswith("iteration")]
    lightness = [lab(np.array(to_rgb(line.get_color())))[0] for line in lines]
    assert len(lines) == 4
    assert (np.diff(lightness) < -5).all()


@pytest.mark.slow
def test_filled_and_open_markers_mean_the_same_in_every_figure(drawn: Drawn) -> None:
    """Wherever a line or point has an open marker, the legend says what that is, in the same words."""
    figure_count = 0
    for name, figure in drawn[1].items():
        hollow = [
            line for axes in figure.axes for line in axes.lines
            if line.get_marker() not in ("None", "", None) and is_white(line.get_markerfacecolor())
            and line.get_markeredgewidth() > 0
        ]  # fmt: skip
        if not hollow:
            continue
        figure_count += 1
        legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
        words = [text.get_text() for legend in legends if legend is not None for text in legend.get_texts()]
        assert {FILLED, OPEN} <= set(words), name
    assert figure_count >= 2


@pytest.mark.slow
def test_the_legend_of_every_figure_with_intervals_names_them_once(drawn: Drawn) -> None:
    names = set()
    for name, figure in drawn[1].items():
        containers = [container for axes in figure.axes for container in axes.containers]
        has_intervals = any(isinstance(container, ErrorbarContainer) for container in containers)
        words = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert words.count(INTERVAL) == has_intervals, name
        names |= {name} if has_intervals else set()
    assert any("layer-curves" in name for name in names)


def is_white(colour: object) -> bool:
    return bool(np.allclose(to_rgb(colour), 1))  # type: ignore[arg-type]


def test_models_of_other_lengths_share_an_axis_with_depth_above(probed_run: ProbedRun) -> None:
    deep = load_results(probed_run({"color": SIGNAL}, "deep"))
    shallow = load_results(probed_run({"color": ([0.5, 0.9], [[0.5]])}, "shallow"))
    display = ModelDepthDisplay.from_results([deep, shallow]).plot()
    axes = display.ax_
    assert axes is not None
    assert "layer" in axes.get_xlabel()
    (above,) = axes.child_axes
    assert above.get_xlabel() == "depth"
    ends = [
        line.get_xdata()[-1] for line in axes.lines if len(line.get_xdata()) > 1 and line.get_label()[0] != "_"
    ]
    assert ends == [3, 3], "both end where the deepest model does"
    figure = axes.figure
    assert isinstance(figure, Figure)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["deep, 4 layers", "shallow, 2 layers"]


# -- colours -----------------------------------------------------------------------------------------------------

_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
"""Machado, Oliveira and Fernandes 2009, severity 1.0; on linear RGB."""


def linear(colour: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def lab(colour: NDArray[np.float64], deficiency: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """CIELAB of an sRGB colour, as seen with the matrix `deficiency`."""
    light = linear(colour)
    light = light if deficiency is None else (deficiency @ light).clip(0, 1)
    ratios = _XYZ @ light / [0.95047, 1, 1.08883]
    roots = np.where(ratios > 0.008856, np.cbrt(ratios), 7.787 * ratios + 16 / 116)
    return np.array([116 * roots[1] - 16, 500 * (roots[0] - roots[1]), 200 * (roots[1] - roots[2])])


def test_heat_colours_are_told_apart_without_red_and_green_and_in_grey() -> None:
    colours = [np.array(to_rgb(f"#{rgb}")) for _, _, rgb in HEAT]
    for deficiency in (None, _DEUTERANOPIA):
        points = [lab(colour, deficiency) for colour in colours]
        apart = [np.linalg.norm(a - b) for at, a in enumerate(points) for b in points[at + 1 :]]
        assert min(apart) > 15, "2.3 is what can just be told apart side by side"
    lightness = [lab(colour)[0] for colour in colours]
    assert (np.diff(lightness) < -5).all(), "grey alone orders them"


@pytest.mark.slow
def test_tables_of_colours_have_a_key(probed_run: ProbedRun) -> None:
    from probe_kit.retention.report import report_html

    run = probed_run({"color": SIGNAL})
    assert report_html([run], retention_table([run])).count('<p class="key">') == 2


EXAMPLE = """
from probe_kit.retention.displays.report_figure import ReportFigure, in_report


@in_report(0)
def length_figures(source):
    for one in source.runs:
        yield ReportFigure(
            f"{one.stem}-lengths", "Lengths", "behaviour", "Steps.", one.position, lambda: _drawn(one.run)
        )


def _drawn(run):
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots()
    axes.plot([len(run.episodes)])
    return figure
"""


def test_a_new_display_is_one_file(
    probed_run: Callable[..., ArrayRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worked example of CONTRIBUTING: a module of the folder that says what it draws."""
    run = probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])})
    table = retention_table([run])
    before = [figure.name for figure in collect_figures([run], table)]
    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "episode_lengths.py").write_text(EXAMPLE, encoding="utf-8")
    monkeypatch.setattr(displays, "__path__", [*displays.__path__, str(folder)])
    invalidate_caches()
    figures = collect_figures([run], table)
    monkeypatch.delitem(sys.modules, "probe_kit.retention.displays.episode_lengths")
    assert [figure.name for figure in figures if figure.name not in before] == ["pi0-lengths"]
    (saved,) = save_figures([figure for figure in figures if figure.name == "pi0-lengths"], tmp_path / "figures")
    assert saved.stat().st_size > 0


def test_figures_of_all_runs_come_first_and_then_run_by_run(probed_run: Callable[..., ArrayRun]) -> None:
    runs = [probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])}, name) for name in ("one", "other")]
    places = [figure.run for figure in collect_figures(runs, retention_table(runs))]
    assert places == sorted(places, key=lambda run: -1 if run is None else run)
    assert {None, 0, 1} == set(places)
