"""Figures in scikit-learn's display idiom: numbers as attributes, `plot(ax=None)` draws and returns the display.

Without `ax` a display makes its own figure, with a legend and a caption that names model, weights and suite.
`collect_figures` makes all figures that fit a table, of sides or of labels.
"""

from probe_kit.retention.displays.attention import AttentionDisplay, attention_curve, attention_on_picture
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.call_curves import CallCurveDisplay, aligned_curves, call_curves
from probe_kit.retention.displays.class_confusion import ClassConfusionDisplay, class_confusions
from probe_kit.retention.displays.dose_response import DoseResponseDisplay, dose_response
from probe_kit.retention.displays.final_positions import FinalPositionsDisplay, final_positions
from probe_kit.retention.displays.heat_table import (
    HeatTableDisplay,
    RetentionTableDisplay,
    SideTableDisplay,
    SuccessTableDisplay,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay, iteration_maps
from probe_kit.retention.displays.knowledge_action import KnowledgeActionDisplay
from probe_kit.retention.displays.known_used import KnownUsedDisplay
from probe_kit.retention.displays.layer_curves import LayerCurveDisplay, layer_curve
from probe_kit.retention.displays.model_depth import ModelDepthDisplay, model_depths
from probe_kit.retention.displays.outcome_rules import OutcomeRulesDisplay
from probe_kit.retention.displays.paired_layouts import PairedLayoutsDisplay
from probe_kit.retention.displays.predicted_values import PredictedValuesDisplay, predicted_values
from probe_kit.retention.displays.report_figures import collect_figures, save_figures
from probe_kit.retention.displays.role_curves import RoleCurvesDisplay, role_curves
from probe_kit.retention.displays.side_by_side import curves_side_by_side, maps_side_by_side
from probe_kit.retention.displays.site_effect_curve import SiteEffectDisplay, site_effect_curve
from probe_kit.retention.displays.step_scores import StepScoresDisplay, step_scores

__all__ = [
    "AttentionDisplay",
    "CallCurveDisplay",
    "ClassConfusionDisplay",
    "DoseResponseDisplay",
    "FinalPositionsDisplay",
    "HeatTableDisplay",
    "IterationMapDisplay",
    "KnowledgeActionDisplay",
    "KnownUsedDisplay",
    "LayerCurveDisplay",
    "ModelDepthDisplay",
    "OutcomeRulesDisplay",
    "PairedLayoutsDisplay",
    "PredictedValuesDisplay",
    "ProvenanceLine",
    "ReportFigure",
    "RetentionTableDisplay",
    "RoleCurvesDisplay",
    "SideTableDisplay",
    "SiteEffectDisplay",
    "StepScoresDisplay",
    "SuccessTableDisplay",
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
    "layer_curve",
    "maps_side_by_side",
    "model_depths",
    "predicted_values",
    "role_curves",
    "save_figures",
    "site_effect_curve",
    "step_scores",
]
