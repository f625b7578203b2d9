"""Success rate, retention, and the tables and figures that show them.

Reads runs and probe results; needs no simulator and no model.
"""

from typing import TYPE_CHECKING

from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.retention.call_curves import event_calls
    from probe_kit.retention.differences import Difference
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
    from probe_kit.retention.measure import Peak, Retention, best_site, measure_retention
    from probe_kit.retention.rows import RetentionRow
    from probe_kit.retention.success import (
        PairedItems,
        Regime,
        SuccessRate,
        normalised_score,
        sensitivity,
        success_rate,
    )
    from probe_kit.retention.table import RetentionTable, retention
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
    "measure_retention",
    "normalised_score",
    "retention",
    "sensitivity",
    "success_rate",
]

# `probe-kit --help` must load neither pandas nor matplotlib.
__getattr__ = lazy_names(
    __name__,
    {
        "CallCurveDisplay": "displays",
        "event_calls": "call_curves",
        "Difference": "differences",
        "FinalPositionsDisplay": "displays",
        "IterationMapDisplay": "displays",
        "KnowledgeActionDisplay": "displays",
        "LayerCurveDisplay": "displays",
        "ModelDepthDisplay": "displays",
        "OutcomeRulesDisplay": "displays",
        "PairedItems": "success",
        "PairedLayoutsDisplay": "displays",
        "Peak": "measure",
        "Regime": "success",
        "Retention": "measure",
        "RetentionRow": "rows",
        "RetentionTable": "table",
        "RetentionTableDisplay": "displays",
        "RoleCurvesDisplay": "displays",
        "SideTableDisplay": "displays",
        "SuccessRate": "success",
        "SuccessTableDisplay": "displays",
        "best_site": "measure",
        "chance_margin": "probe_kit.statistics.significance",
        "layer_curve": "displays",
        "measure_retention": "measure",
        "normalised_score": "success",
        "retention": "table",
        "sensitivity": "success",
        "success_rate": "success",
    },
)
