import io
from collections.abc import Callable

import pytest

from probe_kit.errors import UnknownSiteError
from probe_kit.retention import layer_curve
from probe_kit.train import ArrayRun, load_results

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7], [0.5, 0.65]])


def test_one_panel_per_category_with_both_streams(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL, "traffic_sign": SIGNAL}))
    figure = layer_curve(results)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == ["color", "traffic sign"]
    labels = panels[0].get_legend_handles_labels()[1]
    assert {"backbone", "action expert, best iteration", "action expert, all iterations", "chance"} <= set(labels)
    figure.savefig(io.BytesIO(), format="png")


def test_the_caption_names_model_suite_and_random_weights(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": SIGNAL}, "pi0-tiny", random_weights=True))
    caption = layer_curve(results).get_supxlabel()
    for part in ("pi0-tiny", "RANDOM WEIGHTS", "suite@1#0123456789ab", "n = 200", results.key):
        assert part in caption


def test_significant_sites_are_filled(probed_run: ProbedRun) -> None:
    axes = layer_curve(load_results(probed_run({"color": SIGNAL}))).axes[0]
    filled = [line for line in axes.lines if line.get_linestyle() == "None" and line.get_marker() == "o"]
    assert [round(depth, 1) for line in filled for depth in line.get_xdata()] == [0.5, 1.0]


def test_a_view_that_was_not_probed_is_an_error(probed_run: ProbedRun) -> None:
    with pytest.raises(UnknownSiteError, match="probed: mean"):
        layer_curve(load_results(probed_run({"color": SIGNAL})), "last")
