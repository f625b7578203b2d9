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
        RetentionTableDisplay,
        RoleCurvesDisplay,
        SideTableDisplay,
        SuccessTableDisplay,
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
    "RetentionTableDisplay",
    "RoleCurvesDisplay",
    "SideTableDisplay",
    "SuccessRate",
    "SuccessTableDisplay",
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
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "scored": "behaviour",
        "match_runs": "compare.known_used",
        "CallCurveDisplay": "displays",
        "event_calls": "displays.call_curves",
        "Difference": "compare.compare",
        "FinalPositionsDisplay": "displays",
        "IterationMapDisplay": "displays",
        "KnowledgeActionDisplay": "displays",
        "LayerCurveDisplay": "displays",
        "ModelDepthDisplay": "displays",
        "OutcomeRulesDisplay": "displays",
        "PairedItems": "behaviour",
        "PairedLayoutsDisplay": "displays",
        "Peak": "estimators",
        "Regime": "behaviour",
        "Retention": "estimators",
        "RetentionRow": "rows.row",
        "RetentionTable": "table",
        "RetentionTableDisplay": "displays",
        "RoleCurvesDisplay": "displays",
        "SideTableDisplay": "displays",
        "SuccessRate": "behaviour",
        "SuccessTableDisplay": "displays",
        "best_site": "estimators",
        "chance_margin": "probe_kit.statistics.significance",
        "layer_curve": "displays",
        "measure_retention": "estimators",
        "normalised_score": "behaviour",
        "retention_table": "table",
        "sensitivity": "behaviour",
        "success_rate": "behaviour",
    },
)
