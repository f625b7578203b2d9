"""A cut of attention: equal to scores of −∞ before the softmax, in the heads and positions that are cut alone."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.errors import CaptureError, RolesMismatchError, UnknownSiteError, UsageError
from probe_kit.hooks import (
    AttentionCut,
    ModelCard,
    Observation,
    Policy,
    Roles,
    Site,
    Stream,
    Tap,
    capture_patterns,
    cut_attention,
    load_policy,
)

SEEN = Observation(
    np.random.default_rng(0).integers(0, 255, (224, 224, 3), dtype=np.uint8),
    np.zeros(8, np.float32),
    "put the cube on the red picture",
)


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy("pi0-tiny")


@pytest.fixture(scope="module")
def sites(policy: Policy) -> list[Site]:
    return policy.streams["expert"].sites("heads")


def act(policy: Policy) -> NDArray[np.float32]:
    return policy.act([SEEN], [0])


def tokens_of(policy: Policy, role: str) -> NDArray[np.bool_]:
    return policy.token_roles([SEEN])["backbone"][0].mask(role)


@contextmanager
def masked_scores(policy: Policy, blocks: Sequence[int], keys: NDArray[np.bool_]) -> Iterator[None]:
    """The network's own mask in these blocks of the expert, with −∞ at some tokens: an independent oracle."""
    layers: Any = policy.network.model.paligemma_with_expert.gemma_expert.model.layers  # type: ignore[attr-defined]

    def hide(_: object, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        mask = keywords["attention_mask"].clone()
        mask[..., : keys.size].masked_fill_(torch.from_numpy(keys), torch.finfo(mask.dtype).min)
        return arguments, {**keywords, "attention_mask": mask}

    with ExitStack() as stack:
        for block in blocks:
            handle = layers[block].self_attn.register_forward_pre_hook(hide, with_kwargs=True)
            stack.callback(handle.remove)
        yield


@pytest.mark.parametrize("role", ["image", "language"])
@pytest.mark.parametrize("blocks", [(0,), (1, 2), (0, 1, 2)], ids=str)
def test_a_cut_equals_scores_of_minus_infinity(
    policy: Policy, sites: list[Site], role: str, blocks: tuple[int, ...]
) -> None:
    keys = tokens_of(policy, role)
    with masked_scores(policy, blocks, keys):
        expected = act(policy)
    cuts = {site: AttentionCut(keys) for site in sites if site.layer in blocks}
    with cut_attention(policy, cuts) as log:
        actions = act(policy)
    assert np.abs(expected - act(policy)).max() > 1e-3
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert (log.fires, log.no_op_fires) == (len(cuts), 0)


def test_a_cut_of_no_token_changes_no_bit(policy: Policy, sites: list[Site]) -> None:
    with cut_attention(policy, dict.fromkeys(sites, AttentionCut(np.zeros(4, bool)))) as log:
        actions = act(policy)
    np.testing.assert_array_equal(actions, act(policy))
    assert log.no_op_fires == log.fires == len(sites)


def test_a_cut_of_all_but_the_first_token_is_finite(policy: Policy, sites: list[Site]) -> None:
    keys = np.ones_like(tokens_of(policy, "image"))
    keys[0] = False
    with cut_attention(policy, dict.fromkeys(sites, AttentionCut(keys))):
        assert np.isfinite(act(policy)).all()


def test_one_head_and_one_position_change_alone(policy: Policy, sites: list[Site]) -> None:
    """By hand: the head's read values without the tokens, w_t v_t / Σ w_t over those that are left."""
    site = next(site for site in sites if site.layer == 1)
    keys, stream = tokens_of(policy, "image"), policy.streams["expert"]
    positions = len(policy.token_roles([SEEN])["expert"][0])
    queries = np.zeros(positions, bool)
    queries[3] = True
    read: list[torch.Tensor] = []
    module = policy.tap(site).module

    def keep(_: object, inputs: tuple[torch.Tensor, ...]) -> None:
        read.append(inputs[0].detach().clone().view(1, positions, stream.heads, -1))

    with capture_patterns(policy, [site]) as patterns:
        handle = module.register_forward_pre_hook(keep)
        act(policy)
        handle.remove()
    with cut_attention(policy, {site: AttentionCut(keys, queries, (1,))}):
        handle = module.register_forward_pre_hook(keep)
        act(policy)
        handle.remove()
    before, after = read[0], read[len(read) // 2]
    changed = (before != after).any(dim=-1)[0]
    assert changed.nonzero().tolist() == [[3, 1]]
    share = float(patterns[site][0, 1, 3, : keys.size][torch.from_numpy(keys)].sum())
    assert 0 < share < 1


@pytest.mark.parametrize(
    ("cut", "error", "message"),
    [
        (AttentionCut(np.ones(9, bool), heads=(99,)), UsageError, "there is no head 99"),
        (AttentionCut(np.ones(9, bool), queries=np.ones(2, bool)), RolesMismatchError, "2 are chosen among"),
        (AttentionCut(np.ones(9999, bool)), RolesMismatchError, "9999 tokens"),
    ],
)
def test_a_cut_that_does_not_fit_is_refused(
    policy: Policy, sites: list[Site], cut: AttentionCut, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message), cut_attention(policy, {sites[0]: cut}):
        act(policy)


def test_a_site_without_heads_is_refused(policy: Policy) -> None:
    cuts = {Site("backbone", 1): AttentionCut(np.ones(1, bool))}
    with pytest.raises(UnknownSiteError, match="no attention to cut"), cut_attention(policy, cuts):
        act(policy)


def test_a_position_that_is_left_with_nothing_to_read_is_an_error(policy: Policy) -> None:
    """The backbone reads its own tokens alone, and all of them are cut."""
    site = policy.streams["backbone"].sites("heads")[0]
    keys = np.ones(len(policy.token_roles([SEEN])["backbone"][0]), bool)
    with (
        pytest.raises(CaptureError, match="cannot be renormalised"),
        cut_attention(policy, {site: AttentionCut(keys)}),
    ):
        act(policy)


# -- a network whose formula is known ----------------------------------------------------------------------------


class TwoReadings(nn.Module):
    """Two layers of attention of one query to four tokens of scalar values; the second asks with the first."""

    def __init__(self) -> None:
        super().__init__()
        self.outputs = nn.ModuleList([nn.Identity(), nn.Identity()])
        draw = np.random.default_rng(5)
        self.keys, self.values = draw.normal(size=(2, 2, 4)), draw.normal(size=(2, 2, 4))  # (layer, head, token)

    def forward(self, picture: Tensor) -> Tensor:
        """(4,) brightness of the tokens -> the hidden state, a scalar."""
        hidden = torch.ones(1)
        for layer, output in enumerate(self.outputs):
            key = torch.from_numpy(self.keys[layer]).float()[None, :, :, None]  # (1, H, T, 1)
            value = (torch.from_numpy(self.values[layer]).float() * picture)[None, :, :, None]
            query = hidden.expand(1, 2, 1, 1)
            read = functional.scaled_dot_product_attention(query, key, value)
            hidden = hidden + output(read.transpose(1, 2).flatten(2)).sum()
        return hidden

    def by_formula(self, picture: NDArray[np.float64], cut: NDArray[np.bool_], layers: tuple[int, ...]) -> float:
        """The same in float64, with w_t = exp(h k_t) / Σ exp(h k) over the tokens left in these layers."""
        hidden = 1.0
        for layer in range(2):
            left = ~cut if layer in layers else np.ones(4, bool)
            weights = np.exp(hidden * self.keys[layer][:, left])
            weights /= weights.sum(axis=1, keepdims=True)
            hidden += float((weights * (self.values[layer] * picture)[:, left]).sum())
        return hidden


class ReadingPolicy(Policy):
    """Acts by the hidden state of `TwoReadings`."""

    role_names: ClassVar[Mapping[str, tuple[str, ...]]] = {"backbone": ("image.primary",), "expert": ("action",)}
    streams = {"backbone": Stream("backbone", 1, 1), "expert": Stream("expert", 3, 1, 1, heads=2)}

    def __init__(self) -> None:
        self.network = TwoReadings()
        self.card = ModelCard(
            family="two readings", checkpoint="built", weights_sha256="0" * 64, random_weights=False, parameters=0,
            dtype="float32", device="cpu", embodiment="7-DoF end-effector delta", cameras=("primary",), chunk=1,
            execute=1,
        )  # fmt: skip

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        self.check(observations, seeds)
        with torch.inference_mode():
            hidden = [
                float(self.network(torch.from_numpy(picture_of(observation)).float()))
                for observation in observations
            ]
        return np.array(hidden, np.float32)[:, None, None] * np.ones((1, 1, 7), np.float32)

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        expected = {"backbone": ["image.primary"] * 4, "expert": ["action"]}
        return {name: [Roles.from_labels(labels)] * len(observations) for name, labels in expected.items()}

    def tap(self, site: Site) -> Tap:
        return Tap(self.network.outputs[site.layer], 1)


def picture_of(observation: Observation) -> NDArray[np.float64]:
    return observation.image[0, :4, 0] / 255


@pytest.mark.parametrize("layers", [(0,), (1,), (0, 1)], ids=str)
@pytest.mark.parametrize("tokens", [(0,), (1, 3), (0, 2, 3)], ids=str)
def test_the_effect_of_a_cut_in_a_network_of_two_layers_is_that_of_its_formula(
    layers: tuple[int, ...], tokens: tuple[int, ...]
) -> None:
    policy, cut = ReadingPolicy(), np.isin(np.arange(4), tokens)
    sites = [site for site in policy.streams["expert"].sites("heads") if site.layer in layers]
    with cut_attention(policy, {site: AttentionCut(cut) for site in sites}):
        changed = act(policy)[0, 0, 0]
    picture, clean = picture_of(SEEN), act(policy)[0, 0, 0]
    nothing = np.zeros(4, bool)
    effect = policy.network.by_formula(picture, cut, layers) - policy.network.by_formula(picture, nothing, ())
    assert abs(effect) > 1e-3
    assert changed - clean == pytest.approx(effect, abs=1e-6)
