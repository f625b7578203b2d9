"""Figures in scikit-learn's display idiom: numbers as attributes, `plot(ax=None)` draws and returns the display.

Without `ax` a display makes its own figure, with a legend and a caption that names model, weights and suite.
`collect_figures` makes all figures that fit a table, of sides or of labels.
"""

from probe_kit.retention.displays.bars import KnownUsedDisplay, OutcomeRulesDisplay, PairedLayoutsDisplay
from probe_kit.retention.displays.call_curves import CallCurveDisplay, aligned_curves, call_curves
from probe_kit.retention.displays.display import ProvenanceLine
from probe_kit.retention.displays.final_positions import FinalPositionsDisplay, final_positions
from probe_kit.retention.displays.interventions import (
    AttentionDisplay,
    DoseResponseDisplay,
    KnockoutDisplay,
    SiteEffectDisplay,
    attention_curve,
    attention_on_picture,
    dose_response,
    knockout_curve,
    site_effect_curve,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay, iteration_maps
from probe_kit.retention.displays.knowledge_action import (
    KnowledgeActionDisplay,
)
from probe_kit.retention.displays.label_figures import (
    ClassConfusionDisplay,
    PredictedValuesDisplay,
    StepScoresDisplay,
    class_confusions,
    predicted_values,
    step_scores,
)
from probe_kit.retention.displays.layer_curves import LayerCurveDisplay, layer_curve
from probe_kit.retention.displays.report_figure import ReportFigure, collect_figures, save_figures
from probe_kit.retention.displays.side_by_side import (
    ModelDepthDisplay,
    RoleCurvesDisplay,
    curves_side_by_side,
    maps_side_by_side,
    model_depths,
    role_curves,
)

__all__ = [
    "AttentionDisplay",
    "CallCurveDisplay",
    "ClassConfusionDisplay",
    "DoseResponseDisplay",
    "FinalPositionsDisplay",
    "IterationMapDisplay",
    "KnockoutDisplay",
    "KnowledgeActionDisplay",
    "KnownUsedDisplay",
    "LayerCurveDisplay",
    "ModelDepthDisplay",
    "OutcomeRulesDisplay",
    "PairedLayoutsDisplay",
    "PredictedValuesDisplay",
    "ProvenanceLine",
    "ReportFigure",
    "RoleCurvesDisplay",
    "SiteEffectDisplay",
    "StepScoresDisplay",
    "aligned_curves",
    "attention_curve",
    "attention_on_picture",
    "call_curves",
    "class_confusions",
    "collect_figures",
    "curves_side_by_side",
    "dose_response",
    "final_positions",
    "iteration_maps",
    "knockout_curve",
    "layer_curve",
    "maps_side_by_side",
    "model_depths",
    "predicted_values",
    "role_curves",
    "save_figures",
    "site_effect_curve",
    "step_scores",
]
