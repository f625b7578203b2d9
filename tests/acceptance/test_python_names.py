"""Python's face: names of `probe_kit.__all__`, and what capture promises."""

import numpy as np
import pytest

import probe_kit as pk
from probe_kit.hooks import Observation


def test_every_public_name_resolves_and_has_a_description() -> None:
    assert len(set(pk.__all__)) == len(pk.__all__) > 30
    for name in pk.__all__:
        assert (getattr(pk, name).__doc__ or "").strip(), name
    assert set(pk.__all__) <= set(dir(pk))


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        pk.no_such_name  # type: ignore[attr-defined]  # noqa: B018


def test_a_captured_inference_gives_the_actions_of_one_without_hooks_bit_for_bit() -> None:
    policy = pk.load_policy("pi0-tiny")
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    state = np.array([0.29, 0, 0.16, 0, 0, 0, 0, 1], np.float32)
    asked = [Observation(picture, state, f"Put the cube on the {colour} shape") for colour in ("red", "blue")]
    plain = np.asarray(policy.act(asked, [0, 1]))
    with pk.capture(policy, policy.sites()) as tape:
        captured = np.asarray(policy.act(asked, [0, 1]))
    assert np.array_equal(plain, captured)
    assert np.array_equal(plain, np.asarray(policy.act(asked, [0, 1]))), "hooks stay behind"
    assert not np.array_equal(plain, np.asarray(policy.act(asked, [7, 8]))), "the actions ignore noise"
    for site in policy.sites():
        values = tape[site]
        assert values.shape[0] == len(asked), site
        assert np.isfinite(np.asarray(values.float())).all(), site
    assert {site.stream for site in policy.sites()} == {"backbone", "expert"}
    assert tape[pk.Site("backbone", 3)].shape == tape["backbone.03.residual"].shape
