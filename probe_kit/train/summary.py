"""Probe results in one line and as a notebook shows them."""

from typing import TYPE_CHECKING

from probe_kit.notebook import rows_html
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


def results_text(settings: ProbeSettings) -> str:
    """One line: what was probed, with how many relabellings, and the key."""
    random = ", RANDOM WEIGHTS" if settings.random_weights else ""
    return (
        f"<ProbeResults {settings.key} of {settings.model}{random}: {', '.join(settings.categories)}; "
        f"views {', '.join(settings.views)}; target {settings.target}; call {settings.call}; "
        f"{settings.permutations} relabellings>"
    )


def results_html(settings: ProbeSettings, scores: "pd.DataFrame") -> str:
    """The best site of every category, view and stream."""
    random = " (RANDOM WEIGHTS)" if settings.random_weights else ""
    title = (
        f"Probes of {settings.model}{random}, target {settings.target}, call {settings.call}: the best site of "
        "each stream, + as many others that tie"
    )
    columns = ("category", "view", "stream", "best site", "accuracy % [95 %]", "family-wise p", "n")
    note = (
        f"{settings.permutations} relabellings, key {settings.key}; only p < {SIGNIFICANCE} is evidence. "
        "results.scores has every site"
    )
    return rows_html(title, columns, [_cells(row) for _, row in _best(scores).iterrows()], note)


def _best(scores: "pd.DataFrame") -> "pd.DataFrame":
    names = ["category", "view", "stream"]
    best = scores.groupby(names, sort=False)["accuracy"].transform("max")
    tied = scores.assign(ties=scores["accuracy"] == best)
    tied["ties"] = tied.groupby(names, sort=False)["ties"].transform("sum") - 1
    return tied.loc[tied.groupby(names, sort=False)["accuracy"].idxmax()]


def _cells(row: "pd.Series") -> tuple[str, ...]:
    accuracy = f"{100 * row['accuracy']:.1f} [{100 * row['ci_low']:.1f}, {100 * row['ci_high']:.1f}]"
    p = "–" if row["p_fwe"] != row["p_fwe"] else f"{row['p_fwe']:.3f}"
    site = f"{row['site']} +{row['ties']}" if row["ties"] else row["site"]
    return row["category"], row["view"], row["stream"], site, accuracy, p, str(row["n"])
