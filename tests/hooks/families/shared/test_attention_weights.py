"""Recomputed attention weights equal those of the inference: weights times values give its output."""

import pytest
import torch
import transformers
from torch.nn import functional
from transformers import DynamicCache, LlamaConfig, LlamaModel

from probe_kit.errors import UnsupportedInterventionError
from probe_kit.hooks.families.shared.taps import (
    on_the_prompt,
    recomputed,
    recording_weights,
    returned,
    shares,
)
from probe_kit.models.xiaomi import Attention


def test_shares_are_those_of_torchs_own_attention_under_either_kind_of_mask() -> None:
    torch.manual_seed(0)
    queries, keys, values = (torch.randn(2, heads, tokens, 8) for heads, tokens in ((4, 3), (2, 5), (2, 5)))
    seen = torch.rand(2, 1, 3, 5) > 0.3
    seen[..., 0] = True
    every = values.repeat_interleave(2, dim=1)
    expected = functional.scaled_dot_product_attention(
        queries, keys.repeat_interleave(2, dim=1), every, attn_mask=seen, scale=0.5
    )
    added = torch.zeros(2, 1, 3, 5).masked_fill(~seen, torch.finfo(torch.float32).min)
    for mask in (seen, added):
        torch.testing.assert_close(shares(queries, keys, 0.5, {"attention_mask": mask}) @ every, expected)


def test_llamas_last_position_is_weighed_as_eager_attention_weighs_it() -> None:
    """Over the prompt and over every token behind it, with fewer heads for keys than for queries."""
    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=11, hidden_size=32, intermediate_size=16, num_hidden_layers=2, num_attention_heads=4,
        num_key_value_heads=2, max_position_embeddings=32,
    )  # fmt: skip
    config._attn_implementation = "eager"
    network, cache = LlamaModel(config).eval(), DynamicCache(config=config)
    attentions = [layer.self_attn for layer in network.layers]
    recorded: dict[str, dict[tuple[int, int], torch.Tensor]] = {"returned": {}, "recomputed": {}}

    def noting(name: str):
        return on_the_prompt(lambda block, iteration, mass: recorded[name].update({(block, iteration): mass}))

    with (
        torch.inference_mode(),
        recording_weights(attentions, noting("returned"), returned),
        recording_weights(attentions, noting("recomputed"), recomputed),
    ):
        for ids in ([[1, 2, 3, 4, 5, 6]], [[7]], [[8]]):
            network(input_ids=torch.tensor(ids), past_key_values=cache, use_cache=True)
    assert recorded["returned"].keys() == {(block, iteration) for block in (0, 1) for iteration in (0, 1, 2)}
    for read, weights in recorded["returned"].items():
        assert weights.shape == (1, 4, 1, 5)  # the prompt without its last token
        torch.testing.assert_close(recorded["recomputed"][read], weights)


def test_xiaomis_weights_on_its_values_are_what_its_attention_reads() -> None:
    torch.manual_seed(0)
    attention = Attention(32, 8, 2).eval()
    stream, cache = torch.randn(2, 4, 32), (torch.randn(2, 2, 5, 8), torch.randn(2, 2, 5, 8))
    rotation = (torch.randn(2, 4, 8), torch.randn(2, 4, 8))
    mask = torch.ones(2, 1, 4, 9, dtype=torch.bool)
    mask[1, :, :, :2] = False
    with torch.inference_mode():
        read = attention(stream, cache, rotation, mask)
        weights = attention.weights(stream, cache, rotation, mask)
        values = attention._parts(stream, cache, rotation)[2]
        again = attention.o_proj((weights @ values).transpose(1, 2).flatten(2))
    torch.testing.assert_close(again, read)
    assert (weights[1, :, :, :2] == 0).all()


@pytest.mark.parametrize("network", ["Qwen3", "Gemma2"])
def test_an_attention_with_a_norm_of_queries_or_a_soft_cap_is_refused_not_recomputed_wrongly(network: str) -> None:
    config = getattr(transformers, f"{network}Config")(
        vocab_size=11, hidden_size=32, intermediate_size=16, num_hidden_layers=1, num_attention_heads=4,
        num_key_value_heads=2, head_dim=8,
    )  # fmt: skip
    attention = getattr(transformers, f"{network}Model")(config).layers[0].self_attn
    step = {"Qwen3": "q_norm", "Gemma2": "attn_logit_softcapping"}[network]
    with pytest.raises(UnsupportedInterventionError, match=rf"{network}Attention .*{step}.*Patch `kv`"):
        recomputed(attention, (torch.zeros(1, 1, 32),), {}, None)


def test_an_attention_of_another_kind_is_refused() -> None:
    with pytest.raises(UnsupportedInterventionError, match="Patch `kv`"):
        recomputed(torch.nn.Identity(), (), {}, None)
