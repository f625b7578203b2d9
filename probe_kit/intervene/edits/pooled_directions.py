"""Directions in which an answer can be written, found in the run's columns without the episode they are used on.

A probe's weights are the direction in which the answer is best *read*: they are turned away from what else varies.
Where it *lies* is the difference of the two class means, and that is the direction to write along.

These are directions of a mean over tokens. An answer that lies in *which* tokens are marked leaves no mean behind;
see `token_directions`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoDirectionError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.contract.views import resolve_view
from probe_kit.intervene.edits.linear_erasure import NO_DIRECTION
from probe_kit.runs.run import Run
from probe_kit.statistics.folds import grouped_folds

Vector = NDArray[np.float32]
MEAN_DIFFERENCE, PROBE = "mean-difference", "probe"
DIRECTIONS = (MEAN_DIFFERENCE, PROBE)
FOLDS = 5
_ROUNDING = 1e-6
"""Share of a number's size below which a difference of stored float32 means is rounding."""


@dataclass(frozen=True)
class PooledDirections:
    """Unit directions of one site and role, per category and fold.

    units: by name and category (F, D) float32. half_gaps: by category (F,), half the distance of the class means
    along the first of them. fold_of: by episode.
    """

    units: Mapping[tuple[str, str], Vector]
    half_differences: Mapping[str, NDArray[np.float64]]
    fold_of: Mapping[str, int]
    control_names: tuple[str, ...] = ()

    def basis(self, name: str, episode: str, category: str) -> Vector:
        """(1, D) the direction that never saw this episode."""
        return self.of(name, episode, category)[None]

    def of(self, name: str, episode: str, category: str) -> Vector:
        """(D,) the direction that never saw this episode."""
        return np.asarray(self.units[name, category][self.fold_of[episode]])

    def half_difference(self, episode: str, category: str) -> float:
        """Half the distance of the class means, for this episode."""
        return float(self.half_differences[category][self.fold_of[episode]])

    def shift(self, name: str, episode: str, category: str, strength: float) -> Vector:
        """(D,) so many half differences of the class means, toward `left`."""
        return np.float32(strength * self.half_difference(episode, category)) * self.of(name, episode, category)


def control_names(count: int) -> tuple[str, ...]:
    """Of so many random directions beside another one."""
    return tuple(f"control-{number + 1}" for number in range(count))


def view_of(role: str) -> str:
    """The pooled view in which a role's tokens are averaged."""
    return "mean" if role == "all" else f"mean:{role}"


def fit_directions(
    run: Run,
    site: Site,
    role: str,
    direction: str,
    controls: int,
    seed: int,
    categories: Sequence[str] | None = None,
) -> PooledDirections:
    """Directions of these categories, by default of all, from the pooled tokens of `role` at `site`.

    Raises UsageError for an unknown direction, NoDirectionError for equal class means, UnknownSiteError for a site
    or view that is not stored.
    """
    if direction not in DIRECTIONS:
        raise UsageError(f"unknown direction {direction!r}; expected one of {', '.join(DIRECTIONS)}")
    episodes = run.episodes
    features = run.column(site, resolve_view(view_of(role), run.views(site.stream))).astype(np.float64)
    names = control_names(controls)
    units: dict[tuple[str, str], Vector] = {}
    gaps: dict[str, NDArray[np.float64]] = {}
    fold_of: dict[str, int] = {}
    for category in categories or dict.fromkeys(episodes["category"].astype(str)):
        rows = np.flatnonzero((episodes["category"] == category).to_numpy())
        left = (episodes["side_correct"].to_numpy()[rows] == "left").astype(int)
        groups = episodes["group_id"].to_numpy(dtype=str)[rows]
        folds = grouped_folds(
            left, groups, min(FOLDS, np.unique(groups).size), derive_seed("axes", seed, category)
        )
        of_fold: dict[str, list[NDArray[np.float64]]] = {name: [] for name in (direction, *names)}
        widths = []
        for number, fold in enumerate(folds):
            fold_of |= {str(name): number for name in episodes["episode_id"].to_numpy()[rows[fold.test]]}
            training, labels = features[rows[fold.train]], left[fold.train].astype(bool)
            difference = training[labels].mean(axis=0) - training[~labels].mean(axis=0)
            if (np.abs(difference) <= _ROUNDING * np.abs(training).max(axis=0)).all():
                raise NoDirectionError(
                    f"{category}, {site}, role {role}: no direction for {direction}: {NO_DIRECTION}"
                )
            unit = _direction(training, labels, direction)
            widths.append(abs(float(difference @ unit)) / 2)
            of_fold[direction].append(unit)
            draw = np.random.default_rng(derive_seed("control", seed, category, str(site), role, number))
            for name in names:
                of_fold[name].append(_control(training, [unit, _unit(difference)], draw))
        units |= {(name, category): np.array(found, np.float32) for name, found in of_fold.items()}
        gaps[category] = np.array(widths)
    return PooledDirections(units, gaps, fold_of, names)


def _direction(training: NDArray[np.float64], left: NDArray[np.bool_], direction: str) -> NDArray[np.float64]:
    """(D,) of length 1, toward `left`."""
    if direction == MEAN_DIFFERENCE:
        return _unit(training[left].mean(axis=0) - training[~left].mean(axis=0))
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(training)
    fitted = LogisticRegression(C=0.01, max_iter=1000).fit(scaler.transform(training), left)
    return _unit(fitted.coef_[0] / scaler.scale_)


def _control(
    training: NDArray[np.float64], others: list[NDArray[np.float64]], draw: np.random.Generator
) -> NDArray[np.float64]:
    """(D,) of length 1, drawn from the training data's covariance and orthogonal to `others`."""
    centred = training - training.mean(axis=0)
    found = centred.T @ draw.normal(size=len(centred))
    basis, _ = np.linalg.qr(np.stack(others, axis=1))
    return _unit(found - basis @ (basis.T @ found))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length else vector
