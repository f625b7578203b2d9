"""Retention of maxima between its two bounds, and retention of the whole stack, which chooses nothing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import Site
from probe_kit.retention.estimators.cross_fit import (
    Crossfit,
    GroupScores,
    add_unobserved_variance,
    crossfit,
    scoring_covariance,
)

Matrix = NDArray[np.float64]
Places = tuple[Sequence[Site], Sequence[Site]]

PEAK_SHARE = 0.2
"""Weight of the peak on all groups: the estimate lies between two that are too low and too high on average.

A cross-fitted score is at most the best site's true one, as the choice sometimes misses it; a peak is at least
that, as it carries the luck of the maximum.
"""


def bounded_fit(
    backbone: GroupScores,
    expert: GroupScores,
    places: tuple[Sequence[Site], Sequence[Site]],
    chance: float,
    seed: int,
) -> Crossfit:
    """Scores above chance of both streams' best sites: 0.8 cross-fitted, 0.2 at the peak.

    places: the sites of both. They are chosen, not scored, on curves smoothed with their neighbours.
    The covariance is that of the cross-fitted scores: the peak varies less, which is not counted as a gain.
    """
    guided = [scores.guided(smoothing(sites)) for scores, sites in zip((backbone, expert), places, strict=True)]
    return crossfit(guided[0], guided[1], chance, seed, PEAK_SHARE)


def smoothing(sites: Sequence[Site]) -> Matrix:
    """(S, S) weights ¼, ½, ¼ along layers and along iterations; at an edge the site stands for its neighbour."""
    position = {site: row for row, site in enumerate(sites)}
    weights: Matrix = np.eye(len(sites))
    for axis in ("layer", "iteration"):
        values = sorted({getattr(site, axis) for site in sites} - {None})
        beside = {value: [*values[max(0, n - 1) : n], *values[n + 1 : n + 2]] for n, value in enumerate(values)}
        along: Matrix = 0.5 * np.eye(len(sites))
        for site, row in position.items():
            near = [replace(site, **{axis: value}) for value in beside.get(getattr(site, axis), ())]
            rows = [position[other] for other in near if other in position]
            for neighbour in [*rows, row, row][:2]:
                along[row, neighbour] += 0.25
        weights = along @ weights
    return weights


def area_fit(backbone: GroupScores, expert: GroupScores, chance: float) -> Crossfit:
    """Mean scores above chance over all sites of both streams: no choice, and so no bias of choosing."""
    held_out = np.array([stream.sums.mean(axis=0) for stream in (expert, backbone)])
    above = held_out.sum(axis=1) / backbone.sizes.sum() - chance
    covariance = scoring_covariance(held_out, backbone.sizes)
    covariance = add_unobserved_variance(covariance, held_out, backbone.sizes)
    return Crossfit(float(above[0]), float(above[1]), covariance, held_out, backbone.sizes)
