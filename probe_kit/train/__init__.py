"""Probes: at which layers can a linear classifier read the answer?

Needs a run (anything that is a `RunReader`), no simulator and no model.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit._system.types import Progress
    from probe_kit.runs.array_run import ArrayRun
    from probe_kit.runs.reader import RunReader
    from probe_kit.statistics.folds import FOLD_UNITS, FoldUnit
    from probe_kit.train.array_probe import ArrayProbes, probe
    from probe_kit.train.choices import CONTROLS, INCOMPLETE, SIDES, Control, Incomplete, Side
    from probe_kit.train.probe_sweep import train_probes
    from probe_kit.train.results.control_scores import ControlComparison, Controls, ControlScore, UntrainedScore
    from probe_kit.train.results.probe_curve import ProbeCurve
    from probe_kit.train.results.probe_results import Direction, ProbeResults, ProbeSettings
    from probe_kit.train.results.store import load_results, load_results_by_call, save_results
    from probe_kit.train.target import Target
    from probe_kit.train.transfer import TransferResults, transfer_probes

__all__ = [
    "CONTROLS",
    "FOLD_UNITS",
    "INCOMPLETE",
    "SIDES",
    "ArrayProbes",
    "ArrayRun",
    "Control",
    "ControlComparison",
    "ControlScore",
    "Controls",
    "Direction",
    "FoldUnit",
    "Incomplete",
    "ProbeCurve",
    "ProbeResults",
    "ProbeSettings",
    "Progress",
    "RunReader",
    "Side",
    "Target",
    "TransferResults",
    "UntrainedScore",
    "load_results",
    "load_results_by_call",
    "probe",
    "save_results",
    "train_probes",
    "transfer_probes",
]

# `probe-kit --help` must load neither pandas nor matplotlib.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "ArrayProbes": "array_probe",
        "ArrayRun": "array_probe",
        "probe": "array_probe",
        "Controls": "results.control_scores",
        "ProbeCurve": "results.probe_curve",
        "Direction": "results.probe_results",
        "ControlComparison": "results.control_scores",
        "FOLD_UNITS": "probe_kit.statistics.folds",
        "FoldUnit": "probe_kit.statistics.folds",
        "INCOMPLETE": "choices",
        "Incomplete": "choices",
        "CONTROLS": "choices",
        "Control": "choices",
        "ControlScore": "results.control_scores",
        "SIDES": "choices",
        "Side": "choices",
        "Target": "target",
        "ProbeResults": "results.probe_results",
        "ProbeSettings": "results.probe_results",
        "Progress": "probe_kit._system.types",
        "RunReader": "probe_kit.runs.reader",
        "UntrainedScore": "results.control_scores",
        "load_results_by_call": "results.store",
        "load_results": "results.store",
        "save_results": "results.store",
        "train_probes": "probe_sweep",
        "TransferResults": "transfer",
        "transfer_probes": "transfer",
    },
)
