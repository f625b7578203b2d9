"""Keys and values of the prompt, for families whose acting part reads them: see `Model.prompt_kv`."""

from typing import Any

from torch import nn

from probe_kit.hooks.contract.model import HeadsTap
from probe_kit.hooks.contract.sites import Site, Stream, kv_stream
from probe_kit.models.prompt_kv import PromptKV

ALL_TOKENS = slice(None)
ALL_BUT_LAST = slice(None, -1)
"""Models whose last prompt token belongs to the acting stream: its keys and values are not the backbone's."""
LAST = slice(-1, None)
"""What that token is of the prompt; every token that is fed back is the last of its pass too."""


def kv_tap(kv: PromptKV, site: Site, tokens: slice = ALL_TOKENS) -> HeadsTap:
    """Return the tap of the keys or values of one block. tokens: of the prompt, those of the backbone."""
    passages: nn.ModuleList = getattr(kv, site.quantity)
    return HeadsTap(passages[site.layer], 1, tokens=tokens)


def kept_prompt(text: Any) -> Stream:
    """The stream `kv` of a decoder of transformers' configuration `text`."""
    heads = int(getattr(text, "num_key_value_heads", None) or text.num_attention_heads)
    size = int(getattr(text, "head_dim", None) or text.hidden_size // text.num_attention_heads)
    return kv_stream(int(text.num_hidden_layers), heads * size)


def attach_prompt_kv(joint: Any, blocks: int) -> PromptKV:
    """Keys and values of lerobot's `joint`, whose pass over the prompt leaves them there from now on.

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
