"""The tokens of one place before the action, of whole categories, and what is fitted on them fold by fold."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.linear_erasure import Eraser, Method, PaddedTokens, fit_control, fit_eraser
from probe_kit.intervene.edits.pooled_directions import FOLDS, control_names
from probe_kit.intervene.edits.sites import SiteGroup, token_mask
from probe_kit.intervene.replay.session import ReplayInput, ReplaySession
from probe_kit.statistics.folds import Fold, grouped_folds

Fits = Sequence[tuple[Fold, Mapping[str, Eraser]]]
"""Every fold, and by name what is fitted on its training episodes."""
_Row = tuple[str, str, bool, NDArray[np.float64]]
"""Of one episode: its name, its group, whether the correct picture lies left, and (T, D) its tokens."""


@dataclass(frozen=True)
class TokenFeatures:
    """The tokens of one category at one site and role, of N episodes.

    episodes, groups: (N,). left: (N,) whether the correct picture lies left. tokens: at position t the role's
    t-th token, see `linear_erasure.PaddedTokens`.
    """

    episodes: tuple[str, ...]
    groups: NDArray[np.str_]
    left: NDArray[np.bool_]
    tokens: PaddedTokens


def collect_token_features(
    session: ReplaySession, items: Sequence[str], wanted: Mapping[SiteGroup, Sequence[str]]
) -> Iterator[tuple[SiteGroup, str, str, TokenFeatures]]:
    """Place, role, category and what was gathered there, from one clean inference per episode and place.

    items: by id, all of their episodes. wanted: roles by place. What is held at a time is of one place and
    category: 8 bytes per number, episodes × tokens × width. Raises UnknownSiteError for a place of several sites.
    """
    sites = {place: place.only_site for place, roles in wanted.items() if roles}
    of_category: dict[str, list[str]] = {}
    for item in items:
        of_category.setdefault(session.items[item].category, []).append(item)
    done = 0
    for place, site in sites.items():
        for category, own in of_category.items():
            rows: dict[str, list[_Row]] = {role: [] for role in wanted[place]}
            for item in own:
                for replay_input in session.replay_inputs(item):
                    _infer(session, replay_input, site, rows)
                done += 1
                if session.on_fit_progress is not None:
                    session.on_fit_progress(done, len(sites) * len(items), item)
            for role in list(rows):
                yield place, role, category, _pad(rows.pop(role))


def _infer(session: ReplaySession, replay_input: ReplayInput, site: Site, rows: Mapping[str, list[_Row]]) -> None:
    """Add the episode's row to those of every role."""
    from probe_kit.hooks import capture

    with capture(session.policy, [site]) as tape:
        session.act(replay_input.seen, replay_input.seed)
    passing = tape[site][0].double().cpu().numpy()
    for role, found in rows.items():
        mask = token_mask(session.policy, replay_input.seen, site.stream, role)
        found.append(
            (replay_input.episode_id, replay_input.group_id, replay_input.side_correct == "left", passing[mask])
        )


def _pad(rows: Sequence[_Row]) -> TokenFeatures:
    """Sequences of different lengths side by side, their first tokens together."""
    episodes, groups, left, values = zip(*rows, strict=True)
    longest = max(len(own) for own in values)
    tokens = np.zeros((len(rows), longest, values[0].shape[1]))
    present = np.zeros((len(rows), longest), bool)
    for row, own in enumerate(values):
        tokens[row, : len(own)], present[row, : len(own)] = own, True
    return TokenFeatures(tuple(episodes), np.array(groups), np.array(left), PaddedTokens(tokens, present))


def fit_by_fold(
    own: TokenFeatures, site: Site, role: str, method: Method, controls: int, seed: int, category: str
) -> Fits:
    """An eraser called `method` and its controls, for every fold of the groups of one category.

    Raises as `fit_eraser` does, where there is nothing to learn from, and names category, site and role.
    """
    groups = min(FOLDS, np.unique(own.groups).size)
    folds = grouped_folds(own.left.astype(int), own.groups, groups, derive_seed("erase", seed, category))
    draw = np.random.default_rng(derive_seed("control", seed, category, str(site), role))
    try:
        return [(fold, _fitted(own, fold, method, controls, draw)) for fold in folds]
    except UsageError as error:
        raise type(error)(f"{category}, {site}, role {role}: {error}") from error


def by_episode(own: TokenFeatures, fits: Fits) -> dict[str, dict[str, Eraser]]:
    """By name and episode, what never saw that episode."""
    found: dict[str, dict[str, Eraser]] = {}
    for fold, fitted in fits:
        for name, eraser in fitted.items():
            found.setdefault(name, {}).update({own.episodes[row]: eraser for row in fold.test})
    return found


def _fitted(
    own: TokenFeatures, fold: Fold, method: Method, controls: int, draw: np.random.Generator
) -> dict[str, Eraser]:
    training, left = own.tokens.only(fold.train), own.left[fold.train]
    eraser = fit_eraser(training, left, method)
    beside = {name: fit_control(training, left, method, eraser, draw) for name in control_names(controls)}
    return {str(method): eraser, **beside}
