"""The modules at which sites are read: decoders, lerobot's stacks, the prompt's keys and values, attention."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from itertools import count
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.errors import CaptureError, UnsupportedInterventionError
from probe_kit.hooks.contract.model import HeadsTap, Tap
from probe_kit.hooks.contract.sites import HEADS, Site, Stream, kv_stream
from probe_kit.models.decoding import PromptKV

_PROJECTIONS = ("o_proj", "out_proj", "attn_out", "dense")
"""Names that networks give to the output projection of an attention."""


NOTHING: Mapping[str, Any] = MappingProxyType({})


def decoder_tap(
    layers: Any,
    norm: Any,
    site: Site,
    fires: int = 1,
    entry: str = "input_layernorm",
    added: Mapping[str, str] = NOTHING,
    end: Literal["input", "output"] = "input",
    **fields: Any,
) -> Tap:
    """Return the tap of a site: the first norm of the block it enters, the last norm, or a part of a block.

    Args:
        layers: The blocks of the decoder, in order.
        norm: The norm behind the last block.
        site: A site of the decoder's stream.
        fires: Calls per inference, as in `Tap`.
        entry: Path of the block's first submodule, empty for the block itself.
        added: By quantity, the path of the submodule whose output a block adds, where it is neither `mlp` nor the
            output projection; of `heads`, whose input they are.
        end: The end of the norm at which the last residual passes.
        **fields: Further fields of `Tap`.
    """
    if site.quantity == "final_norm":
        return Tap(norm, fires, "output", **fields)
    if site.layer == len(layers):
        return Tap(norm, fires, end, **fields)
    block = layers[site.layer]
    if site.quantity == "residual":
        return Tap(block.get_submodule(entry), fires, **fields)
    if site.quantity in added:
        module = block.get_submodule(added[site.quantity])
    else:
        module = block.mlp if site.quantity == "mlp" else output_projection(block.self_attn)
    return Tap(module, fires, "input" if site.quantity == HEADS else "output", **fields)


def output_projection(attention: Any) -> Any:
    """Return the output projection of an attention of a language model or a vision tower."""
    return next(getattr(attention, name) for name in _PROJECTIONS if hasattr(attention, name))


# -- stacks ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stack:
    """One transformer stack inside a policy.

    Attributes:
        width: Features per token.
        iterations: Passes per inference; None for a stack that runs once.
        entry: Path of a block's first submodule, see `decoder_tap`.
        added: Paths of submodules by quantity, see `decoder_tap`.
        end: The end of the norm at which the last residual passes.
        tap_fields: Further fields of every tap, such as the positions that belong to the stream.
        stream_fields: Further fields of the `Stream`; heads are counted where they are not among them.
    """

    layers: Sequence[nn.Module]
    norm: nn.Module
    width: int
    iterations: int | None
    entry: str = "input_layernorm"
    added: Mapping[str, str] = NOTHING
    end: Literal["input", "output"] = "input"
    tap_fields: Mapping[str, Any] = NOTHING
    stream_fields: Mapping[str, Any] = NOTHING

    def tap(self, site: Site) -> Tap:
        """Return the tap of a site of this stack."""
        fires, tap_fields = self.iterations or 1, dict(self.tap_fields)
        return decoder_tap(self.layers, self.norm, site, fires, self.entry, self.added, self.end, **tap_fields)

    def stream(self, name: str) -> Stream:
        """The stored stream: the input of every block, and of the final norm."""
        fields = dict(self.stream_fields)
        if "heads" not in fields:
            attention: Any = self.layers[0].self_attn
            fields["heads"] = int(output_projection(attention).in_features) // int(attention.head_dim)
        return Stream(name, fields.pop("layers", len(self.layers) + 1), self.width, self.iterations, **fields)


TOWER: Mapping[str, Any] = MappingProxyType({"part": "vision", "quantities": ("residual",), "heads": 0})
"""The fields of the stream of a vision tower that is read between its blocks alone."""


def token_stack(layers: Any, norm: Any, width: int, iterations: int | None, **tap_fields: Any) -> Stack:
    """Return a decoder that runs over the prompt and then over what it puts out, in one of these two roles.

    Args:
        layers: The blocks of the decoder, in order.
        norm: The norm behind the last block.
        width: Features per token.
        iterations: The captured passes, or None for the prompt; calls behind them belong to no site.
        **tap_fields: The `tokens` of its passes that belong to the stream, and `first`, the passes before those of
            the stream.
    """
    return Stack(layers, norm, width, iterations, tap_fields={"more": True, **tap_fields})


def flow_stacks(backbone: Any, expert: Any, vision: Any, iterations: int) -> dict[str, Stack]:
    """The three stacks of a flow policy; the vision tower's iterations are the cameras, see `LerobotPolicy`."""
    return {
        "backbone": Stack(backbone.layers, backbone.norm, backbone.config.hidden_size, None),
        "expert": Stack(expert.layers, expert.norm, expert.config.hidden_size, iterations),
        "vision": Stack(vision.encoder.layers, vision.post_layernorm, vision.config.hidden_size, 1, "layer_norm1"),
    }


# -- keys and values of the prompt ----------------------------------------------------------------------------

ALL_TOKENS = slice(None)
ALL_BUT_LAST = slice(None, -1)
"""The backbone's tokens in models whose last prompt token belongs to the acting stream.

The keys and values of that token are not the backbone's.
"""
LAST = slice(-1, None)
"""The slice of that token in the prompt; every token that is fed back is the last of its pass too."""


def kv_tap(kv: PromptKV, site: Site, tokens: slice = ALL_TOKENS) -> HeadsTap:
    """Return the tap of the keys or values of one block; `tokens` are the backbone's among those of the prompt."""
    passages: nn.ModuleList = getattr(kv, site.quantity)
    return HeadsTap(passages[site.layer], 1, tokens=tokens)


def kept_prompt(text: Any) -> Stream:
    """The stream `kv` of a decoder of transformers' configuration `text`."""
    heads = int(getattr(text, "num_key_value_heads", None) or text.num_attention_heads)
    size = int(getattr(text, "head_dim", None) or text.hidden_size // text.num_attention_heads)
    return kv_stream(int(text.num_hidden_layers), heads * size)


def attach_prompt_kv(joint: Any, blocks: int) -> PromptKV:
    """Return the keys and values of lerobot's `joint`, whose pass over the prompt leaves them there from now on.

    lerobot calls its `forward` by name, past all hooks, so the instance gets one that sends the cache through.
    """
    if isinstance(getattr(joint, "prompt_kv", None), PromptKV):
        attached: PromptKV = joint.prompt_kv
        return attached
    kv, forward = PromptKV(blocks), joint.forward
    joint.prompt_kv = kv

    def reading(*arguments: Any, **keywords: Any) -> Any:
        result = forward(*arguments, **keywords)
        embeddings = keywords["inputs_embeds"]
        if embeddings[1] is None:  # only the prompt: what follows is made of what is kept here
            kv(result[1].layers)
        return result

    joint.forward = reading
    return kv


# -- attention ------------------------------------------------------------------------------------------------

Note = Callable[[int, int, Tensor], None]
"""A function that takes a block, an iteration, and weights (B, H, S, K)."""


Weights = Callable[[Any, tuple[Any, ...], dict[str, Any], Any], Tensor]
"""A function that gives the weights of one call, of the module, its inputs, its keywords and its output."""
_OTHER_STEPS = ("q_norm", "attn_logit_softcapping")
"""The attributes of attentions of transformers that do more than project, rotate and scale."""


@contextmanager
def recording_weights(attentions: Sequence[nn.Module], note: Note, weights: Weights) -> Iterator[None]:
    """Record the weights of every call of every module, as `weights` computes them."""

    def hook_of(block: int) -> Callable[..., None]:
        calls = count()

        def hook(module: nn.Module, inputs: tuple[Any, ...], keywords: dict[str, Any], output: Any) -> None:
            note(block, next(calls), weights(module, inputs, keywords, output))

        return hook

    with ExitStack() as stack:
        for block, module in enumerate(attentions):
            stack.callback(module.register_forward_hook(hook_of(block), with_kwargs=True).remove)
        yield


def returned_weights(_: Any, __: tuple[Any, ...], ___: dict[str, Any], output: Any) -> Tensor:
    """Return the weights (B, H, S, K) that eager attention returns beside what it read.

    Raises:
        CaptureError: If it returns none.
    """
    if output[1] is None:
        raise CaptureError("an attention that should be eager gave no weights; load the model as it was released")
    weights: Tensor = output[1]
    return weights


def recompute_weights(attention: Any, inputs: tuple[Any, ...], keywords: dict[str, Any], _: Any) -> Tensor:
    """Return the weights (B, H, 1, K) of the last position of an attention of Llama's kind.

    Its fast kernels return no weights, so they are computed once more from the module's inputs and the keys it
    left.

    Raises:
        UnsupportedInterventionError: For an attention of another kind.
    """
    # With a norm of queries, as in Qwen3, or a soft cap, as in Gemma 2, these lines would give other weights.
    other_steps = [name for name in _OTHER_STEPS if getattr(attention, name, None) is not None]
    if getattr(attention, "o_proj", None) is None or other_steps:
        raise UnsupportedInterventionError(
            f"{type(attention).__name__} weighs in a way of its own ({', '.join(other_steps) or 'no o_proj'}): "
            "its attention cannot be computed once more here. Patch `kv` instead"
        )
    states: Tensor = (inputs[0] if inputs else keywords["hidden_states"])[:, -1:]
    cosines, sines = (part[:, None, -1:] for part in keywords["position_embeddings"])
    queries = attention.q_proj(states).unflatten(-1, (-1, attention.head_dim)).transpose(1, 2)
    # transformers' rotation pairs number i of a head with number i + E/2; so are the keys in the cache.
    below, above = queries.chunk(2, dim=-1)
    queries = queries * cosines + torch.cat([-above, below], dim=-1) * sines
    return shares(
        queries, keywords["past_key_values"].layers[attention.layer_idx].keys, attention.scaling, keywords
    )


def shares(queries: Tensor, keys: Tensor, scale: float, keywords: dict[str, Any]) -> Tensor:
    """Return the softmax of queries on keys, float32.

    Args:
        queries: (B, H, S, E).
        keys: (B, G, K, E), H a multiple of G.
        scale: Factor of the products of queries and keys.
        keywords: May hold `attention_mask` (B, 1, S or more, K or more): True where a key is seen, or what is
            added.

    Returns:
        (B, H, S, K).
    """
    keys = keys.repeat_interleave(queries.shape[1] // keys.shape[1], dim=1)
    logits = queries.float() @ keys.float().transpose(2, 3) * scale
    mask: Tensor | None = keywords.get("attention_mask")
    if mask is not None:
        rows = mask[:, :, -queries.shape[2] :, : logits.shape[-1]]
        logits = logits.masked_fill(~rows, -torch.inf) if rows.dtype == torch.bool else logits + rows
    return functional.softmax(logits, dim=-1)


def on_the_prompt(note: Note) -> Note:
    """Return a note for one decoder that puts out tokens: the last position acts, and the prompt has its own.

    At iteration k there are k tokens and that one behind the backbone's.
    """

    def note_prompt(block: int, iteration: int, weights: Tensor) -> None:
        note(block, iteration, weights[:, :, -1:, : weights.shape[-1] - 1 - iteration])

    return note_prompt


def decoder_attention(layers: Sequence[Any], note: Note, eager: bool = False) -> AbstractContextManager[None]:
    """Return a context over the attention of a decoder that puts out tokens.

    Args:
        layers: The blocks of the decoder, in order.
        note: Receives the weights of every block and iteration on the prompt.
        eager: Whether the attention returns its weights; else they are computed once more.
    """
    return recording_weights(
        [layer.self_attn for layer in layers],
        on_the_prompt(note),
        returned_weights if eager else recompute_weights,
    )
