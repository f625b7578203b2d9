"""Probes: at which layers can a linear classifier read the answer?

Needs a run (anything that is a `RunReader`), no simulator and no model.
"""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.statistics.folds import FOLD_UNITS, FoldUnit
    from probe_kit.train.controls.baselines import BASELINES, Baseline
    from probe_kit.train.data.array_run import ArrayRun
    from probe_kit.train.data.labels import INCOMPLETE, TARGETS, Incomplete, Target
    from probe_kit.train.data.run_reader import RunReader
    from probe_kit.train.probe_sweep import Progress, train_probes
    from probe_kit.train.results.by_call import load_calls
    from probe_kit.train.results.control_scores import BaselineScore, Controls, Excess, UntrainedScore
    from probe_kit.train.results.probe_curve import Curve
    from probe_kit.train.results.probe_directions import Direction
    from probe_kit.train.results.probe_results import ProbeResults
    from probe_kit.train.results.store import load_results, save_results
    from probe_kit.train.settings import ProbeSettings

__all__ = [
    "BASELINES",
    "FOLD_UNITS",
    "INCOMPLETE",
    "TARGETS",
    "ArrayRun",
    "Baseline",
    "BaselineScore",
    "Controls",
    "Curve",
    "Direction",
    "Excess",
    "FoldUnit",
    "Incomplete",
    "ProbeResults",
    "ProbeSettings",
    "Progress",
    "RunReader",
    "Target",
    "UntrainedScore",
    "load_calls",
    "load_results",
    "save_results",
    "train_probes",
]

# `probe-kit --help` must load neither pandas nor matplotlib.
__getattr__ = lazy_names(
    __name__,
    {
        "ArrayRun": "data.array_run",
        "BASELINES": "controls.baselines",
        "Baseline": "controls.baselines",
        "BaselineScore": "results.control_scores",
        "Controls": "results.control_scores",
        "Curve": "results.probe_curve",
        "Direction": "results.probe_directions",
        "Excess": "results.control_scores",
        "FOLD_UNITS": "probe_kit.statistics.folds",
        "FoldUnit": "probe_kit.statistics.folds",
        "INCOMPLETE": "data.labels",
        "Incomplete": "data.labels",
        "ProbeResults": "results.probe_results",
        "ProbeSettings": "settings",
        "Progress": "probe_sweep",
        "RunReader": "data.run_reader",
        "TARGETS": "data.labels",
        "Target": "data.labels",
        "UntrainedScore": "results.control_scores",
        "load_calls": "results.by_call",
        "load_results": "results.store",
        "save_results": "results.store",
        "train_probes": "probe_sweep",
    },
)
