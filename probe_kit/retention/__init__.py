"""Success rate, retention, and the tables and figures that show them.

Reads runs and probe results; needs no simulator and no model.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.retention.behaviour import (
        PairedItems,
        Regime,
        SuccessRate,
        normalised_score,
        scored,
        sensitivity,
        success_rate,
    )
    from probe_kit.retention.compare.compare import Difference
    from probe_kit.retention.compare.known_used import match_runs
    from probe_kit.retention.displays import (
        CallCurveDisplay,
        FinalPositionsDisplay,
        IterationMapDisplay,
        KnowledgeActionDisplay,
        LayerCurveDisplay,
        ModelDepthDisplay,
        OutcomeRulesDisplay,
        PairedLayoutsDisplay,
        RoleCurvesDisplay,
        layer_curve,
    )
    from probe_kit.retention.displays.call_curves import event_calls
    from probe_kit.retention.estimators import Peak, Retention, best_site, measure_retention
    from probe_kit.retention.rows.row import RetentionRow
    from probe_kit.retention.table import RetentionTable, retention_table
    from probe_kit.statistics.significance import chance_margin

__all__ = [
    "CallCurveDisplay",
    "Difference",
    "FinalPositionsDisplay",
    "IterationMapDisplay",
    "KnowledgeActionDisplay",
    "LayerCurveDisplay",
    "ModelDepthDisplay",
    "OutcomeRulesDisplay",
    "PairedItems",
    "PairedLayoutsDisplay",
    "Peak",
    "Regime",
    "Retention",
    "RetentionRow",
    "RetentionTable",
    "RoleCurvesDisplay",
    "SuccessRate",
    "best_site",
    "chance_margin",
    "event_calls",
    "layer_curve",
    "match_runs",
    "measure_retention",
    "normalised_score",
    "retention_table",
    "scored",
    "sensitivity",
    "success_rate",
]

# `probe-kit --help` must load neither pandas nor matplotlib.
_HOMES = {
    "behaviour": (
        "PairedItems", "Regime", "SuccessRate", "normalised_score", "scored", "sensitivity", "success_rate",
    ),
    "compare.compare": ("Difference",),
    "compare.known_used": ("match_runs",),
    "displays": (
        "CallCurveDisplay", "FinalPositionsDisplay", "IterationMapDisplay", "KnowledgeActionDisplay",
        "LayerCurveDisplay", "ModelDepthDisplay", "OutcomeRulesDisplay", "PairedLayoutsDisplay",
        "RoleCurvesDisplay", "layer_curve",
    ),
    "displays.call_curves": ("event_calls",),
    "estimators": ("Peak", "Retention", "best_site", "measure_retention"),
    "rows.row": ("RetentionRow",),
    "table": ("RetentionTable", "retention_table"),
    "probe_kit.statistics.significance": ("chance_margin",),
}  # fmt: skip
__getattr__, __dir__ = lazy_names(__name__, {name: home for home, names in _HOMES.items() for name in names})
