"""Choosing what a figure shows from probe results, or saying what there is instead."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention.choices import Iterations
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


def known_view(results: ProbeResults, view: str | None) -> str:
    """`view`, or the first probed one. Raises UnknownSiteError if it was not probed."""
    probed = results.settings.views
    view = view or probed[0]
    if view not in probed:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(probed)}")
    return view


def curve_of(results: ProbeResults, category: str, view: str) -> ProbeCurve:
    """The probes of a category. Raises UnknownCategoryError if it was not probed."""
    if (category, view) not in results.curves:
        probed = ", ".join(results.settings.categories)
        raise UnknownCategoryError(f"category {category!r} was not probed; probed: {probed}")
    return results.curves[category, view]


def scores_of(results: ProbeResults, category: str, view: str) -> "pd.DataFrame":
    """Rows of `results.scores` of one category in one view."""
    scores = results.scores
    return scores[(scores["category"] == category) & (scores["view"] == view)]


def of_iterations(scores: "pd.DataFrame", iterations: Iterations) -> "pd.DataFrame":
    """The rows of one stream that take part; all of a stream that runs once.

    Raises UsageError if the stream has no such iteration.
    """
    steps = scores["iteration"].dropna()
    if iterations in ("all", "best") or steps.empty:
        return scores
    step = int(steps.max()) if iterations == "last" else iterations
    if not (steps == step).any():
        stream = scores["stream"].iloc[0]
        raise UsageError(f"the stream {stream} has iterations {steps.min()} to {steps.max()}, not {step}")
    return scores[scores["iteration"] == step]


def probed_curve(results: ProbeResults, view: str | None, category: str | None) -> tuple[str, str, ProbeCurve]:
    """Return category, view and curve, by default the first. Raises as `known_view` and `curve_of`."""
    view, category = known_view(results, view), category or results.settings.categories[0]
    return category, view, curve_of(results, category, view)


def rows_of(curve: ProbeCurve, stream: str) -> NDArray[np.intp]:
    """Return the positions of the sites of a stream. Raises UnknownSiteError without any."""
    rows = curve.stream(stream)
    if not rows.size:
        raise UnknownSiteError(
            f"stream {stream!r} was not probed in this view; probed: {', '.join(curve.streams)}"
        )
    return rows


def best_row(curve: ProbeCurve, stream: str) -> int:
    """Return the position of the site of a stream that has the largest score above its own chance."""
    return curve.largest_excess(rows_of(curve, stream))
