"""Results of a transfer: scores on the other run: as fitted, recentred, and refitted there."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.label_permutations import pointwise_p
from probe_kit.train.choices import Task
from probe_kit.train.crossval.task_scores import METRICS, score_interval
from probe_kit.train.results.probe_curve import ProbeCurve

if TYPE_CHECKING:
    import pandas as pd

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class TransferCurve:
    """All S sites of one view on the m samples of the other run.

    fitted: probes as they were fitted. recentred: the same probes after the other run's features were moved to the
    mean of the first. refitted: (S, m) held-out scores of probes of the other run itself.
    """

    fitted: ProbeCurve
    recentred: ProbeCurve
    refitted: Matrix


@dataclass(frozen=True, repr=False)
class TransferResults:
    """Probes of one label, fitted on one run (`model`) and scored on another (`other_model`).

    definition: hash of the label's definition, equal in both. classes: of the other run's labels. labels: (m,)
    coded. episodes, groups: (m,) names. inferences: (m,). curves: by view. smallest_p: no p can be lower.
    trained_on: number of samples and groups of the first run. left_out: of the other run, by reason.
    """

    model: str
    other_model: str
    same_weights: bool
    target: str
    task: Task
    definition: str
    classes: tuple[str, ...]
    labels: Matrix
    episodes: NDArray[np.str_]
    inferences: NDArray[np.int64]
    groups: NDArray[np.str_]
    curves: Mapping[str, TransferCurve]
    smallest_p: float
    trained_on: Mapping[str, int]
    left_out: Mapping[str, int]

    def __repr__(self) -> str:
        return (
            f"<TransferResults {self.target} ({self.task}), {self.model} to {self.other_model}; views "
            f"{', '.join(self.curves)}; {self.labels.size} samples, {np.unique(self.groups).size} groups>"
        )

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per view and site.

        `score`, `ci_low`, `ci_high`, `chance`, `p`, `p_fwe`: as in `ProbeResults.scores`, on the other run.
        `recentred`, `recentred_chance`, `recentred_p_fwe`: the same on features moved to the first run's mean.
        `refitted`, `refitted_ci_low`, `refitted_ci_high`: cross-validated score of the other run itself.
        `penalty`: λ, or 1 / C.
        """
        import pandas as pd

        return pd.DataFrame([row for view, curve in self.curves.items() for row in self._rows(view, curve)])

    def _rows(self, view: str, curve: TransferCurve) -> list[dict[str, Any]]:
        fitted, moved = curve.fitted, curve.recentred
        p, p_fwe, moved_p = pointwise_p(fitted.metric, fitted.null), fitted.p_fwe(), moved.p_fwe()
        rows = []
        for row, (site, part) in enumerate(zip(fitted.sites, fitted.parts, strict=True)):
            low, high = score_interval(fitted.scores[row], self.labels, self.groups, self.task)
            low_refitted, high_refitted = score_interval(
                curve.refitted[row], self.labels, self.groups, self.task, (self.labels - self.labels.mean()) ** 2
            )
            rows.append(
                {
                    "model": self.model,
                    "other_model": self.other_model,
                    "target": self.target,
                    "task": self.task,
                    "view": view,
                    "site": str(site),
                    "stream": site.stream,
                    "part": part,
                    "layer": site.layer,
                    "iteration": site.iteration,
                    "metric": METRICS[self.task],
                    "score": fitted.metric[row],
                    "ci_low": low,
                    "ci_high": high,
                    "chance": fitted.chance[row],
                    "p": p[row],
                    "p_fwe": p_fwe[row],
                    "recentred": moved.metric[row],
                    "recentred_chance": moved.chance[row],
                    "recentred_p_fwe": moved_p[row],
                    "refitted": float(curve.refitted[row].mean()),
                    "refitted_ci_low": low_refitted,
                    "refitted_ci_high": high_refitted,
                    "penalty": float(fitted.penalties[row, 0]),
                    "n": self.labels.size,
                    "groups": np.unique(self.groups).size,
                }
            )
        return rows
