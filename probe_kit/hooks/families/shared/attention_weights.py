"""Recording of attention weights without changing a number of the inference."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import count
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.errors import CaptureError, UnsupportedInterventionError

Note = Callable[[int, int, Tensor], None]
"""Takes a block, an iteration, and weights (B, H, S, K)."""


Weights = Callable[[Any, tuple[Any, ...], dict[str, Any], Any], Tensor]
"""Weights of one call: of the module, its inputs, its keywords and its output."""
_OTHER_STEPS = ("q_norm", "attn_logit_softcapping")
"""Attributes of attentions of transformers that do more than project, rotate and scale."""


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


def returned(_: Any, __: tuple[Any, ...], ___: dict[str, Any], output: Any) -> Tensor:
    """(B, H, S, K): what eager attention returns beside what it read. Raises CaptureError if it does not."""
    if output[1] is None:
        raise CaptureError("an attention that should be eager gave no weights; load the model as it was released")
    weights: Tensor = output[1]
    return weights


def recomputed(attention: Any, inputs: tuple[Any, ...], keywords: dict[str, Any], _: Any) -> Tensor:
    """(B, H, 1, K) of the last position, of Llama's kind of attention, whose fast kernels return no weights.

    Computed once more from the module's inputs and the keys it left. Raises UnsupportedInterventionError for an
    attention of another kind.
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
    """(B, H, S, K) float32 softmax of queries (B, H, S, E) on keys (B, G, K, E), H a multiple of G.

    keywords: may hold `attention_mask` (B, 1, S or more, K or more): True where a key is seen, or what is added.
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


def of_decoder(layers: Sequence[Any], note: Note, eager: bool = False) -> AbstractContextManager[None]:
    """A context over the attention of a decoder that puts out tokens."""
    return recording_weights(
        [layer.self_attn for layer in layers], on_the_prompt(note), returned if eager else recomputed
    )
