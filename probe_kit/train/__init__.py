"""Probes: at which layers can a linear classifier read the answer?

Needs a run (anything that is a `RunReader`), no simulator and no model.
"""

from probe_kit.train.array_run import ArrayRun
from probe_kit.train.curve import Curve
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults, ProbeSettings
from probe_kit.train.store import load_results, save_results
from probe_kit.train.sweep import Progress, train_probes
from probe_kit.train.targets import TARGETS, Target

__all__ = [
    "TARGETS",
    "ArrayRun",
    "Curve",
    "ProbeResults",
    "ProbeSettings",
    "Progress",
    "RunReader",
    "Target",
    "load_results",
    "save_results",
    "train_probes",
]
