"""Transfer of stored probes to the activations of another run on the same episodes. Nothing is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_directions import Direction
from probe_kit.train.results.probe_results import ProbeResults

Features = NDArray[np.float64]

PERMUTATIONS = 999
"""Of the labels of whole groups, for the p of a transfer."""
_CONSTANT = 1e-9
"""Share of the largest deviation below which a feature does not vary."""


@dataclass(frozen=True)
class ProbedRun:
    """A run of one wording, with its probes."""

    run: RunReader
    results: ProbeResults

    def features(self, site: Site, view: str, episodes: NDArray[np.str_]) -> Features:
        """(E, D) of these episodes, in this order."""
        at = {name: row for row, name in enumerate(self.run.episodes["episode_id"].astype(str))}
        return np.asarray(self.run.column(site, view)[[at[name] for name in episodes]], np.float64)


@dataclass(frozen=True)
class Transfer:
    """The accuracy of the probes of one run on the activations of another, at S sites, as shares.

    raw: decisions as they are. recentred: features are first centred and scaled as in the other run's own
    training folds, without labels. p_fwe: of `recentred`, against the best site under label permutations of whole
    groups.
    """

    raw: Features
    recentred: Features
    p_fwe: Features


def transfer(
    probed: ProbedRun, other: ProbedRun, category: str, view: str, sites: Sequence[Site], common: NDArray[np.str_]
) -> Transfer:
    """Decisions of `probed`'s probes on `other`'s activations of the `common` episodes.

    Each episode is judged by the probe that was trained without its fold. Raises UnknownSiteError for a site
    without a stored direction.
    """
    curve = probed.results.curves[category, view]
    rows = np.flatnonzero(np.isin(curve.episodes, common))
    episodes, labels = curve.episodes[rows], curve.labels[rows]
    raw, recentred = np.empty((2, len(sites), rows.size))
    for at, site in enumerate(sites):
        direction = probed.results.direction(category, view, site)
        of_probed, of_other = (run.features(site, view, episodes) for run in (probed, other))
        raw[at] = _decisions(direction, of_other, of_other, of_other, curve.fold_of[rows], curve)
        recentred[at] = _decisions(direction, of_other, of_probed, of_other, curve.fold_of[rows], curve)
    null = flip_groups(labels, curve.groups[rows], PERMUTATIONS, derive_seed("transfer", category, view))
    right = np.array([correctness(run[:, None], null).mean(axis=0) for run in recentred])
    accuracies = (correctness(run, labels[None, :]).mean(axis=1) for run in (raw, recentred))
    accuracy, aligned = accuracies
    return Transfer(accuracy, aligned, max_statistic_p(aligned, right))


def _decisions(
    direction: Direction,
    features: Features,
    like: Features,
    origin: Features,
    fold_of: NDArray[np.int64],
    curve: ProbeCurve,
) -> Features:
    """Return (E,) decisions on features (E, D), moved and scaled from `origin`'s training folds to `like`'s."""
    decisions = np.empty(len(features))
    for position, fold in enumerate(np.unique(curve.fold_of)):
        tested = fold_of == fold
        moved = features[tested]
        if like is not origin:
            moved = _moved(moved, origin[~tested], like[~tested])
        decisions[tested] = moved @ direction.weights[position].astype(np.float64) + direction.intercepts[position]
    return decisions


def _moved(features: Features, origin: Features, like: Features) -> Features:
    """Features with means and deviations of `like` instead of those of `origin`; constant ones become means."""
    spread = origin.std(axis=0)
    scale = np.divide(like.std(axis=0), spread, out=np.zeros_like(spread), where=spread > _CONSTANT * spread.max())
    moved: Features = (features - origin.mean(axis=0)) * scale + like.mean(axis=0)
    return moved


@dataclass(frozen=True)
class Agreement:
    """Cosines of the directions of two runs at a site.

    raw: of their unit vectors. weighted: by the covariance of the second run's activations, which is the
    correlation of the two decisions. ceiling: mean raw cosine between the folds of the first run.
    """

    raw: float
    weighted: float
    ceiling: float


def agreement(first: Direction, second: Direction, features: Features) -> Agreement:
    """Return the cosines of the directions of two runs. features: (E, D) of the second run."""
    before, after = first.unit, second.unit
    varied = features - features.mean(axis=0)
    # Weights of zero, such as of constant features, have no direction and stay zero.
    units = first.weights / np.linalg.norm(first.weights, axis=1, keepdims=True).clip(min=1e-30)
    between = units @ units.T
    folds = len(units)
    ceiling = (between.sum() - np.trace(between)) / (folds * (folds - 1))
    return Agreement(float(before @ after), _cosine(varied @ before, varied @ after), float(ceiling))


def _cosine(first: Features, second: Features) -> float:
    length = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / length if length else float("nan")
