"""Stored probes of one run, scored on the same episodes of another: nothing is fitted.

`transfer_probes` asks whether a probe reads *other* items: it is fitted on all of a run, and items of both runs
are left out. Here the question is whether it reads *the same* items in another network. An item of both runs is
judged by the probe of the fold that was trained without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p
from probe_kit.statistics.sufficiency import permuted_threshold
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.results.probe_results import Direction, ProbeResults
from probe_kit.train.transfer import move_features

PERMUTATIONS = 999
"""Number of permutations of the labels of whole groups, for the p of a transfer.

With the observed order, p comes in steps of 1/1000.
"""
_CONSTANT = 1e-9
"""Share of the largest deviation below which a feature does not vary."""

ProbedRun = tuple[RunReader, ProbeResults]
"""A run of one wording, with its probes."""


@dataclass(frozen=True)
class StoredTransfer:
    """Stored probes of S sites on the activations of another run.

    Attributes:
        accuracy: (S,) shares of right decisions, as they are.
        recentred: (S,) the same, after features were centred and scaled as in the other run's own training folds.
        p_fwe: (S,) family-wise p of `recentred`, against the best site under label permutations of whole groups.
        threshold: Accuracy that the best site exceeds in 5 % of the permutations.
    """

    accuracy: Matrix
    recentred: Matrix
    p_fwe: Matrix
    threshold: float

    def at(self, site: int) -> tuple[float, float, float]:
        """Return accuracy, recentred accuracy and p of a site, by its position."""
        return float(self.accuracy[site]), float(self.recentred[site]), float(self.p_fwe[site])


def transfer_stored_probes(
    probed: ProbedRun, other: ProbedRun, category: str, view: str, sites: Sequence[Site], common: NDArray[np.str_]
) -> StoredTransfer:
    """Return how well the probes of one run decide on the activations of another.

    Each of the `common` episodes is judged by the probe that was trained without its fold. No label takes part in
    the recentring.

    Args:
        probed: The run whose probes are used.
        other: The run whose activations they are used on.
        category: Category of the probes.
        view: View of the probes.
        sites: The S sites, which both runs have.
        common: Ids of episodes that both runs have.

    Raises:
        UnknownSiteError: For a site without a stored direction.
    """
    curve = probed[1].curves[category, view]
    rows = np.flatnonzero(np.isin(curve.episodes, common))
    episodes, labels, fold_of = curve.episodes[rows], curve.labels[rows], curve.fold_of[rows]
    folds = np.unique(curve.fold_of)
    raw, recentred = np.empty((2, len(sites), rows.size))
    for at, site in enumerate(sites):
        direction = probed[1].direction(category, view, site)
        of_probed, of_other = (features_of(run, site, view, episodes) for run, _ in (probed, other))
        raw[at] = _decisions(direction, of_other, None, fold_of, folds)
        recentred[at] = _decisions(direction, of_other, of_probed, fold_of, folds)
    null = flip_groups(labels, curve.groups[rows], PERMUTATIONS, derive_seed("transfer", category, view))
    right = np.array([correctness(run[:, None], null).mean(axis=0) for run in recentred])
    accuracy, aligned = (correctness(run, labels[None, :]).mean(axis=1) for run in (raw, recentred))
    return StoredTransfer(accuracy, aligned, max_statistic_p(aligned, right), permuted_threshold(right))


def features_of(run: RunReader, site: Site, view: str, episodes: NDArray[np.str_]) -> Matrix:
    """Return the features (E, D) of these episodes, in this order."""
    at = {name: row for row, name in enumerate(run.episodes["episode_id"].astype(str))}
    return np.asarray(run.column(site, view)[[at[name] for name in episodes]], np.float64)


def common_sites(sides: tuple[ProbedRun, ProbedRun], category: str, view: str) -> list[Site]:
    """Return the sites of both backbones, by name, where these are equally wide.

    Raises:
        UsageError: If there is none.
    """
    widths = []
    for run, results in sides:
        curve = results.curves[category, view]
        width = {name: stream.width for name, stream in run.streams.items()}
        widths.append({site: width[site.stream] for site in curve.sites if site.stream == curve.backbone_stream})
    shared = [site for site in widths[0] if widths[0][site] == widths[1].get(site)]
    if not shared:
        raise UsageError(
            f"{sides[0][0].location} and {sides[1][0].location} have no site of the backbone with one name and "
            "width in common: probes of one cannot be used on the other"
        )
    return shared


def _decisions(
    direction: Direction,
    features: Matrix,
    like: Matrix | None,
    fold_of: NDArray[np.int64],
    folds: NDArray[np.int64],
) -> Matrix:
    """Return decisions (E,) on features (E, D), moved and scaled from their own training folds to `like`'s."""
    decisions = np.empty(len(features))
    for position, fold in enumerate(folds):
        tested = fold_of == fold
        moved = features[tested]
        if like is not None:
            origin, goal = features[~tested], like[~tested]
            moved = move_features(moved, origin.mean(axis=0), goal.mean(axis=0), _scale(origin, goal))
        decisions[tested] = moved @ direction.weights[position].astype(np.float64) + direction.intercepts[position]
    return decisions


def _scale(origin: Matrix, goal: Matrix) -> Matrix:
    """Return what each feature's deviation must be multiplied by; 0 for a constant one, which becomes the mean."""
    spread = origin.std(axis=0)
    scale: Matrix = np.divide(
        goal.std(axis=0), spread, out=np.zeros_like(spread), where=spread > _CONSTANT * spread.max()
    )
    return scale
