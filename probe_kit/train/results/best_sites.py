"""The best site of every category, view and stream: as rows, and as a notebook shows them."""

from typing import TYPE_CHECKING

from probe_kit._tables.numbers import p_text
from probe_kit._terminal.notebook import rows_html
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


def best_sites(scores: "pd.DataFrame", is_side: bool) -> "list[pd.Series]":
    """Return the best site of every category, view and stream: a row of `ProbeResults.scores`, by category.

    That of a side has the largest accuracy, others the largest excess over their own chance; the first on ties.
    Besides the columns of `scores`: `ties`, how many other sites are as good, and `first`, the best score at the
    stream's first iteration, NaN where it runs once.
    """
    names = ["category", "view", "stream"]
    worth = scores["score"] if is_side else scores["score"] - scores["chance"].fillna(0.0)
    by_stream = worth.groupby([scores[name] for name in names], sort=False)
    iterations = scores["iteration"].groupby([scores[name] for name in names], sort=False)
    begins = scores["iteration"].eq(iterations.transform("min")).fillna(False).astype(bool)
    marked = scores.assign(ties=worth == by_stream.transform("max"), first=scores["score"].where(begins))
    grouped = marked.groupby(names, sort=False)
    marked = marked.assign(ties=grouped["ties"].transform("sum") - 1, first=grouped["first"].transform("max"))
    best = marked.loc[by_stream.idxmax()].sort_values("category", kind="stable")
    return [row for _, row in best.iterrows()]


def site_cells(row: "pd.Series", is_side: bool) -> tuple[str, str, str, str]:
    """Return a row of `best_sites` as text: the site with its ties, score, chance and p; a dash for none."""
    site = f"{row['site']} +{row['ties']}" if row["ties"] else str(row["site"])
    limits = (row["score"], row["ci_low"], row["ci_high"])
    score, low, high = (score_text(value, is_side) for value in limits)
    return site, f"{score} [{low}, {high}]", score_text(row["chance"], is_side), p_text(row["p_fwe"])


def score_text(value: float | None, is_side: bool) -> str:
    """Return the accuracy of a side in percent, other scores as they are; a dash for none."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.1f}" if is_side else f"{value:.3f}"


def results_html(settings: ProbeSettings, label: str, scores: "pd.DataFrame") -> str:
    """Return the best site of every category, view and stream as HTML."""
    random = " (RANDOM WEIGHTS)" if settings.random_weights else ""
    title = (
        f"Probes of {label}{random}, target {settings.target}, call {settings.call}: the best site of "
        "each stream, + as many others that tie"
    )
    score = "accuracy % [95 %]" if settings.is_side else f"{METRICS[settings.task]} [95 %]"
    columns = ("category", "view", "stream", "best site", score, "chance", "family-wise p", "first iteration", "n")
    rows = [
        (
            row["category"],
            row["view"],
            row["stream"],
            *site_cells(row, settings.is_side),
            score_text(row["first"], settings.is_side),
            str(row["n"]),
        )
        for row in best_sites(scores, settings.is_side)
    ]
    note = (
        f"{settings.permutations} label permutations, key {settings.key}; only p < {SIGNIFICANCE} is evidence. "
        "results.scores has every site"
    )
    return rows_html(title, columns, rows, note)
