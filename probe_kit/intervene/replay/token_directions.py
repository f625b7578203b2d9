"""Directions of the tokens themselves, for answers that lie in which tokens are marked.

Marks on the left tile for one answer and on the right tile for the other cancel in a mean over tokens. The
differences of class means at every position do not: they lie along few directions, which are the same for every
token.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.intervene.edits.linear_erasure import Method, half_differences
from probe_kit.intervene.edits.pooled_directions import (
    DIRECTIONS,
    MEAN_DIFFERENCE,
    Vector,
    control_names,
    fit_directions,
)
from probe_kit.intervene.edits.sites import SiteGroup
from probe_kit.intervene.replay.passed_over import PassedOver
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.replay.token_features import (
    Fits,
    TokenFeatures,
    by_episode,
    collect_token_features,
    fit_by_fold,
)


class DirectionBasis(Protocol):
    """Directions by name, each found without the episode that it is used on."""

    @property
    def control_names(self) -> tuple[str, ...]:
        """Of the random ones beside the one that was asked for."""

    def basis(self, name: str, episode: str, category: str) -> Vector:
        """(K, D) float32, orthonormal."""

    def shift(self, name: str, episode: str, category: str, strength: float) -> Vector:
        """(D,) or (T, D) float32, so many half differences of the class means, toward `left`.

        (T, D): the t-th row belongs to the role's t-th token. Of a control: as far, along its own directions.
        """


@dataclass(frozen=True)
class TokenDirections:
    """Of one site and role.

    bases: by name and episode, (K, D) float32. half_differences: by episode (T, K), half the differences of the
    class means at the role's positions along the directions that were asked for.
    """

    bases: Mapping[tuple[str, str], Vector]
    half_differences: Mapping[str, NDArray[np.float64]]
    control_names: tuple[str, ...] = ()

    def basis(self, name: str, episode: str, category: str) -> Vector:
        """(K, D) the directions that never saw this episode."""
        del category  # an episode has one
        return self.bases[name, episode]

    def shift(self, name: str, episode: str, category: str, strength: float) -> Vector:
        """(T, D) of all positions; a mark on either tile has its own sign at the positions of each."""
        del category
        return np.float32(strength * self.half_differences[episode]) @ self.bases[name, episode]


def check_direction(direction: str) -> None:
    """Raises UsageError for what is no direction to patch tokens within."""
    if direction.startswith(f"{MEAN_DIFFERENCE}:"):
        Method.of(direction)
    elif direction not in DIRECTIONS:
        raise UsageError(
            f"unknown direction {direction!r}; expected {', '.join(DIRECTIONS)}, or {MEAN_DIFFERENCE}:K for K "
            "directions of the tokens themselves"
        )


def fit_token_directions(
    session: ReplaySession,
    items: Sequence[str],
    wanted: Mapping[SiteGroup, Sequence[str]],
    direction: str,
    controls: int,
    seed: int,
    passed_over: PassedOver,
) -> dict[tuple[SiteGroup, str], DirectionBasis]:
    """By place and role what `direction` means there: of the run's columns, or of the tokens of these items (ids).

    `mean-difference:K`: the K directions along which the differences of class means at all positions lie most, the
    same for every token; from one clean inference per episode and place. wanted: roles by place. passed_over: what
    may be left out. Raises UnknownSiteError for a place of several sites or one that is not stored,
    NoDirectionError for a named place without a direction, UsageError where there are too few episodes to learn
    from.
    """
    categories = tuple(dict.fromkeys(session.items[item].category for item in items))
    if ":" not in direction:
        pooled: dict[tuple[SiteGroup, str], DirectionBasis] = {}
        for place, role in ((place, role) for place, roles in wanted.items() for role in roles):
            with passed_over.fitting(place, role):
                pooled[place, role] = fit_directions(
                    session.run, place.only_site, role, direction, controls, seed, categories
                )
        return passed_over.left(pooled)
    bases: dict[tuple[SiteGroup, str], dict[tuple[str, str], Vector]] = {}
    halves: dict[tuple[SiteGroup, str], dict[str, NDArray[np.float64]]] = {}
    for place, role, category, own in collect_token_features(session, items, wanted):
        with passed_over.fitting(place, role):
            fits = fit_by_fold(own, place.only_site, role, Method.of(direction), controls, seed, category)
            found = bases.setdefault((place, role), {})
            for name, of_episode in by_episode(own, fits).items():
                found |= {
                    (name, episode): eraser.removed[0].astype(np.float32) for episode, eraser in of_episode.items()
                }
            halves.setdefault((place, role), {}).update(half_differences_of(own, fits, direction))
    return {
        cell: TokenDirections(found, halves[cell], control_names(controls))
        for cell, found in passed_over.left(bases).items()
    }


def half_differences_of(own: TokenFeatures, fits: Fits, direction: str) -> dict[str, NDArray[np.float64]]:
    """Return by episode (T, K) half the differences of the class means, of the folds that it is not in."""
    found: dict[str, NDArray[np.float64]] = {}
    for fold, fitted in fits:
        halves = half_differences(own.tokens.only(fold.train), own.left[fold.train], fitted[direction])
        found |= dict.fromkeys((own.episodes[row] for row in fold.test), halves)
    return found
