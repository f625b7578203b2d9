"""Directions in which an answer can be written, each found without the episode that it is used on.

A probe's weights are the direction in which the answer is best *read*: they are turned away from all other
variation. The answer *lies* along the difference of the two class means, and that is the direction to write along.

Pooled directions are of a mean over tokens, from the run's columns. An answer that lies in *which* tokens are
marked leaves no mean behind. Marks on the left tile for one answer and on the right tile for the other cancel. The
differences of class means at every position do not cancel. They lie along few directions, which are the same for
every token. These are found in the tokens themselves.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoDirectionError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site, resolve_view
from probe_kit.intervene.erasers import (
    NO_DIRECTION,
    Eraser,
    Method,
    PaddedTokens,
    fit_control,
    fit_eraser,
    half_differences,
)
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import SiteGroup, resolve_all
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.settings import items_of
from probe_kit.intervene.tokens import token_mask
from probe_kit.runs.direction_files import FileDirection
from probe_kit.runs.run import Run
from probe_kit.statistics.folds import Fold, grouped_folds
from probe_kit.train.solver.arrays import Standardiser

Vector = NDArray[np.float32]
MEAN_DIFFERENCE, PROBE = "mean-difference", "probe"
DIRECTIONS = (MEAN_DIFFERENCE, PROBE)
FOLDS = 5
"""Number of folds of groups; a direction used on an episode is fitted on the folds that its group is not in."""
_ROUNDING = 1e-6
"""Share of a number's size below which a difference of stored float32 means is rounding."""
EVERY_EPISODE = ""
"""Key in place of an episode: the directions of a file are the same for all."""


@dataclass(frozen=True)
class Directions:
    """Directions of one site and role by name, each found without the episode that it is used on.

    Attributes:
        bases: By name and episode, (K, D) float32, orthonormal.
        halves: By episode, (K,) or (T, K) half the differences of the class means along the requested directions.
            They are of a mean over tokens, or of the role's T positions.
        control_names: Names of the random directions that serve as controls.
        vectors: By name, (D,) the step of a file's direction, in place of a half difference; None for directions
            that are not from a file.
    """

    bases: Mapping[tuple[str, str], Vector]
    halves: Mapping[str, NDArray[np.float64]]
    control_names: tuple[str, ...] = ()
    vectors: Mapping[str, Vector] | None = None

    def basis(self, name: str, episode: str) -> Vector:
        """Return the basis (K, D) of one direction on an episode."""
        return self.bases[name, episode if self.vectors is None else EVERY_EPISODE]

    def shift(self, name: str, episode: str, strength: float) -> Vector:
        """Return a step of so many half differences of the class means, toward `left`.

        Along a control, the step has the same size.

        Args:
            name: Name of the direction or control.
            episode: Id of the episode that is changed.
            strength: Number of half differences; negative away from `left`.

        Returns:
            (D,) or (T, D) float32. The t-th row of (T, D) belongs to the role's t-th token. A mark on either tile
            has its own sign at the positions of each.
        """
        if self.vectors is not None:
            return np.float32(strength) * self.vectors[name]
        return np.float32(strength * self.halves[episode]) @ self.bases[name, episode]


def check_direction(direction: str) -> None:
    """Refuse a name that is no direction to patch tokens within.

    Raises:
        UsageError: For an unknown direction.
    """
    if direction.startswith(f"{MEAN_DIFFERENCE}:"):
        Method.of(direction)
    elif direction not in DIRECTIONS:
        raise UsageError(
            f"unknown direction {direction!r}; expected {', '.join(DIRECTIONS)}, {MEAN_DIFFERENCE}:K for K "
            "directions of the tokens themselves, or FILE#NAME of a safetensors or npz file"
        )


def control_names(count: int) -> tuple[str, ...]:
    """Return the names of so many random directions that serve as controls."""
    return tuple(f"control-{number + 1}" for number in range(count))


def fit_directions_in_cells(
    session: ReplaySession,
    cells: Sequence[Cell],
    patterns: Sequence[str],
    direction: str,
    *,
    controls: int,
    seed: int,
    categories: Sequence[str] | None,
    vector: FileDirection | None,
) -> dict[Cell, Directions]:
    """Find a direction in every cell, in the run's columns or in all its tokens.

    `mean-difference:K` is the K directions along which the differences of class means at all positions lie most,
    the same for every token. They come from one clean inference per episode and place.

    Args:
        session: Session of the run.
        cells: Cells to find directions in.
        patterns: Names of the places as the user wrote them; places of a wildcard may be left out.
        direction: Name of the direction, see `check_direction`.
        controls: Number of random directions that serve as controls.
        seed: Seed of controls and folds.
        categories: Categories of the run; None for all.
        vector: Direction of a file; None for one that is found here.

    Raises:
        NoDirectionError: For a named place without a direction.
        UnknownSiteError: For a place of several sites or one that is not stored.
        UsageError: If there are too few episodes to fit on.
    """
    if vector is not None:
        return {cell: _direction_in_cell(session, cell, vector, controls, seed) for cell in cells}
    items = items_of(session.run, categories, None)
    passed_over = PassedOver(session, patterns)
    fitted: dict[Cell, Directions] = {}
    if ":" not in direction:  # of the mean over tokens, which the run stores: no inference is made
        in_run = tuple(dict.fromkeys(session.categories_of(items)))
        for cell in cells:
            with passed_over.fitting(cell):
                fitted[cell] = fit_pooled_directions(
                    session.run, cell.site_group.only_site, cell.role, direction, controls, seed, in_run
                )
        return passed_over.left(fitted)
    for cell, category, features in collect_token_features(session, items, cells):
        with passed_over.fitting(cell):
            fits = fit_by_fold(features, cell, Method.of(direction), controls, seed, category)
            before = fitted.get(cell, Directions({}, {}))
            bases = {
                (name, episode): eraser.removed[0].astype(np.float32)
                for name, of_episode in by_episode(features, fits).items()
                for episode, eraser in of_episode.items()
            }
            halves = half_differences_of(features, fits, direction)
            fitted[cell] = Directions(
                {**before.bases, **bases}, {**before.halves, **halves}, control_names(controls)
            )
    return passed_over.left(fitted)


def _direction_in_cell(
    session: ReplaySession, cell: Cell, vector: FileDirection, controls: int, seed: int
) -> Directions:
    """Return a file's direction in a cell.

    Raises:
        UsageError: For another site, width or model than the file's.
    """
    run, site = session.run, cell.site_group.only_site
    vector.check(cell.site_group.name, run.streams[site.stream].width, run.weights_sha256)
    basis, total = vector.basis.astype(np.float64), vector.vectors.sum(axis=0)
    bases, vectors = {(vector.name, EVERY_EPISODE): vector.basis}, {vector.name: total.astype(np.float32)}
    names = control_names(controls)
    if names:
        view = resolve_view(view_of(cell.role), run.views(site.stream))
        features = run.column(site, view).astype(np.float64)
    for name in names:
        draw = np.random.default_rng(derive_seed("control", seed, str(site), cell.role, name))
        rows = list[NDArray[np.float64]]()
        for _ in basis:
            rows.append(_control(features, [*basis, *rows], draw))
        bases[name, EVERY_EPISODE] = np.array(rows, np.float32)
        vectors[name] = (np.linalg.norm(total) * rows[0]).astype(np.float32)
    return Directions(bases, {}, names, vectors)


class PassedOver:
    """A record of places without a direction: one that is named raises, one of a wildcard is left out."""

    def __init__(self, session: ReplaySession, patterns: Sequence[str]) -> None:
        self._session = session
        self._required = resolve_all([name for name in patterns if "*" not in name], session.policy)
        self._cells: set[Cell] = set()
        self._last: NoDirectionError | None = None

    @contextmanager
    def fitting(self, cell: Cell) -> Iterator[None]:
        """Fit directions at a cell; NoDirectionError is raised for a named place, and recorded for others."""
        try:
            yield
        except NoDirectionError as error:
            if cell.site_group.name in self._required:
                raise
            self._cells.add(cell)
            self._last = error
            self._session.passed_over[str(cell)] = str(error)

    def left[T](self, fitted: Mapping[Cell, T]) -> dict[Cell, T]:
        """Return the fits without the cells that a category passed over.

        Raises:
            NoDirectionError: If no cell is left; it is the last one recorded.
        """
        remaining = {cell: fit for cell, fit in fitted.items() if cell not in self._cells}
        if not remaining and self._last is not None:
            raise self._last
        return remaining


# -- of a mean over tokens -----------------------------------------------------------------------------------


def view_of(role: str) -> str:
    """Return the pooled view in which a role's tokens are averaged."""
    return "mean" if role == "all" else f"mean:{role}"


def fit_pooled_directions(
    run: Run,
    site: Site,
    role: str,
    direction: str,
    controls: int,
    seed: int,
    categories: Sequence[str] | None = None,
) -> Directions:
    """Find the directions of some categories in the pooled tokens of `role` at `site`.

    Args:
        run: Run with the stored streams.
        site: Site of a residual stream.
        role: Role of the tokens.
        direction: Name of the direction, `mean-difference` or `probe`.
        controls: Number of random directions that serve as controls.
        seed: Seed of controls and folds.
        categories: Categories to fit; None for all of the run.

    Raises:
        UsageError: For an unknown direction.
        NoDirectionError: For equal class means.
        UnknownSiteError: For a site or view that is not stored.
    """
    if direction not in DIRECTIONS:
        raise UsageError(f"unknown direction {direction!r}; expected one of {', '.join(DIRECTIONS)}")
    episodes = run.episodes
    stored = run.column(site, resolve_view(view_of(role), run.views(site.stream)))
    features = stored.astype(np.float64)
    names = control_names(controls)
    bases: dict[tuple[str, str], Vector] = {}
    halves: dict[str, NDArray[np.float64]] = {}
    for category in categories or dict.fromkeys(episodes["category"].astype(str)):
        rows = np.flatnonzero((episodes["category"] == category).to_numpy())
        is_left = (episodes["side_correct"].to_numpy()[rows] == "left").astype(int)
        groups = episodes["group_id"].to_numpy(dtype=str)[rows]
        folds = grouped_folds(
            is_left, groups, min(FOLDS, np.unique(groups).size), derive_seed("axes", seed, category)
        )
        for number, fold in enumerate(folds):
            training, labels = features[rows[fold.train]], is_left[fold.train].astype(bool)
            difference = training[labels].mean(axis=0) - training[~labels].mean(axis=0)
            if (np.abs(difference) <= _ROUNDING * np.abs(training).max(axis=0)).all():
                raise NoDirectionError(
                    f"{category}, {site}, role {role}: no direction for {direction}: {NO_DIRECTION}"
                )
            varies = Standardiser.fit(stored[rows[fold.train]]).varies  # in the stored type, as `train` decides it
            unit = _direction(training, labels, direction, varies)
            draw = np.random.default_rng(derive_seed("control", seed, category, str(site), role, number))
            drawn = {name: _control(training, [unit, _unit(difference)], draw) for name in names}
            of_fold = {
                name: np.array(vector, np.float32)[None] for name, vector in {direction: unit, **drawn}.items()
            }
            half = np.array([abs(float(difference @ unit)) / 2])
            for episode in map(str, episodes["episode_id"].to_numpy()[rows[fold.test]]):
                bases |= {(name, episode): basis for name, basis in of_fold.items()}
                halves[episode] = half
    return Directions(bases, halves, names)


def _direction(
    training: NDArray[np.float64], is_left: NDArray[np.bool_], direction: str, varies: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return a direction (D,) of length 1, toward `left`.

    Args:
        training: (N, D) features.
        is_left: (N,) whether the correct picture lies left.
        direction: Name of the direction.
        varies: (D,) the features that a probe may use. One that is constant but for its last bit would be divided
            by that bit, and its rounding would be the whole direction.
    """
    if direction == MEAN_DIFFERENCE:
        return _unit(training[is_left].mean(axis=0) - training[~is_left].mean(axis=0))
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import StandardScaler

    varying = training[:, varies]
    scaler = StandardScaler().fit(varying)
    # A strong penalty: features are many and episodes few.
    fitted = LogisticRegression(C=0.01, max_iter=1000).fit(scaler.transform(varying), is_left)
    weights = np.zeros(training.shape[1])
    weights[varies] = fitted.coef_[0] / scaler.scale_
    return _unit(weights)


def _control(
    training: NDArray[np.float64], directions: list[NDArray[np.float64]], draw: np.random.Generator
) -> NDArray[np.float64]:
    """Draw a direction (D,) of length 1 from the training data's covariance, orthogonal to `directions`."""
    centred = training - training.mean(axis=0)
    drawn = centred.T @ draw.normal(size=len(centred))
    basis, _ = np.linalg.qr(np.stack(directions, axis=1))
    return _unit(drawn - basis @ (basis.T @ drawn))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length else vector


# -- of the tokens themselves --------------------------------------------------------------------------------

Fits = Sequence[tuple[Fold, Mapping[str, Eraser]]]
"""Every fold, and by name the eraser fitted on its training episodes."""
_Row = tuple[Pair, NDArray[np.float64]]
"""The pair of one episode, and its tokens (T, D)."""


@dataclass(frozen=True)
class TokenFeatures:
    """The tokens of one category in one cell, of N episodes.

    Attributes:
        episodes: (N,) ids of the episodes.
        groups: (N,) group of items of every episode.
        is_left: (N,) whether the correct picture lies left.
        tokens: The tokens; at position t the role's t-th token, see `erasers.PaddedTokens`.
    """

    episodes: tuple[str, ...]
    groups: NDArray[np.str_]
    is_left: NDArray[np.bool_]
    tokens: PaddedTokens


def collect_token_features(
    session: ReplaySession, items: Sequence[str], cells: Sequence[Cell]
) -> Iterator[tuple[Cell, str, TokenFeatures]]:
    """Yield cell, category and the tokens there, from one clean inference per episode and place.

    The tokens of one place and category are held at a time: 8 bytes per number, episodes × tokens × width.

    Args:
        session: Session of the run.
        items: Ids of the items, of which all episodes are used.
        cells: Cells to collect.

    Raises:
        UnknownSiteError: For a place of several sites.
    """
    by_place: dict[SiteGroup, list[Cell]] = {}
    for cell in cells:
        by_place.setdefault(cell.site_group, []).append(cell)
    sites = {site_group: site_group.only_site for site_group in by_place}
    of_category: dict[str, list[str]] = {}
    for item, category in zip(items, session.categories_of(items), strict=True):
        of_category.setdefault(category, []).append(item)
    count = 0
    for site_group, site in sites.items():
        for category, members in of_category.items():
            rows: dict[Cell, list[_Row]] = {cell: [] for cell in by_place[site_group]}
            for item in members:
                for pair in session.pairs(item):
                    _infer(session, pair, site, rows)
                count += 1
                if session.on_fit_progress is not None:
                    session.on_fit_progress(count, len(sites) * len(items), item)
            for cell in list(rows):
                yield cell, category, _pad(rows.pop(cell))


def _infer(session: ReplaySession, pair: Pair, site: Site, rows: Mapping[Cell, list[_Row]]) -> None:
    """Add the episode's row to those of every cell."""
    from probe_kit.hooks import capture

    with capture(session.policy, [site]) as activations:
        session.act(pair.clean, pair.seed)
    tokens = activations[site][0].double().cpu().numpy()
    for cell, values in rows.items():
        values.append((pair, tokens[token_mask(session.policy, pair.clean, site.stream, cell.role)]))


def _pad(rows: Sequence[_Row]) -> TokenFeatures:
    """Return sequences of different lengths as one array, aligned at their first tokens."""
    pairs, values = zip(*rows, strict=True)
    longest = max(map(len, values))
    tokens = np.zeros((len(rows), longest, values[0].shape[1]))
    present = np.zeros((len(rows), longest), bool)
    for row, sequence in enumerate(values):
        tokens[row, : len(sequence)], present[row, : len(sequence)] = sequence, True
    return TokenFeatures(
        tuple(pair.episode for pair in pairs),
        np.array([pair.group for pair in pairs]),
        np.array([pair.side == "left" for pair in pairs]),
        PaddedTokens(tokens, present),
    )


def fit_by_fold(
    features: TokenFeatures, cell: Cell, method: Method, controls: int, seed: int, category: str
) -> Fits:
    """Fit an eraser by `method` and its controls, for every fold of the groups of one category.

    Raises as `fit_eraser` where the tokens are not enough to fit on; the message then names category, site and
    role.
    """
    groups = min(FOLDS, np.unique(features.groups).size)
    site = cell.site_group.only_site
    seeds = derive_seed("erase", seed, category), derive_seed("control", seed, category, str(site), cell.role)
    folds = grouped_folds(features.is_left.astype(int), features.groups, groups, seeds[0])
    draw = np.random.default_rng(seeds[1])
    fits = []
    try:
        for fold in folds:
            training, is_left = features.tokens.only(fold.train), features.is_left[fold.train]
            eraser = fit_eraser(training, is_left, method)
            names = control_names(controls)
            drawn = {name: fit_control(training, is_left, method, eraser, draw) for name in names}
            fits.append((fold, {str(method): eraser, **drawn}))
    except UsageError as error:
        raise type(error)(f"{category}, {site}, role {cell.role}: {error}") from error
    return fits


def by_episode(features: TokenFeatures, fits: Fits) -> dict[str, dict[str, Eraser]]:
    """Return by name and episode the eraser that was fitted without that episode."""
    erasers: dict[str, dict[str, Eraser]] = {}
    for fold, fitted in fits:
        for name, eraser in fitted.items():
            erasers.setdefault(name, {}).update({features.episodes[row]: eraser for row in fold.test})
    return erasers


def half_differences_of(features: TokenFeatures, fits: Fits, direction: str) -> dict[str, NDArray[np.float64]]:
    """Return by episode (T, K) half the differences of the class means, of the folds that it is not in."""
    by_name: dict[str, NDArray[np.float64]] = {}
    for fold, fitted in fits:
        halves = half_differences(
            features.tokens.only(fold.train), features.is_left[fold.train], fitted[direction]
        )
        by_name |= dict.fromkeys((features.episodes[row] for row in fold.test), halves)
    return by_name
