"""Probes: at which layers can a linear classifier read the answer?

Needs a run (anything that is a `RunReader`), no simulator and no model.
"""

from typing import TYPE_CHECKING

from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.statistics.folds import FOLD_UNITS, FoldUnit
    from probe_kit.train.array_run import ArrayRun
    from probe_kit.train.baselines import BASELINES, Baseline
    from probe_kit.train.calls import load_calls
    from probe_kit.train.controls import BaselineScore, Controls, Excess, TwinScore
    from probe_kit.train.curve import Curve
    from probe_kit.train.directions import Direction
    from probe_kit.train.reader import RunReader
    from probe_kit.train.results import ProbeResults
    from probe_kit.train.settings import ProbeSettings
    from probe_kit.train.store import load_results, save_results
    from probe_kit.train.sweep import Progress, train_probes
    from probe_kit.train.targets import INCOMPLETE, TARGETS, Incomplete, Target

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
    "TwinScore",
    "load_calls",
    "load_results",
    "save_results",
    "train_probes",
]

# `probe-kit --help` must load neither pandas nor matplotlib.
__getattr__ = lazy_names(
    __name__,
    {
        "ArrayRun": "array_run",
        "BASELINES": "baselines",
        "Baseline": "baselines",
        "BaselineScore": "controls",
        "Controls": "controls",
        "Curve": "curve",
        "Direction": "directions",
        "Excess": "controls",
        "FOLD_UNITS": "probe_kit.statistics.folds",
        "FoldUnit": "probe_kit.statistics.folds",
        "INCOMPLETE": "targets",
        "Incomplete": "targets",
        "ProbeResults": "results",
        "ProbeSettings": "settings",
        "Progress": "sweep",
        "RunReader": "reader",
        "TARGETS": "targets",
        "Target": "targets",
        "TwinScore": "controls",
        "load_calls": "calls",
        "load_results": "store",
        "save_results": "store",
        "train_probes": "sweep",
    },
)
