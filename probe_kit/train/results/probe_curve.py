"""The probes of one category in one view, with all that later statistics need."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import Site, part_of
from probe_kit.statistics.estimates.balanced import GroupSums, balanced_sums
from probe_kit.statistics.estimates.crossfit import Stream
from probe_kit.statistics.folds import Fold, fold_of_groups, split_by_fold
from probe_kit.statistics.label_permutations import max_statistic_p
from probe_kit.train.crossval.metrics import correctness


@dataclass(frozen=True)
class ProbeCurve:
    """All sites of one category in one view, on the same episodes (E), folds (F) and label permutations (P).

    sites: S of them. labels: (E,) bool. episodes, items, groups: (E,) identities. fold_of: (E,) outer fold.
    parts: S times what the site's stream is part of, see `Stream.part`; default by the stream's name.
    decisions: (S, E) out-of-fold. strengths: (S, F) chosen C. null: (S, P) accuracies under label permutation.
    inner: (S, F, G) log-likelihood of every group in the inner folds of each outer fold, the groups in the order
    of their names; 0 for the groups that the outer fold tests.
    """

    sites: tuple[Site, ...]
    labels: NDArray[np.bool_]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    fold_of: NDArray[np.int64]
    decisions: NDArray[np.float64]
    strengths: NDArray[np.float64]
    null: NDArray[np.float64]
    inner: NDArray[np.float32]
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.parts:
            object.__setattr__(self, "parts", tuple(part_of(site.stream) for site in self.sites))

    @property
    def correct(self) -> NDArray[np.bool_]:
        """(S, E) whether each episode's held-out decision is right."""
        return correctness(self.decisions, self.labels[None, :])

    @cached_property
    def sums(self) -> GroupSums:
        """Correct decisions per site and group of items, balanced between the sides: chance is one half.

        Raises UnbalancedEpisodesError where a fold was trained on one side only.
        """
        return balanced_sums(self.decisions, self.labels, self.fold_of, self.groups)

    @property
    def n_groups(self) -> int:
        """Number of independent groups of items."""
        return len(self.group_names)

    @property
    def group_names(self) -> tuple[str, ...]:
        """The G names of the groups, in order."""
        return tuple(np.unique(self.groups).tolist())

    def fit_stream(self, rows: NDArray[np.intp]) -> Stream:
        """The sites at `rows`, which are one stream or a part of it, for cross-fitted scores.

        Raises as `sums`, and as `Stream.of`.
        """
        sites = [self.sites[row] for row in rows]
        return Stream.of(
            self.sums.only(rows),
            self.inner[rows],
            fold_of_groups(self.fold_of, self.groups),
            [site.layer for site in sites],
            [site.iteration or 0 for site in sites],
        )

    def nested_correct(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(E,) whether decisions are right at the site of `rows` that is best in each outer fold's inner folds."""
        best: NDArray[np.intp] = rows[self.fit_stream(rows).best]
        right: NDArray[np.bool_] = self.correct[best[self.fold_of], np.arange(self.labels.size)]
        return right

    def stream(self, name: str) -> NDArray[np.intp]:
        """Positions of the sites of one stream."""
        return np.flatnonzero([site.stream == name for site in self.sites])

    @property
    def action_stream(self) -> str | None:
        """The stream the action is made in, None if none was probed."""
        return self._first("action")

    @property
    def backbone_stream(self) -> str | None:
        """The stream of the vision-language model, None if none was probed."""
        return self._first("backbone")

    def _first(self, part: str) -> str | None:
        return next((site.stream for site, own in zip(self.sites, self.parts, strict=True) if own == part), None)

    def best(self, stream: str) -> int:
        """Position of the most accurate site of a stream, the first one on ties."""
        rows = self.stream(stream)
        return int(rows[self.correct[rows].mean(axis=1).argmax()])

    def depth(self, site: Site) -> float:
        """Layer of `site` as a fraction of its stream: 0 enters the first block, 1 leaves the last."""
        last = max(other.layer for other in self.sites if other.stream == site.stream)
        return site.layer / max(1, last)

    def p_fwe(self) -> NDArray[np.float64]:
        """(S,) family-wise p: each stream's sites are one family."""
        p = np.empty(len(self.sites))
        accuracy = self.correct.mean(axis=1)
        for name in {site.stream for site in self.sites}:
            rows = self.stream(name)
            p[rows] = max_statistic_p(accuracy[rows], self.null[rows])
        return p

    @property
    def control_accuracy(self) -> NDArray[np.float64]:
        """(S,) mean accuracy on the control task: random labels, consistent within an item. NaN without any."""
        return self.null.mean(axis=1) if self.null.shape[1] else np.full(len(self.sites), np.nan)

    def folds(self) -> list[Fold]:
        """The outer folds."""
        return split_by_fold(self.fold_of, self._fold_names)

    @property
    def _fold_names(self) -> list[int]:
        return [int(fold) for fold in np.unique(self.fold_of)]
