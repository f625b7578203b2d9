"""Results of probes of a label: a table of scores, and the held-out predictions behind it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.folds import SHARED_TRAINING, Fold, split_by_fold
from probe_kit.statistics.label_permutations import max_statistic_p, pointwise_p
from probe_kit.statistics.paired_bootstrap import SHARED_PROBE
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.student import explained_interval
from probe_kit.train.choices import Task
from probe_kit.train.labels.label_settings import LabelSettings
from probe_kit.train.labels.task_scores import class_weights, fold_spearman, squared_deviations

if TYPE_CHECKING:
    import pandas as pd

Matrix = NDArray[np.float64]

METRICS: dict[Task, str] = {"binary": "balanced accuracy", "classes": "balanced accuracy", "continuous": "R²"}


@dataclass(frozen=True)
class LabelCurve:
    """All S sites of one view on the same n samples, with F outer folds and P label permutations.

    parts: what the stream of every site is part of. predictions, scores: (S, n), held out; the mean of the scores
    is the metric. null: (S, P) metric of every permutation. penalties: (S, F) of each outer fold. inner: (S, F, G)
    quality of every group in the inner folds of each outer fold above that of the permutations, see `LabelProbe`;
    without folds (S, 0, 0).
    """

    sites: tuple[Site, ...]
    parts: tuple[str, ...]
    predictions: Matrix
    scores: Matrix
    null: Matrix
    penalties: Matrix
    inner: NDArray[np.float32]

    @property
    def metric(self) -> Matrix:
        """(S,) balanced accuracy or R²."""
        found: Matrix = self.scores.mean(axis=1)
        return found

    @property
    def chance(self) -> Matrix:
        """(S,) mean metric of the label permutations; NaN without any."""
        return self.null.mean(axis=1) if self.null.shape[1] else np.full(len(self.sites), np.nan)

    def stream(self, name: str) -> NDArray[np.intp]:
        """Positions of the sites of one stream."""
        return np.flatnonzero([site.stream == name for site in self.sites])

    def largest_excess(self, rows: NDArray[np.intp]) -> int:
        """Which of some positions has the largest score above its own chance; the largest score without chance."""
        return int(rows[np.argmax((self.metric - np.nan_to_num(self.chance))[rows])])

    def of_part(self, part: str) -> str | None:
        """The first stream of a part of the model, `backbone` or `action`; None if none was probed."""
        return next((site.stream for site, own in zip(self.sites, self.parts, strict=True) if own == part), None)

    def p_fwe(self) -> Matrix:
        """(S,) family-wise p: each stream's sites are one family.

        Chance differs between sites, so the largest excess over a site's own mean counts. The real labels take
        part in that mean, as each permutation does; only so is the p exact.
        """
        p = np.empty(len(self.sites))
        for name in dict.fromkeys(site.stream for site in self.sites):
            rows = self.stream(name)
            every = np.column_stack([self.metric[rows], self.null[rows]])
            excess = every - every.mean(axis=1, keepdims=True)
            p[rows] = max_statistic_p(excess[:, 0], excess[:, 1:])
        return p


@dataclass(frozen=True)
class LabelControl:
    """The same probe on features that never were in the model, or of its untrained network.

    score, ci: its metric with a 95 % interval over groups. chance, p: by the label permutations, None without any.
    stream: whose width `random-features` have, or whose best site that of `untrained` is; empty for others.
    view: of `untrained`. by_step: metric at each of `LabelResults.steps`, in order.
    """

    name: str
    score: float
    ci: tuple[float, float]
    chance: float | None
    p: float | None
    stream: str = ""
    view: str = ""
    by_step: tuple[float, ...] = ()


@dataclass(frozen=True)
class LabelComparison:
    """Whether a site's probe scores more than a control: paired by group, family-wise over its stream."""

    control: str
    view: str
    site: str
    reference: float
    p: float


@dataclass(frozen=True)
class LabelControls:
    """Controls so far.

    left_out: why a default one was not run, by name. untrained: hash of that run's settings, empty without one.
    """

    scores: tuple[LabelControl, ...] = ()
    comparisons: tuple[LabelComparison, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    untrained: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Those that were run."""
        return tuple(dict.fromkeys(score.name for score in self.scores))

    def exceeded(self, view: str, site: Site) -> dict[str, bool]:
        """By control, whether a site exceeds it."""
        own = (one for one in self.comparisons if (one.view, one.site) == (view, str(site)))
        return {one.control: one.p < SIGNIFICANCE for one in own}

    def of_stream(self, view: str, stream: str) -> tuple[LabelControl, ...]:
        """The scores that sites of a stream are compared with in a view, the best first."""
        own = [one for one in self.scores if one.stream in ("", stream) and one.view in ("", view)]
        return tuple(sorted(own, key=lambda one: -one.score))

    def reference(self, view: str, site: Site) -> float:
        """Score of the best control of a site; NaN without any."""
        own = [one.reference for one in self.comparisons if (one.view, one.site) == (view, str(site))]
        return max(own, default=float("nan"))

    def to_json(self) -> dict[str, Any]:
        """As stored in `controls.json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> "LabelControls":
        """What `to_json` gave."""
        return cls(
            tuple(
                LabelControl(**{**one, "ci": tuple(one["ci"]), "by_step": tuple(one["by_step"])})
                for one in stored["scores"]
            ),
            tuple(LabelComparison(**one) for one in stored["comparisons"]),
            stored["left_out"],
            stored["untrained"],
        )


@dataclass(frozen=True, repr=False)
class LabelResults:
    """Probes of one label in one run.

    classes: names of the classes, empty for a continuous label. labels: (n,) coded. episodes, groups: (n,) names.
    inferences: (n,) captured inference. fold_of: (n,) outer fold. curves: by view. smallest_p: no p can be lower.
    left_out: how many episodes and inferences have no part, by reason. created: when they were fitted (UTC).
    aligned: (n,) place behind the event where windows begin, None where they begin at the first inference.
    """

    settings: LabelSettings
    classes: tuple[str, ...]
    labels: Matrix
    episodes: NDArray[np.str_]
    inferences: NDArray[np.int64]
    groups: NDArray[np.str_]
    fold_of: NDArray[np.int64]
    curves: Mapping[str, LabelCurve]
    smallest_p: float
    left_out: Mapping[str, int] = field(default_factory=dict)
    controls: LabelControls = field(default_factory=LabelControls)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))
    stamp: str = ""
    aligned: NDArray[np.int64] | None = None

    @property
    def places(self) -> NDArray[np.int64]:
        """(n,) the inference, or its place behind the event where windows begin."""
        return self.inferences if self.aligned is None else self.aligned

    @property
    def steps(self) -> NDArray[np.int64]:
        """(W,) the different places, in order."""
        return np.unique(self.places)

    def step_scores(self, scores: Matrix) -> Matrix:
        """Return (n,) scores whose mean over the samples of a step is the metric at that step.

        scores: (n,) as in `LabelCurve`. Classes are balanced within each step, over those that occur there.
        Weights of the whole window would lift a step of rare classes above 1. Scores of a continuous label stay.
        """
        if not self.classes:
            return scores
        found: Matrix = np.empty(scores.size)
        for step in self.steps:
            at_step = self.places == step
            found[at_step] = (scores[at_step] > 0) * class_weights(self.labels[at_step])
        return found

    def by_step(self, scores: Matrix) -> Matrix:
        """Return the (W,) metric of (n,) scores at each of the steps, see `step_scores`."""
        balanced = self.step_scores(scores)
        found: Matrix = np.array([balanced[self.places == step].mean() for step in self.steps])
        return found

    @property
    def key(self) -> str:
        """Hash of the settings."""
        return self.settings.key

    def __repr__(self) -> str:
        own = self.settings
        return (
            f"<LabelResults {self.key} of {own.model}: {own.target} ({own.task}); views {', '.join(own.views)}; "
            f"{self.labels.size} samples, {np.unique(self.groups).size} groups; {own.permutations} permutations>"
        )

    def _repr_html_(self) -> str:
        from probe_kit._terminal.notebook import rows_html

        names = ("view", "site", "score", "chance", "p_fwe", "signal")
        best = self.scores.loc[self.scores.groupby(["view", "stream"], sort=False)["score"].idxmax()]
        rows = [
            tuple(f"{one:.3f}" if isinstance(one, float) else str(one) for one in row)
            for row in best[list(names)].values
        ]
        return rows_html(
            f"Probes of {self.settings.target}: the best site of each stream", names, rows, repr(self)
        )

    @property
    def widening(self) -> float:
        """Factor of differences of scores under exchange: R² of groups that share a probe is not independent."""
        return SHARED_PROBE if self.settings.task == "continuous" else 1.0

    def with_controls(self, controls: LabelControls) -> "LabelResults":
        """The same with these controls."""
        return replace(self, controls=controls)

    @property
    def folds(self) -> list[Fold]:
        """The outer folds."""
        return split_by_fold(self.fold_of, np.unique(self.fold_of))

    @cached_property
    def deviations(self) -> Matrix:
        """(n,) squared deviations of the labels from the mean of their fold's training labels."""
        return squared_deviations(self.labels, self.folds)

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per view and site.

        `score` is the metric that the column `metric` names, with its 95 % interval over groups (`ci_low`,
        `ci_high`). `chance`: mean score of the label permutations at this site. `p`: of the site alone, `p_fwe`:
        against the largest excess of the stream in each permutation. `best_control`: score of the best control.
        `exceeds_NAME`: whether the site exceeds that control. `signal`: p_fwe is below 0.05 and the site exceeds
        every control that was run. `spearman`: Spearman's ρ within folds, of a continuous label. `n`: samples.
        """
        import pandas as pd

        return pd.DataFrame([row for view, curve in self.curves.items() for row in self._rows(view, curve)])

    def _rows(self, view: str, curve: LabelCurve) -> list[dict[str, Any]]:
        own, folds = self.settings, self.folds
        p, p_fwe, chance, metric = pointwise_p(curve.metric, curve.null), curve.p_fwe(), curve.chance, curve.metric
        last = {site.stream: max(o.layer for o in curve.sites if o.stream == site.stream) for site in curve.sites}
        rows = []
        for row, (site, part) in enumerate(zip(curve.sites, curve.parts, strict=True)):
            low, high = score_interval(curve.scores[row], self.labels, self.groups, own.task, self.deviations)
            exceeded = self.controls.exceeded(view, site)
            rows.append(
                {
                    "model": own.model,
                    "random_weights": own.random_weights,
                    "target": own.target,
                    "task": own.task,
                    "view": view,
                    "site": str(site),
                    "stream": site.stream,
                    "part": part,
                    "layer": site.layer,
                    "depth": site.layer / max(1, last[site.stream]),
                    "iteration": site.iteration,
                    "metric": METRICS[own.task],
                    "score": metric[row],
                    "ci_low": low,
                    "ci_high": high,
                    "chance": chance[row],
                    "spearman": fold_spearman(curve.predictions[row], self.labels, folds)
                    if own.task == "continuous"
                    else float("nan"),
                    "p": p[row],
                    "p_fwe": p_fwe[row],
                    "smallest_p": self.smallest_p,
                    "best_control": self.controls.reference(view, site),
                    **{f"exceeds_{name}": exceeded.get(name) for name in self.controls.names},
                    "signal": bool(p_fwe[row] < SIGNIFICANCE) and all(exceeded.values()),
                    "penalties": " ".join(f"{penalty:g}" for penalty in curve.penalties[row]),
                    "n": self.labels.size,
                    "episodes": np.unique(self.episodes).size,
                    "groups": np.unique(self.groups).size,
                    "settings": self.key,
                }
            )
        return rows


def score_interval(
    scores: Matrix,
    labels: Matrix,
    groups: NDArray[np.str_],
    task: Task,
    deviations: Matrix | None = None,
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of (n,) scores, groups as the unit.

    labels: (n,) coded. deviations: (n,) of a quantity from the mean of its fold's training labels, squared; None
    for a probe that was fitted elsewhere, whose R² compares with the mean of these labels. Balanced accuracy has
    Wilson's interval (`Accuracy`), R² that of `explained_interval`, which is approximate.
    """
    if task == "continuous":
        if deviations is None:
            return explained_interval(scores, (labels - labels.mean()) ** 2, groups)
        return explained_interval(scores, deviations, groups, SHARED_TRAINING)
    weights = class_weights(labels)
    interval = Accuracy.of((scores / weights).clip(0, 1), groups, weights).interval()
    return interval.low, interval.high
