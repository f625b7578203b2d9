"""The probes of one category in one view, with all data that later statistics need."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.hooks.contract.sites import Site, part_of
from probe_kit.statistics.crossfit import CHANCE, GroupSums, SiteScores, balanced_sums
from probe_kit.statistics.folds import Fold, fold_of_groups, split_by_fold, sums_by_group
from probe_kit.statistics.intervals import Accuracy
from probe_kit.statistics.label_permutations import max_statistic_p, smallest_p
from probe_kit.statistics.paired_tests import SHARED_PROBE
from probe_kit.train.choices import Task
from probe_kit.train.crossval.task_scores import class_weights, correctness, score_interval, squared_deviations


@dataclass(frozen=True)
class ProbeCurve:
    """The probes of all sites of one category in one view.

    They share E samples, F folds and P label permutations. A sample is an episode, or one captured inference of
    it.

    Attributes:
        sites: S probed sites, in order.
        labels: (E,) bool of a side (true: left), else coded: class numbers or quantities.
        episodes: (E,) ids of the episodes.
        items: (E,) ids of the items.
        groups: (E,) ids of the groups.
        fold_of: (E,) outer fold that tests a sample.
        decisions: (S, E) out-of-fold decision values of a side, else predicted class numbers or quantities.
        strengths: (S, F) chosen C of a logistic probe, λ of ridge.
        null: (S, P) metric under label permutation.
        inner: (S, F, G) quality of every group in the inner folds of each outer fold, the groups in the order of
            their names, 0 for the groups that the outer fold tests. For a side it is its log-likelihood, else the
            quality that chooses the penalty, above its mean over the permutations.
        parts: (S,) part of the model that the site's stream belongs to, see `Stream.part`; default by the stream's
            name.
        balanced: Whether accuracies are balanced between two sides, see `Target`: chance is one half.
        classes: Names of the classes, empty for a quantity.
        sample_scores: (S, E) held-out scores, None where `balanced`, see `scores`.
        inferences: (E,) captured inference.
        aligned: (E,) place behind the event where windows begin, None where they begin at the first inference.
        smallest_p: Lower bound of every p; None where the number of permutations gives it.
    """

    sites: tuple[Site, ...]
    labels: NDArray[Any]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    fold_of: NDArray[np.int64]
    decisions: Matrix
    strengths: Matrix
    null: Matrix
    inner: NDArray[np.float32]
    parts: tuple[str, ...] = ()
    task: Task = "binary"
    balanced: bool = True
    classes: tuple[str, ...] = ("right", "left")
    sample_scores: Matrix | None = None
    inferences: NDArray[np.int64] | None = None
    aligned: NDArray[np.int64] | None = None
    smallest_p: float | None = None

    AXES: ClassVar[Mapping[str, str]] = {
        "sites": "U S", "labels": "biuf E", "episodes": "U E", "items": "U E", "groups": "U E", "fold_of": "iu E",
        "decisions": "iuf SE", "strengths": "iuf SF", "null": "iuf SP", "inner": "iuf SFG", "parts": "U S",
        "sample_scores": "biuf SE", "inferences": "iu E", "aligned": "iu E",
    }  # fmt: skip
    """The types and axes of the stored arrays, see `axes_problem`."""

    def __post_init__(self) -> None:
        if not self.parts:
            object.__setattr__(self, "parts", tuple(part_of(site.stream) for site in self.sites))

    # -- scores -----------------------------------------------------------------------------------------------

    @property
    def correct(self) -> NDArray[np.bool_]:
        """The correctness of each episode's held-out decision about its side, (S, E)."""
        return correctness(self.decisions, self.labels[None, :])

    @cached_property
    def scores(self) -> Matrix:
        """The held-out scores (S, E), whose mean is the metric; of a side whether the decision is right."""
        return self.correct.astype(np.float64) if self.sample_scores is None else self.sample_scores

    @cached_property
    def metric(self) -> Matrix:
        """The metric (S,) that label permutations are compared with: of a side the accuracy, not balanced."""
        metric: Matrix = self.scores.mean(axis=1)
        return metric

    @property
    def null_mean(self) -> Matrix:
        """The mean metric under label permutation, (S,); NaN without any."""
        return self.null.mean(axis=1) if self.null.shape[1] else np.full(len(self.sites), np.nan)

    @property
    def control_accuracy(self) -> Matrix:
        """The mean accuracy on the control task, (S,); NaN without label permutations.

        The control task has random labels that are consistent within a group.
        """
        return self.null_mean

    @property
    def chance(self) -> Matrix:
        """The chance level (S,): one half for a side, else the mean metric of the label permutations.

        NaN without any permutations.
        """
        return np.full(len(self.sites), CHANCE) if self.balanced else self.null_mean

    @cached_property
    def sums(self) -> GroupSums:
        """The correct decisions per site and group of items, balanced between the sides: chance is one half.

        Raises:
            UnbalancedEpisodesError: If a fold was trained on one side only.
        """
        return balanced_sums(self.decisions, self.labels, self.fold_of, self.groups)

    @cached_property
    def deviations(self) -> Matrix:
        """The squared deviations (E,) of quantities from the mean of their fold's training labels."""
        return squared_deviations(self.labels, self.folds())

    def estimate(self, rows: NDArray[np.intp]) -> tuple[float, tuple[float, float]]:
        """Return the mean score of the sites at `rows` with its 95 % interval over groups.

        The accuracy of a side is balanced between its two pictures.
        """
        if self.balanced:
            sums = self.sums.only(rows)
            accuracy = Accuracy(np.unique(self.groups), sums.sums.mean(axis=0), sums.sizes)
            interval = accuracy.interval()
            return accuracy.value, (interval.low, interval.high)
        scores = self.scores[rows].mean(axis=0)
        deviations = self.deviations if self.task == "continuous" else None
        return float(scores.mean()), score_interval(scores, self.labels, self.groups, self.task, deviations)

    @property
    def widening(self) -> float | None:
        """The factor of drawn differences of R² from a control's; None for decisions, which have their own."""
        return SHARED_PROBE if self.task == "continuous" else None

    def p_fwe(self) -> Matrix:
        """Return the family-wise p of every site, (S,): each stream's sites are one family.

        The largest excess over chance counts: over one half, or over the site's own mean, where chance differs
        between sites. The real labels take part in that mean, as each permutation does; only so is the p exact.
        """
        p = np.empty(len(self.sites))
        for name in self.streams:
            rows = self.stream(name)
            every = np.column_stack([self.metric[rows], self.null[rows]])
            every -= CHANCE if self.balanced else every.mean(axis=1, keepdims=True)
            p[rows] = max_statistic_p(every[:, 0], every[:, 1:])
        return p

    @property
    def least_p(self) -> float:
        """The lower bound of every p."""
        return smallest_p(self.null.shape[1]) if self.smallest_p is None else self.smallest_p

    @property
    def penalties(self) -> Matrix:
        """The chosen penalties (S, F): λ of ridge, 1 / C of a logistic probe."""
        return 1 / self.strengths if self.task == "binary" else self.strengths

    # -- steps of an episode ----------------------------------------------------------------------------------

    @property
    def places(self) -> NDArray[np.int64]:
        """The inference of each sample, (E,), or its place behind the event where windows begin."""
        if self.aligned is not None:
            return self.aligned
        return np.zeros(self.labels.size, np.int64) if self.inferences is None else self.inferences

    @property
    def steps(self) -> NDArray[np.int64]:
        """The W different places, (W,), in order."""
        return np.unique(self.places)

    def step_scores(self, scores: Matrix) -> Matrix:
        """Return (E,) scores whose mean over the samples of a step is the metric at that step.

        Classes are balanced within each step, over those that occur there. Weights of the whole window would lift
        a step of rare classes above 1. Scores of a quantity stay as they are.

        Args:
            scores: (E,) scores of one site.
        """
        if not self.classes:
            return scores
        balanced: Matrix = np.empty(scores.size)
        for step in self.steps:
            at_step = self.places == step
            balanced[at_step] = (scores[at_step] > 0) * class_weights(self.labels[at_step])
        return balanced

    def by_step(self, scores: Matrix) -> Matrix:
        """Return the metric (W,) of (E,) scores at each of the steps, see `step_scores`."""
        balanced = self.step_scores(scores)
        return np.array([balanced[self.places == step].mean() for step in self.steps])

    # -- groups and folds -------------------------------------------------------------------------------------

    @property
    def n_groups(self) -> int:
        """The number of independent groups of items."""
        return len(self.group_names)

    @property
    def group_names(self) -> tuple[str, ...]:
        """The names of the G groups, in order."""
        return tuple(np.unique(self.groups).tolist())

    def folds(self) -> list[Fold]:
        """Return the outer folds."""
        return split_by_fold(self.fold_of, [int(fold) for fold in np.unique(self.fold_of)])

    # -- sites ------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams that were probed, in order."""
        return tuple(dict.fromkeys(site.stream for site in self.sites))

    def stream(self, name: str) -> NDArray[np.intp]:
        """Return the positions of the sites of one stream."""
        return np.flatnonzero([site.stream == name for site in self.sites])

    def of_part(self, part: str) -> str | None:
        """Return the first stream of a part of the model, `backbone` or `action`; None if none was probed."""
        return next(
            (site.stream for site, site_part in zip(self.sites, self.parts, strict=True) if site_part == part),
            None,
        )

    @property
    def action_stream(self) -> str | None:
        """The stream in which the action is made; None if none was probed."""
        return self.of_part("action")

    @property
    def backbone_stream(self) -> str | None:
        """The stream of the vision-language model; None if none was probed."""
        return self.of_part("backbone")

    def only(self, row: int) -> "ProbeCurve":
        """Return the curve with a single one of its sites."""
        members = ("decisions", "strengths", "null", "inner", "sample_scores")
        arrays = {name: getattr(self, name)[[row]] for name in members if getattr(self, name) is not None}
        return replace(self, sites=(self.sites[row],), parts=(self.parts[row],), **arrays)

    def best(self, stream: str) -> int:
        """Return the position of the site of a stream with the largest metric, the first one on ties."""
        rows = self.stream(stream)
        return int(rows[self.metric[rows].argmax()])

    def largest_excess(self, rows: NDArray[np.intp]) -> int:
        """Return the row of `rows` with the largest metric above its own chance, where chance is known."""
        return int(rows[np.argmax(self.metric[rows] - np.nan_to_num(self.chance[rows]))])

    def depth(self, site: Site) -> float:
        """Return the layer of `site` as a fraction of its stream: 0 enters the first block, 1 leaves the last."""
        last = max(other.layer for other in self.sites if other.stream == site.stream)
        return site.layer / max(1, last)  # a stream of one layer has depth 0

    def fit_stream(self, rows: NDArray[np.intp]) -> SiteScores:
        """Return the sites at `rows`, which are one stream or a part of it, for cross-fitted scores.

        Of a side they are balanced accuracies, else scores above the chance of each site. Raises as `sums`, and as
        `SiteScores.of`.
        """
        sites = [self.sites[row] for row in rows]
        return SiteScores.of(
            self.sums.only(rows) if self.balanced else self._above_chance(rows),
            self.inner[rows],
            fold_of_groups(self.fold_of, self.groups),
            [site.layer for site in sites],
            [site.iteration or 0 for site in sites],
        )

    def _above_chance(self, rows: NDArray[np.intp]) -> GroupSums:
        chance = np.nan_to_num(self.chance[rows])  # without permutations nothing is defined, and nothing is NaN
        above = sums_by_group(self.scores[rows] - chance[:, None], self.groups)
        return GroupSums(above, sums_by_group(np.ones(self.groups.size), self.groups))

    def nested_correct(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return whether decisions (E,) are right at the best site of `rows`.

        The best site is chosen for each outer fold by its inner folds.
        """
        best: NDArray[np.intp] = rows[self.fit_stream(rows).best]
        right: NDArray[np.bool_] = self.correct[best[self.fold_of], np.arange(self.labels.size)]
        return right
