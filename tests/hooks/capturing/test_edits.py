import pickle
from dataclasses import replace

import numpy as np
import pytest

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks import Observation, Site, capture
from probe_kit.hooks.capturing.edits import Edit, apply_edits, vector_hash
from probe_kit.hooks.families.pi0.adapter import Pi0

SITE = Site("backbone", 2)


def _tape(policy: Pi0, seen: list[Observation], edits: list[Edit], vectors: dict) -> tuple:
    with apply_edits(policy, edits, seen, vectors) as edit_log, capture(policy, [SITE]) as tape:
        actions = policy.act(seen, [0])
    return tape[SITE][0].numpy(), actions, edit_log


@pytest.fixture
def plain(pi0_tiny: Pi0, observation: Observation) -> np.ndarray:
    return _tape(pi0_tiny, [observation], [], {})[0]


def _direction(policy: Pi0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=policy.streams["backbone"].width).astype(np.float32)


def test_an_edit_is_data_that_can_be_hashed_and_sent_between_processes() -> None:
    one = Edit("zero", (SITE,), roles=("language",))
    assert pickle.loads(pickle.dumps(one)) == one
    assert len({one, Edit("zero", (SITE,), roles=("language",)), Edit("zero", (SITE,))}) == 2
    assert one.to_json()["sites"] == ["backbone.02.residual"]


def test_only_tokens_of_the_named_roles_change(pi0_tiny: Pi0, observation: Observation, plain: np.ndarray) -> None:
    changed, _, edit_log = _tape(pi0_tiny, [observation], [Edit("zero", (SITE,), roles=("language",))], {})
    language = pi0_tiny.roles([observation])["backbone"][0].mask("language")
    assert (changed[language] == 0).all()
    np.testing.assert_array_equal(changed[~language], plain[~language])
    (entry,) = edit_log.entries
    assert entry.tokens == language.sum()
    np.testing.assert_allclose(entry.norm, np.linalg.norm(plain[language], axis=1).mean(), rtol=1e-5)
    np.testing.assert_allclose(entry.moved, entry.norm, rtol=1e-5)


def test_adding_and_removing_a_direction_follow_their_formulas(
    pi0_tiny: Pi0, observation: Observation, plain: np.ndarray
) -> None:
    direction = _direction(pi0_tiny)
    vectors = {vector_hash(direction): direction}
    valid = pi0_tiny.roles([observation])["backbone"][0].valid
    add = Edit("add", (SITE,), vector=vector_hash(direction), strength=2.0)
    np.testing.assert_allclose(
        _tape(pi0_tiny, [observation], [add], vectors)[0][valid], plain[valid] + 2 * direction, atol=1e-5
    )
    remove = Edit("remove", (SITE,), vector=vector_hash(direction))
    left = _tape(pi0_tiny, [observation], [remove], vectors)[0]
    np.testing.assert_allclose(left[valid] @ direction, 0, atol=1e-3)
    both = _tape(pi0_tiny, [observation], [add, remove], vectors)[0]
    np.testing.assert_allclose(both[valid], left[valid], atol=1e-4)


def test_dose_zero_changes_no_action_bit_for_bit(pi0_tiny: Pi0, observation: Observation) -> None:
    direction = _direction(pi0_tiny)
    none = Edit("add", (SITE,), vector=vector_hash(direction), strength=0.0)
    expected = pi0_tiny.act([observation], [0])
    np.testing.assert_array_equal(_tape(pi0_tiny, [observation], [none], {none.vector: direction})[1], expected)


def test_a_donor_replaces_token_by_token(pi0_tiny: Pi0, observation: Observation, plain: np.ndarray) -> None:
    donor = np.random.default_rng(1).normal(size=plain.shape).astype(np.float32)
    whole = Edit("replace", (SITE,), vector=vector_hash(donor))
    valid = pi0_tiny.roles([observation])["backbone"][0].valid
    changed, actions, _ = _tape(pi0_tiny, [observation], [whole], {vector_hash(donor): donor})
    np.testing.assert_allclose(changed[valid], donor[valid], atol=1e-5)
    assert np.abs(actions - pi0_tiny.act([observation], [0])).max() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "burn", "sites": (SITE,)}, "does not exist"),
        ({"kind": "zero", "sites": ()}, "names no site"),
        ({"kind": "add", "sites": (SITE,)}, "all kinds but zero need one"),
        ({"kind": "zero", "sites": (SITE,), "vector": "ab"}, "all kinds but zero"),
        ({"kind": "zero", "sites": (SITE,), "strength": float("nan")}, "finite"),
    ],
)
def test_what_means_nothing_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Edit(**arguments)


def test_a_vector_of_another_hash_or_shape_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    direction = _direction(pi0_tiny)
    name = vector_hash(direction)
    add = Edit("add", (SITE,), vector=name)
    with pytest.raises(UsageError, match="no array of that hash"):
        _tape(pi0_tiny, [observation], [add], {name: _direction(pi0_tiny, 1)})
    short = direction[:-1]
    with pytest.raises(UsageError, match="expected"):
        _tape(
            pi0_tiny,
            [observation],
            [Edit("add", (SITE,), vector=vector_hash(short))],
            {vector_hash(short): short},
        )
    with pytest.raises(UnknownSiteError):
        _tape(pi0_tiny, [observation], [Edit("zero", (Site("backbone", 99),))], {})


def test_rows_of_a_batch_are_edited_each_by_its_own_roles(pi0_tiny: Pi0, observation: Observation) -> None:
    """Zero and source, one after the other at the same site; instructions differ in their length."""
    seen = [observation, replace(observation, instruction="Put the cube on the shape")]
    masks = [roles.mask("language") for roles in pi0_tiny.roles(seen)["backbone"]]
    assert masks[0].sum() != masks[1].sum()
    with capture(pi0_tiny, [SITE]) as tape:
        pi0_tiny.act(seen, [0, 1])
    plain = tape[SITE].numpy()
    source = np.random.default_rng(1).normal(size=plain.shape[1:]).astype(np.float32)
    image = Edit("replace", (SITE,), roles=("image",), vector=vector_hash(source), strength=0.5)
    edits = [Edit("zero", (SITE,), roles=("language",)), image]
    with apply_edits(pi0_tiny, edits, seen, {image.vector: source}) as edit_log, capture(pi0_tiny, [SITE]) as tape:
        pi0_tiny.act(seen, [0, 1])
    changed = tape[SITE].numpy()
    for row, roles in enumerate(pi0_tiny.roles(seen)["backbone"]):
        language, pictures = roles.mask("language"), roles.mask("image")
        assert (changed[row][language] == 0).all()
        half = (plain[row] + source)[pictures] / 2
        np.testing.assert_allclose(changed[row][pictures], half, atol=1e-5)
        rest = ~language & ~pictures
        np.testing.assert_array_equal(changed[row][rest], plain[row][rest])
    assert [entry.tokens for entry in edit_log.entries] == [sum(mask.sum() for mask in masks), 2 * pictures.sum()]
    first = edit_log.entries[0]
    lengths = np.concatenate([np.linalg.norm(plain[row][mask], axis=1) for row, mask in enumerate(masks)])
    np.testing.assert_allclose(
        (first.norm, first.moved, first.largest), (lengths.mean(), lengths.mean(), lengths.max()), rtol=1e-5
    )
    assert edit_log.row()[:2].tolist() == [2, 0]
