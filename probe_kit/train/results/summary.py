"""Probe results in one line and as a notebook table."""

from typing import TYPE_CHECKING

from probe_kit._terminal.notebook import rows_html
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


def results_text(settings: ProbeSettings, label: str) -> str:
    """One line: what was probed, with how many label permutations, and the key."""
    random = ", RANDOM WEIGHTS" if settings.random_weights else ""
    return (
        f"<ProbeResults {settings.key} of {label}{random}: {', '.join(settings.categories)}; "
        f"views {', '.join(settings.views)}; target {settings.target}; call {settings.call}; "
        f"{settings.permutations} label permutations>"
    )


def results_html(settings: ProbeSettings, label: str, scores: "pd.DataFrame") -> str:
    """The best site of every category, view and stream."""
    random = " (RANDOM WEIGHTS)" if settings.random_weights else ""
    title = (
        f"Probes of {label}{random}, target {settings.target}, call {settings.call}: the best site of "
        "each stream, + as many others that tie"
    )
    columns = ("category", "view", "stream", *SITE_HEADINGS, "n")
    note = (
        f"{settings.permutations} label permutations, key {settings.key}; only p < {SIGNIFICANCE} is evidence. "
        "results.scores has every site"
    )
    return rows_html(title, columns, [_cells(row) for _, row in best_sites(scores).iterrows()], note)


def best_sites(scores: "pd.DataFrame") -> "pd.DataFrame":
    """The first of the best sites of every category, view and stream, in order.

    Besides the columns of `scores`: `ties`, how many other sites are as good, and `first`, the best accuracy at
    the stream's first iteration, NaN where it runs once.
    """
    names = ["category", "view", "stream"]
    by_stream = scores.groupby(names, sort=False)
    best = by_stream["accuracy"].transform("max")
    begins = scores["iteration"].eq(by_stream["iteration"].transform("min")).fillna(False).astype(bool)
    found = scores.assign(ties=scores["accuracy"] == best, first=scores["accuracy"].where(begins))
    by_stream = found.groupby(names, sort=False)
    found = found.assign(ties=by_stream["ties"].transform("sum") - 1, first=by_stream["first"].transform("max"))
    return found.loc[by_stream["accuracy"].idxmax()]


def site_cells(row: "pd.Series") -> tuple[str, str, str, str]:
    """A row of `best_sites` as text: the site with its ties, accuracy, first iteration, p; a dash for none."""
    accuracy, low, high = (f"{100 * row[name]:.1f}" for name in ("accuracy", "ci_low", "ci_high"))
    site = f"{row['site']} +{row['ties']}" if row["ties"] else str(row["site"])
    first = "–" if row["first"] != row["first"] else f"{100 * row['first']:.1f}"
    p = "–" if row["p_fwe"] != row["p_fwe"] else f"{row['p_fwe']:.3f}"
    return site, f"{accuracy} [{low}, {high}]", first, p


SITE_HEADINGS = ("best site", "accuracy % [95 %]", "first iteration %", "family-wise p")


def _cells(row: "pd.Series") -> tuple[str, ...]:
    return row["category"], row["view"], row["stream"], *site_cells(row), str(row["n"])
