"""Patterns of one inference with the roles of both axes."""

import numpy as np
import pytest

from probe_kit import patching as pt
from probe_kit.errors import EmptyRoleError, UnknownSiteError
from probe_kit.hooks import Observation, Prompt, Site, load_model
from probe_kit.hooks.families.pi0.adapter import Pi0


def test_shares_by_role_are_sums_of_weights(pi0_tiny: Pi0, observation: Observation) -> None:
    patterns = pt.attention_patterns(pi0_tiny, observation, ["expert.02.heads@9", "backbone.*.heads"], seed=1)
    assert len(patterns) == 4
    own = patterns[Site("expert", 2, "heads", 9)]
    assert own.weights.shape == (8, 17, 69)
    assert own.queries is not None
    assert own.keys is not None
    np.testing.assert_allclose(own.weights.sum(axis=-1), 1, atol=1e-5)
    by_hand = own.weights[:, 1:, :36].sum(axis=2).mean(axis=1)
    np.testing.assert_allclose(own.mean_share("image", "action"), by_hand, rtol=1e-5)
    roles = ("image", "language", "special", "state", "action")
    np.testing.assert_allclose(sum(own.mean_share(role) for role in roles), 1, atol=1e-5)
    prompt = patterns[Site("backbone", 0, "heads")]
    assert prompt.mean_share("padding").max(initial=0) == 0
    with pytest.raises(EmptyRoleError, match="no token with the role 'image' attends here"):
        own.mean_share("language", "image")


def test_a_vision_tower_has_weights_without_roles(pi0_tiny: Pi0, observation: Observation) -> None:
    (own,) = pt.attention_patterns(pi0_tiny, observation, ["vision.00.heads"]).values()
    assert own.queries is own.keys is None
    np.testing.assert_allclose(own.weights.sum(axis=-1), 1, atol=1e-5)
    with pytest.raises(EmptyRoleError, match="have no roles; use weights"):
        own.mean_share("image")


def test_a_question_is_attended_to_by_its_answer(observation: Observation) -> None:
    vlm = load_model("vlm-tiny")
    question = Prompt(observation, "Put cube on red shape\n\nA left\nB right", ("A", "B"))
    (own,) = pt.attention_patterns(vlm, question, ["answer.02.heads"]).values()
    assert own.weights.shape[1] == 1
    shares = [own.mean_share(role, "answer") for role in ("image", "language", "special", "answer")]
    np.testing.assert_allclose(sum(shares), 1, atol=1e-5)


def test_another_quantity_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with pytest.raises(UnknownSiteError, match="has no attention pattern"):
        pt.attention_patterns(pi0_tiny, observation, ["backbone.01"])
