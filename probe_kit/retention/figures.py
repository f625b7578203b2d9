"""Layer curves: accuracy against depth, backbone and action expert, one panel per category."""

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.errors import UnknownSiteError
from probe_kit.train.controls import SIGNIFICANCE
from probe_kit.train.curve import Curve
from probe_kit.train.results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIDESTEP = 0.006  # in depth, so that the two streams' bars do not hide each other

# Okabe and Ito's blue and vermilion: apart for every kind of colour vision, and in grey by marker and lightness.
_STYLES = {
    "backbone": ("#0072B2", "o", "backbone", -_SIDESTEP),
    "expert": ("#D55E00", "s", "action expert, best iteration", _SIDESTEP),
}


def layer_curve(results: ProbeResults, view: str | None = None) -> "Figure":
    """Held-out accuracy against depth for every category, as a matplotlib figure (`figure.savefig(…)`).

    Lines: backbone, and the expert's best iteration with a band over all its iterations; bars: 95 % intervals
    over groups. Filled markers are above chance against the best site of their stream (family-wise p < 0.05).
    Grey: chance, and the band that holds 95 % of the accuracies under relabelling. view: the first probed one
    by default. Raises UnknownSiteError for a view that was not probed.
    """
    from matplotlib.figure import Figure

    view = view or results.settings.views[0]
    if view not in results.settings.views:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(results.settings.views)}")
    categories = results.settings.categories
    columns = 2 if len(categories) == 4 else min(3, len(categories))
    rows = ceil(len(categories) / columns)
    figure = Figure(figsize=(max(3.1 * columns, 6.2), 2.5 * rows + 1.1), layout="constrained", dpi=150)
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    scores = results.scores[results.scores["view"] == view]
    for axes, category in zip(panels, categories, strict=False):
        _draw_panel(axes, scores[scores["category"] == category], results.curves[category, view])
        axes.set_title(category.replace("_", " "), fontsize=10, loc="left")
    for unused in panels[len(categories) :]:
        unused.set_visible(False)
        panels[panels.index(unused) - columns].tick_params(labelbottom=True)
    figure.supylabel(f"held-out accuracy (%), view {view}", fontsize=9)
    figure.supxlabel(
        f"depth (0 enters the first block, 1 leaves the last)\n{_caption(results, view, figure)}", fontsize=8
    )
    _draw_legend(figure, panels[0])
    return figure


def _draw_legend(figure: "Figure", panel: "Axes") -> None:
    from matplotlib.lines import Line2D

    handles, labels = panel.get_legend_handles_labels()
    handles.append(Line2D([], [], color="0.3", ls="none", marker="o", ms=4.5))
    labels.append(f"filled: above chance, family-wise p < {SIGNIFICANCE}")
    figure.legend(handles, labels, loc="outside upper left", ncols=2, fontsize=8, frameon=False)


def _draw_panel(axes: "Axes", scores: "pd.DataFrame", curve: Curve) -> None:
    chance = 100 * curve.chance
    if curve.null.size:
        low, high = 100 * np.percentile(curve.null, [2.5, 97.5])
        axes.axhspan(low, high, color="0.92", lw=0, label="95 % of relabelled probes")
    axes.axhline(chance, color="0.45", lw=1, ls="--", label="chance")
    for stream, of_stream in scores.groupby("stream", sort=False):
        _draw_stream(axes, str(stream), of_stream)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.set_xlim(-0.04, 1.04)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "0.25", "0.5", "0.75", "1"])


def _draw_stream(axes: "Axes", stream: str, scores: "pd.DataFrame") -> None:
    colour, marker, label, sidestep = _STYLES.get(stream, ("#009E73", "^", stream, 0.0))
    best = scores.loc[scores.groupby("depth")["accuracy"].idxmax()].sort_values("depth")
    depth, accuracy = best["depth"] + sidestep, 100 * best["accuracy"]
    if scores["iteration"].nunique() > 1:
        span = 100 * scores.groupby("depth")["accuracy"].agg(["min", "max"])
        axes.fill_between(
            span.index,
            span["min"],
            span["max"],
            color=colour,
            alpha=0.15,
            lw=0,
            label="action expert, all iterations",
        )
    bars = [accuracy - 100 * best["ci_low"], 100 * best["ci_high"] - accuracy]
    axes.errorbar(depth, accuracy, yerr=bars, fmt="none", ecolor=colour, elinewidth=0.7, alpha=0.6)
    axes.plot(depth, accuracy, color=colour, lw=1.3, marker=marker, ms=4.5, mfc="white", label=label)
    clear = best["p_fwe"] < SIGNIFICANCE
    axes.plot(depth[clear], accuracy[clear], color=colour, ls="none", marker=marker, ms=4.5)


def _caption(results: ProbeResults, view: str, figure: "Figure") -> str:
    """Model, suite, sizes and key, in as many lines as the figure is narrow."""
    settings = results.settings
    sizes = [curve.labels.size for (_, name), curve in results.curves.items() if name == view]
    n = f"{min(sizes)}" if min(sizes) == max(sizes) else f"{min(sizes)}–{max(sizes)}"
    parts = [settings.model, settings.suite, f"n = {n} episodes per category", f"probes {results.key}"]
    if settings.weights:
        parts.insert(1, f"weights {settings.weights[:12]}")
    if settings.random_weights:
        parts.insert(1, "RANDOM WEIGHTS")
    if settings.target != "correct":
        parts.append(f"target {settings.target}")
    lines = [parts[0]]
    for part in parts[1:]:
        joined = f"{lines[-1]} · {part}"
        lines[-1:] = [joined] if len(joined) <= 15 * figure.get_figwidth() else [lines[-1], part]
    return "\n".join(lines)
