"""Choosing what a figure shows from probe results, or saying what there is instead."""

from typing import TYPE_CHECKING

from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention.estimators.retention import Iterations
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
