"""Figures of probes of a label, in scikit-learn's display idiom; `label_figures` makes all of a table."""

from probe_kit.retention.displays.labels.class_confusion import ClassConfusionDisplay, class_confusions
from probe_kit.retention.displays.labels.figures import label_figures
from probe_kit.retention.displays.labels.label_curve import LabelCurveDisplay, label_curves
from probe_kit.retention.displays.labels.predicted_values import PredictedValuesDisplay, predicted_values
from probe_kit.retention.displays.labels.step_scores import StepScoresDisplay, step_scores

__all__ = [
    "ClassConfusionDisplay",
    "LabelCurveDisplay",
    "PredictedValuesDisplay",
    "StepScoresDisplay",
    "class_confusions",
    "label_curves",
    "label_figures",
    "predicted_values",
    "step_scores",
]
