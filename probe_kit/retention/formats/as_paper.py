"""The paper's own numbers, by its own formulas, where a run has what they need.

The retention table differs from the paper in three places, each on purpose. Its regime also needs an interval
above one half. Its Δ counts independent items. Its retention is cross-fitted, and left out where the backbone's
signal is not shown. Here nothing is left out and nothing is corrected. Source: *Does VLA Even Know the Basics?*,
arXiv 2606.19297, sections 4.4 (Δ and regimes) and 4.5 (retention).
"""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from probe_kit._tables.numbers import number, percent
from probe_kit._tables.table import Table
from probe_kit.retention.behaviour.success_rate import Regime, normalised_score, regime
from probe_kit.retention.columns.text import NOT_ACTED, model_name
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.estimates.balanced import CHANCE

EPSILON = 1e-6
"""The ε of the paper's denominator. The paper prints no value: this one only keeps the ratio finite."""
_NOTE = (
    "by the paper's formulas, without correction: Δ over episodes alone; accuracies are maxima over layers and "
    f"iterations; retention = (action − 50 %) / (backbone − 50 % + ε), ε = {EPSILON:g}, its mean over all "
    "categories; VLMs answer in one order of the options"
)


def paper_regime(success: float, margin: float) -> Regime:
    """Return the regime of a success rate in [0, 1] by the band 0.5 ± `margin` alone (paper, section 4.4)."""
    return regime(success, margin, share_wrong=0.0, share_outside=0.0)[0]


def paper_retention(action: float, backbone: float) -> float:
    """Return the retention of two best accuracies in [0, 1] (paper, section 4.5).

    The ratio of both above chance, with ε in the denominator. It is large of either sign where the backbone is at
    chance.
    """
    return (action - CHANCE) / (backbone - CHANCE + EPSILON)


def paper_table(rows: Sequence[RetentionRow], means: Sequence[RetentionRow], outcome_rule: str) -> Table:
    """Return the paper's numbers, category by category and as a mean.

    Keys are `run`, `model`, `view`, `category` (`mean` for the category mean), `episodes`, `sr`, `margin` (Δ over
    episodes), `regime`, `normalised_score` (of means), `backbone`, `action` (maxima over sites) and `retention`.

    rows, means: of a retention table, one mean per run and view. outcome_rule: how episodes were judged, in words.
    """
    numbers = []
    for mean in means:
        of_run = [row for row in rows if (*row.key, row.view) == (*mean.key, mean.view)]
        of_categories = [_category_numbers(row) for row in of_run]
        numbers += [*of_categories, _mean_numbers(mean, of_categories)]
    return _table(numbers, outcome_rule)


def _category_numbers(row: RetentionRow) -> dict[str, Any]:
    success, margin = row.success.sr, row.success.chance_margin_episodes
    backbone, action = row.backbone.peak, row.action.peak
    of_band = None if success is None or margin is None else paper_regime(success, margin)
    return {
        **_identity(row),
        "episodes": row.success.n_episodes,
        "sr": success,
        "margin": margin,
        "regime": None if of_band is None else str(of_band),
        "normalised_score": None,
        "backbone": backbone,
        "action": action,
        "retention": None if backbone is None or action is None else paper_retention(action, backbone),
    }


def _mean_numbers(mean: RetentionRow, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The means over categories, each over all that have the number: none is left out for a weak signal."""
    rates = [row["sr"] for row in rows]
    return {
        **_identity(mean),
        "episodes": sum(row["episodes"] for row in rows),
        "sr": _mean(rates),
        "margin": None,
        "regime": None,
        "normalised_score": None if None in rates else normalised_score(rates),
        **{name: _mean([row[name] for row in rows]) for name in ("backbone", "action", "retention")},
    }


def _identity(row: RetentionRow) -> dict[str, Any]:
    return {"run": row.run.location, "model": model_name(row), "view": row.view, "category": row.category}


def _mean(values: Sequence[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return fmean(defined) if defined else None


def _table(numbers: Sequence[dict[str, Any]], outcome_rule: str) -> Table:
    columns = ("model", "category", "SR %", "Δ", "regime", "backbone %", "action %", "retention")
    cells = [
        (
            row["model"] if row["view"] is None else f"{row['model']} · {row['view']}",
            row["category"],
            NOT_ACTED if row["sr"] is None else percent(row["sr"]),
            percent(row["margin"]),
            f"score {number(row['normalised_score'], 1)}" if row["category"] == MEAN else row["regime"] or "–",
            percent(row["backbone"]),
            percent(row["action"]),
            number(row["retention"]),
        )
        for row in numbers
    ]
    notes = [f"{_NOTE}; {outcome_rule}"]
    return Table.of("As the paper has it", columns, cells, names=2, mean=MEAN, notes=notes, numbers=tuple(numbers))
