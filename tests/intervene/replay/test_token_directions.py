"""Directions of the tokens themselves: where which token is marked is the answer, and the mean holds nothing."""

from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Site, capture
from probe_kit.intervene import ClosedLoop, Interchange, ReplayFiles, Steering, run_intervention
from probe_kit.intervene.directions import (
    Directions,
    TokenFeatures,
    by_episode,
    fit_by_fold,
    half_differences_of,
)
from probe_kit.intervene.erasers import Method, PaddedTokens
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import SiteGroup, resolve_sites
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.runs import Run

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

SITE = Site("backbone", 2)
CELL = Cell(SiteGroup("backbone.02", (SITE,)), "image")
GROUPS, POSITIONS, WIDTH = 10, 6, 12


def marked(mark: np.ndarray, seed: int = 0) -> TokenFeatures:
    """Four episodes per group: the first half of the tokens is marked for left, the second half for right."""
    draw = np.random.default_rng(seed)
    is_left = np.tile([True, False], 2 * GROUPS)
    values = 0.05 * draw.normal(size=(is_left.size, POSITIONS, WIDTH))
    first = np.arange(POSITIONS) < POSITIONS // 2
    values += np.where(is_left[:, None] == first, 0.5, -0.5)[..., None] * mark
    groups = np.repeat([f"g{number}" for number in range(GROUPS)], 4)
    names = tuple(f"episode-{row}" for row in range(is_left.size))
    return TokenFeatures(names, groups, is_left, PaddedTokens(values, np.ones(values.shape[:2], bool)))


def test_marks_that_cancel_in_the_mean_lie_along_one_direction() -> None:
    mark = np.eye(WIDTH)[3]
    features = marked(mark)
    pooled = features.tokens.values.mean(axis=1)
    difference = pooled[features.is_left].mean(axis=0) - pooled[~features.is_left].mean(axis=0)
    assert np.linalg.norm(difference) < 0.05
    fits = fit_by_fold(features, CELL, Method.of("mean-difference:1"), 2, 0, "color")
    directions = by_episode(features, fits)
    assert set(directions) == {"mean-difference:1", "control-1", "control-2"}
    for episode in features.episodes:
        (direction,) = directions["mean-difference:1"][episode].removed[0]
        assert abs(float(direction @ mark)) > 0.99
        for name in ("control-1", "control-2"):
            (control,) = directions[name][episode].removed[0]
            assert np.linalg.norm(control) == pytest.approx(1.0)
            assert abs(float(control @ direction)) < 1e-9


@pytest.mark.parametrize("method", ["mean-difference:1", "leace", "inlp:2"])
def test_a_place_without_a_direction_is_refused_by_category_site_and_role(method: str) -> None:
    """Before a layer combines them, each picture of a balanced suite has either answer equally often."""
    values = np.random.default_rng(0).normal(size=(GROUPS, POSITIONS, WIDTH)) + 1e3
    features = marked(np.zeros(WIDTH))
    same = TokenFeatures(
        features.episodes,
        features.groups,
        features.is_left,
        PaddedTokens(np.repeat(values, 4, axis=0), features.tokens.present),
    )
    with pytest.raises(UsageError, match=f"color, {SITE}, role image: no direction for {method}"):
        fit_by_fold(same, CELL, Method.of(method), 1, 0, "color")


def test_an_episodes_own_group_has_no_say_in_its_directions() -> None:
    features, method = marked(np.eye(WIDTH)[3]), Method.of("mean-difference:2")
    before = by_episode(features, fit_by_fold(features, CELL, method, 1, 0, "color"))
    spoilt = features.tokens.values.copy()
    mine = features.groups == "g4"
    spoilt[mine] = 100 * np.random.default_rng(1).normal(size=spoilt[mine].shape)
    other = TokenFeatures(
        features.episodes, features.groups, features.is_left, PaddedTokens(spoilt, features.tokens.present)
    )
    after = by_episode(other, fit_by_fold(other, CELL, method, 1, 0, "color"))
    same = [
        np.array_equal(before[str(method)][name].removed, after[str(method)][name].removed)
        for name in features.episodes
    ]
    assert all(np.array(same)[mine])
    assert not all(same)


def test_they_are_the_leading_differences_of_class_means_of_the_other_folds(
    session: ReplaySession, copy: Run
) -> None:
    """Compared with numpy's decomposition of the tokens that the policy has there."""
    items = list(dict.fromkeys(copy.episodes.loc[copy.episodes["category"] == "color", "item_id"].astype(str)))
    (site_group,) = resolve_sites("backbone.02", session.policy)
    captured: list[tuple[int, int]] = []
    session.on_fit_progress = lambda finished, total, _: captured.append((finished, total))
    intervention = Interchange(
        categories=("color",), sites=("backbone.02",), roles=("image",), direction="mean-difference:2", controls=1
    )
    (axes,) = intervention.fit_directions(session, [Cell(site_group, "image")], intervention.sites).values()
    session.on_fit_progress = None
    assert captured == [(finished, len(items)) for finished in range(1, len(items) + 1)]
    replay_inputs = [replay_input for item in items for replay_input in session.pairs(item)]
    rows = []
    for replay_input in replay_inputs:
        with capture(session.policy, [SITE]) as activations:
            session.act(replay_input.clean, replay_input.seed)
        mask = session.policy.token_roles([replay_input.clean])["backbone"][0].mask("image")
        rows.append(activations[SITE][0].double().cpu().numpy()[mask])
    values, is_left = (
        np.array(rows),
        np.array([replay_input.side == "left" for replay_input in replay_inputs]),
    )
    bases = {name: axes.basis("mean-difference:2", name) for name in (q.episode for q in replay_inputs)}
    episode = replay_inputs[0].episode
    fold = np.array([np.array_equal(bases[q.episode], bases[episode]) for q in replay_inputs])
    assert 0 < fold.sum() < fold.size
    differences = values[~fold & is_left].mean(axis=0) - values[~fold & ~is_left].mean(axis=0)
    _, _, expected = np.linalg.svd(differences, full_matrices=False)
    basis = bases[episode].astype(float)
    np.testing.assert_allclose(basis.T @ basis, expected[:2].T @ expected[:2], atol=1e-5)
    control = axes.basis("control-1", episode)
    assert control.shape == basis.shape
    np.testing.assert_allclose(control @ basis.T, 0, atol=1e-5)


def test_tokens_are_taken_over_along_them_and_along_controls(
    copy: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    intervention = Interchange(
        categories=("color",), items=2, sites=("backbone.02",), roles=("image",), direction="mean-difference:2",
        controls=1,
    )  # fmt: skip
    effects = run_intervention(copy, intervention, source, load=lambda *_: twin)
    assert [row.direction for row in effects.effects] == ["mean-difference:2", "control-1"]
    effect, control = effects.effects
    assert effect.fires == control.fires == 4
    assert min(effect.relative_change, control.relative_change) > 0
    assert effect.control_displacement is not None


@pytest.mark.parametrize("direction", ["mean-difference:0", "mean-difference:x", "leace", "inlp:2", "zap"])
@pytest.mark.parametrize(
    "intervention",
    [
        lambda direction: Interchange(direction=direction),
        lambda direction: ClosedLoop(targets=("backbone.02|image",), direction=direction),
        lambda direction: Steering(sites=("backbone.02",), role="image", direction=direction),
    ],
)
def test_an_invalid_direction_is_refused_before_anything_is_loaded(intervention: object, direction: str) -> None:
    with pytest.raises(UsageError, match="direction"):
        intervention(direction)  # type: ignore[operator]


def test_a_dose_of_two_takes_the_marks_from_one_half_of_the_tokens_to_the_other() -> None:
    """Marks are planted; the vector of every position is the difference of the class means there."""
    mark = np.eye(WIDTH)[3]
    features, method = marked(mark), "mean-difference:1"
    fits = fit_by_fold(features, CELL, Method.of(method), 1, 0, "color")
    bases = {
        (name, episode): eraser.removed[0].astype(np.float32)
        for name, of_episode in by_episode(features, fits).items()
        for episode, eraser in of_episode.items()
    }
    axes = Directions(bases, half_differences_of(features, fits, method), ("control-1",))
    first = np.arange(POSITIONS) < POSITIONS // 2
    for episode, is_left in zip(features.episodes, features.is_left, strict=True):
        shift = axes.shift(method, episode, -2.0 if is_left else 2.0)
        expected = np.where(first == is_left, -1.0, 1.0)[:, None] * mark
        np.testing.assert_allclose(shift, expected, atol=0.1)
        control = axes.shift("control-1", episode, -2.0 if is_left else 2.0)
        np.testing.assert_allclose(
            np.linalg.norm(control, axis=1), np.linalg.norm(shift, axis=1), rtol=1e-4, err_msg=episode
        )


def test_steering_along_directions_of_tokens_moves_them_as_far_as_its_control(
    copy: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    intervention = Steering(
        categories=("color",), items=2, sites=("backbone.02",), role="image", direction="mean-difference:1",
        coefficients=(2.0,), controls=1,
    )  # fmt: skip
    assert intervention.fits_first
    edits = run_intervention(copy, intervention, source, load=lambda *_: twin).certificate["edits"]
    assert edits["backbone.02|image|mean-difference:1|0"]["max_action_change"] == 0.0
    along, control = (edits[f"backbone.02|image|{name}|2"] for name in ("mean-difference:1", "control-1"))
    assert along["change"] > 0
    assert control["change"] == pytest.approx(along["change"], rel=1e-4)
