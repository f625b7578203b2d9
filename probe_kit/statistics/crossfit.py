"""Balanced scores of sites, and cross-fitted scores of streams: inner folds choose a site, outer folds score it.

Missing episodes of one side favour no site, and chance is always one half. The choice of a site is repeated on
resampled groups, and sites share the score by how often they are best. The spread over the resamples says how much
variance the choice adds. See Efron, “Estimation and accuracy after model selection”, Journal of the American
Statistical Association 109 (2014).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.statistics.bootstrap import draw_groups
from probe_kit.statistics.folds import OUTER_FOLDS

CHANCE = 0.5
"""Balanced accuracy of any answer that does not depend on the question."""


# -- balanced scores -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GroupSums:
    """Weighted correct decisions per group of items, the unit of every resampling.

    Attributes:
        sums: (S, G) weighted correct decisions per site and group.
        sizes: (G,) weights of the groups, which add up to the number of episodes.
    """

    sums: Matrix
    sizes: Matrix

    @property
    def n_groups(self) -> int:
        """The number of groups, G."""
        return int(self.sizes.size)

    @property
    def n_episodes(self) -> float:
        """The number of episodes, E: the sum of the weights."""
        return float(self.sizes.sum())

    @property
    def accuracies(self) -> Matrix:
        """The balanced accuracy of each site, (S,)."""
        shares: Matrix = self.sums.sum(axis=1) / self.sizes.sum()
        return shares

    def only(self, sites: ArrayLike) -> "GroupSums":
        """Return the sums of some of the sites, by position or by mask."""
        return GroupSums(self.sums[np.asarray(sites)], self.sizes)


def balanced_sums(
    decisions: Matrix, labels: NDArray[np.bool_], fold_of: ArrayLike, groups: ArrayLike
) -> GroupSums:
    """Return the weighted correct decisions per site and group, in the order of the groups' names.

    An episode of a side with n of E episodes weighs E / (2 n). In a complete run every weight is 1 and no decision
    is shifted. Raises as `remove_fold_priors`.

    Args:
        decisions: (S, E) out-of-fold logits for True.
        labels: (E,) side of every episode.
        fold_of: (E,) outer fold that tests an episode.
        groups: (E,) name of every episode's group of items.
    """
    right = (remove_fold_priors(decisions, labels, fold_of) > 0) == labels
    count = int(labels.sum())
    weight = np.where(labels, labels.size / (2 * count), labels.size / (2 * (labels.size - count)))
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    member = np.zeros((labels.size, names.size))
    member[np.arange(labels.size), group_of] = weight
    return GroupSums(right.astype(np.float64) @ member, member.sum(axis=0))


def remove_fold_priors(decisions: Matrix, labels: NDArray[np.bool_], fold_of: ArrayLike) -> Matrix:
    """Return the out-of-fold logits (S, E) without what each fold's probe learned from the shares of the sides.

    The intercept of a probe that was trained on n episodes of True and m of False holds ln(n / m). The less a
    probe knows otherwise, the more of its decisions depend on that.

    Args:
        decisions: (S, E) out-of-fold logits for True.
        labels: (E,) side of every episode.
        fold_of: (E,) outer fold that tests an episode; all others trained its probe.

    Raises:
        UsageError: For a shape that does not fit, fewer than two folds, or NaN.
        UnbalancedEpisodesError: If a fold was trained on one side alone.
    """
    folds = np.asarray(fold_of)
    if decisions.ndim != 2 or not decisions.shape[1] == labels.size == folds.size:
        raise UsageError(
            f"decisions {decisions.shape}, labels {labels.shape} and folds {folds.shape}; expected (sites, "
            "episodes), and a label and a fold for each episode"
        )
    if not np.isfinite(decisions).all():
        broken = np.flatnonzero(~np.isfinite(decisions).all(axis=0))
        raise UsageError(
            f"decisions of {broken.size} of {labels.size} episodes are NaN or infinite, first number {broken[0]}, "
            "from 0 on; expected finite logits. Leave these episodes out, or fit the probes again."
        )
    names = np.unique(folds)
    if names.size < 2:
        raise UsageError(f"{names.size} outer folds; expected two or more, each tested by probes of the others")
    balanced = np.array(decisions, np.float64)
    for fold in names:
        tested = folds == fold
        yes, no = int(labels[~tested].sum()), int((~labels[~tested]).sum())
        if not (yes and no):
            raise UnbalancedEpisodesError(
                f"the probe of outer fold {fold} was trained on {yes} episodes of one side and {no} of the other; "
                "expected both sides. Extract the missing episodes."
            )
        if yes != no:
            balanced[:, tested] -= np.log(yes / no)
    return balanced


# -- cross-fitted scores -------------------------------------------------------------------------------------

RESAMPLES = 1000
"""Number of resamples of the groups; in each, the sites are chosen anew."""
LIMITED_RESAMPLES = 250
"""Number of these whose choice of sites has limits of its own."""
FEWEST_GROUPS = OUTER_FOLDS
"""The fewest groups of a cross-fit: every outer fold tests at least one group."""
_EQUAL = 1e-9
"""Qualities closer than this, as a share of the largest, differ by rounding only."""


@dataclass(frozen=True)
class SiteScores:
    """The sites of one stream, on G groups in F outer folds.

    Attributes:
        scores: The scores of each site in every group, held out by the outer folds.
        guide: (S, F, G) qualities by which sites are chosen, the larger the better. They are of a group's
            predictions in the inner folds of an outer fold, and 0 for the groups that the outer fold tests.
        fold_of: (G,) outer fold that tests a group, a position along F.
    """

    scores: GroupSums
    guide: Matrix
    fold_of: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        scores: GroupSums,
        inner: NDArray[np.floating],
        fold_of: ArrayLike,
        layers: ArrayLike,
        iterations: ArrayLike | None = None,
    ) -> "SiteScores":
        """Make the scores of a stream from those of its sites, in any order.

        A stream that runs once is chosen by its qualities. With several iterations, the guide is half a site's
        quality and half that of its surroundings, smoothed along layers and iterations.

        Args:
            scores: Held-out scores of S sites in G groups.
            inner: (S, F, G) qualities in the inner folds, see `guide`.
            fold_of: (G,) outer fold that tests a group, a position along F.
            layers: (S,) layer of each site.
            iterations: (S,) iteration of each site; None for a stream that runs once.

        Raises:
            UsageError: For other numbers of places, folds or groups, no site, or a quality other than 0 of a group
                in the fold that tests it.
        """
        at, folds = np.asarray(layers), np.asarray(fold_of, np.intp)
        steps = np.zeros_like(at) if iterations is None else np.asarray(iterations)
        if not len(scores.sums) == at.size == steps.size or at.size == 0:
            raise UsageError(
                f"{at.size} layers and {steps.size} iterations for {len(scores.sums)} sites; expected one each, "
                "and at least one site"
            )
        quality: Matrix = np.asarray(inner, np.float64)
        _check_inner(quality, scores, folds)
        if np.unique(steps).size > 1:
            quality = (quality + np.tensordot(smoothing(at, steps), quality, 1)) / 2
        return cls(scores, quality, folds)

    @property
    def peak(self) -> float:
        """The accuracy of the most accurate site: more than a choice of that site reaches on new groups."""
        return float(self.scores.accuracies.max())

    @property
    def best(self) -> NDArray[np.intp]:
        """The position (F,) of the site that is best in each outer fold's inner folds, the first one on ties."""
        first: NDArray[np.intp] = _are_best(self.guide.sum(axis=2)).argmax(axis=0)
        return first


@dataclass(frozen=True)
class CrossFit:
    """Cross-fitted scores of K streams on the same groups.

    Attributes:
        above: (K,) mean held-out accuracy of the chosen sites, above chance.
        peaks: (K,) accuracy of the site that is best on all groups, scored on them too.
        influence: (K, G) how much a group increases a score, through its own score and through the choice of
            sites.
        choice_sums: (K, R, G) sums of the sites that each of R resamples chooses, as in `GroupSums`; R is
            LIMITED_RESAMPLES.
        sizes: (K, G) sizes of the groups, as in `GroupSums`.
        groups: Names of the G groups.
        suite: Name of the suite that the groups are from.
    """

    above: Matrix
    peaks: Matrix
    influence: Matrix
    choice_sums: Matrix
    sizes: Matrix
    groups: tuple[str, ...]
    suite: str

    @property
    def n_groups(self) -> int:
        """The number of groups, G."""
        return len(self.groups)

    @property
    def covariance(self) -> Matrix:
        """The covariance (K, K) of `above`, where no score is known better than unseen groups allow.

        A share t of groups at chance costs t of a score above chance. Where all G groups agree, t² is 2 / ((G +
        1)(G + 2)) on average. A variance is at least that times the squared score.
        """
        covariance = self.covariance_with(self)
        unseen = 2 / ((self.n_groups + 1) * (self.n_groups + 2)) * self.above**2
        np.fill_diagonal(covariance, np.maximum(covariance.diagonal(), unseen))
        return covariance

    @property
    def df(self) -> int:
        """The degrees of freedom of the covariance: G − 1."""
        return self.n_groups - 1

    def shares_groups_with(self, other: "CrossFit") -> bool:
        """Whether both are of the same groups of one suite."""
        return (self.suite, self.groups) == (other.suite, other.groups)

    def covariance_with(self, other: "CrossFit") -> Matrix:
        """Return the covariance (K, L) with the scores of `other`; 0 where the two are of other groups."""
        if not self.shares_groups_with(other):
            return np.zeros((self.above.size, other.above.size))
        covariance: Matrix = self.influence @ other.influence.T * (self.n_groups / (self.n_groups - 1))
        return covariance


def crossfit(
    streams: Sequence[SiteScores], groups: Sequence[str], suite: str = "", chance: float = CHANCE
) -> CrossFit:
    """Score each stream by the sites that its inner folds choose, on the outer folds.

    Sites that are equally good share the choice, so that their order does not matter.

    Args:
        streams: Streams on the same groups, in the order of the names `groups`.
        groups: Names of the G groups.
        suite: Name of the suite that the groups are from; runs on equal groups of one suite are paired.
        chance: Score of guessing; 0 for sums from which the chance of every site is subtracted already.

    Raises:
        TooFewGroupsError: For fewer than 5 groups.
        UsageError: For NaN, or streams on other groups.
    """
    _check(streams, groups)
    scored = [_score_stream(stream) for stream in streams]
    return CrossFit(
        np.array([score for score, *_ in scored]) - chance,
        np.array([stream.peak for stream in streams]),
        np.array([influence for _, influence, _ in scored]),
        np.array([choices for *_, choices in scored]),
        np.array([stream.scores.sizes for stream in streams]),
        tuple(map(str, groups)),
        suite,
    )


def _score_stream(stream: SiteScores) -> tuple[float, Matrix, Matrix]:
    """Return the score of a stream, (G,) the influence of every group on it, and (R, G) the sums of choices."""
    sums, sizes = stream.scores.sums, stream.scores.sizes
    # One seed for all streams and runs: on equal groups their choices are made in the same resamples.
    times = draw_groups(sizes.size, 0, RESAMPLES).T.astype(np.float64)
    of_group = np.empty(sizes.size)
    of_resample = np.zeros(RESAMPLES)
    choice_sums = np.empty((LIMITED_RESAMPLES, sizes.size))
    for fold in range(stream.guide.shape[1]):
        tested = stream.fold_of == fold
        # Sites of the largest quality share the choice of every resample, (S, R).
        best = _are_best(stream.guide[:, fold] @ times)
        shares: Matrix = best / best.sum(axis=0)
        of_group[tested] = shares.mean(axis=1) @ sums[:, tested]
        of_resample += sums[:, tested].sum(axis=1) @ shares
        choice_sums[:, tested] = shares[:, :LIMITED_RESAMPLES].T @ sums[:, tested]
    score = float(of_group.sum() / sizes.sum())
    by_choice = _influence_on_choice(times, of_resample / sizes.sum())
    return score, (of_group - score * sizes) / sizes.sum() + by_choice, choice_sums


def _are_best(quality: Matrix) -> NDArray[np.bool_]:
    """Return (S, R) whether no site has a larger quality, up to rounding."""
    best: NDArray[np.bool_] = quality >= quality.max(axis=0) - _EQUAL * np.abs(quality).max(axis=0)
    return best


def _influence_on_choice(times: Matrix, scores: Matrix) -> Matrix:
    """Return the covariance (G,) of how often a group is drawn, (G, R), with (R,) scores.

    This is the infinitesimal jackknife. So few resamples give covariances even where there are none. Their sum of
    squares is then G / R of the variance of the scores (Wager, Hastie and Efron, JMLR 15, 2014). The covariances
    are shrunk by that.
    """
    influence: Matrix = (times - 1) @ (scores - scores.mean()) / scores.size
    influence -= influence.mean()
    length = float(influence @ influence)
    by_few_resamples = len(times) / scores.size * float(scores.var())
    return influence * np.sqrt(max(0.0, 1 - by_few_resamples / length)) if length > 0 else influence


def smoothing(layers: ArrayLike, iterations: ArrayLike) -> Matrix:
    """Return the weights (S, S), ¼, ½, ¼ along layers times those along iterations, of sites at (S,) places.

    At an edge, or next to a site that was not captured, the site itself replaces its missing neighbour.
    """
    places = [np.unique(np.asarray(axis), return_inverse=True)[1] for axis in (layers, iterations)]
    row_at = {position: row for row, position in enumerate(zip(*(axis.tolist() for axis in places), strict=True))}
    weights: Matrix = np.eye(len(row_at))
    for step in ((1, 0), (0, 1)):
        along = np.zeros_like(weights)
        for (layer, iteration), row in row_at.items():
            along[row, row] += 0.5
            for way in (1, -1):
                neighbour = (layer + way * step[0], iteration + way * step[1])
                along[row, row_at.get(neighbour, row)] += 0.25
        weights = along @ weights
    return weights


def _check(streams: Sequence[SiteScores], groups: Sequence[str]) -> None:
    counts = sorted({stream.scores.n_groups for stream in streams})
    if counts != [len(groups)]:
        raise UsageError(
            f"streams on {counts} groups, and {len(groups)} names of groups; expected one or more streams on the "
            "same groups, and a name for each"
        )
    if counts[0] < FEWEST_GROUPS:
        raise TooFewGroupsError(
            f"{counts[0]} independent groups of items; expected at least {FEWEST_GROUPS}, so that every outer "
            "fold tests one. Extract more items of this category."
        )
    for stream in streams:
        finite = np.isfinite(stream.scores.sums).all() and np.isfinite(stream.guide).all()
        if not (finite and (stream.scores.sizes > 0).all()):
            raise UsageError(
                "sums hold NaN, or a group has no episode; expected finite sums of groups with episodes"
            )


def _check_inner(quality: Matrix, scores: GroupSums, folds: NDArray[np.intp]) -> None:
    sites, count = scores.sums.shape
    if quality.ndim != 3 or quality.shape[::2] != (sites, count) or folds.shape != (count,):
        raise UsageError(
            f"inner qualities {quality.shape} and folds {folds.shape} for {sites} sites and {count} groups; "
            "expected (sites, folds, groups), and a fold for each group"
        )
    if not ((folds >= 0) & (folds < quality.shape[1])).all():
        raise UsageError(f"a group is tested by fold {folds.max()}; expected folds 0 to {quality.shape[1] - 1}")
    if quality[:, folds, np.arange(count)].any():
        raise UsageError(
            "inner qualities of groups in the fold that tests them; expected 0 there, as these groups may not "
            "take part in its choice"
        )
