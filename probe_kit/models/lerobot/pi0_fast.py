"""lerobot's own `PI0FastPolicy` at the size a checkpoint has, and its decoding of action tokens.

lerobot's constructor loads two tokenizers, one of them with remote code. The network is built without both.
`decode_tokens` calls lerobot's modules as its `sample_actions_fast_kv_cache` does, and gives the same tokens. It
also draws each row by its own seed, and decodes at least as many tokens as are captured.

Source: arXiv 2501.09747, through lerobot's `PI0FastPytorch`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import torch
from lerobot.policies.common.vla_utils import prepare_attention_masks_4d
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.policies.pi0_fast.modeling_pi0_fast import PI0FastPolicy
from torch import Tensor

from probe_kit.models.building import replaced
from probe_kit.models.config_file import Count
from probe_kit.models.lerobot.pi0 import GemmaSize, SiglipSize, SizeFile, sized_paligemma
from probe_kit.models.prompt_kv import PromptKV
from probe_kit.models.sizes_only import building_device

_NO_TOKENIZER = SimpleNamespace(from_pretrained=lambda *_, **__: None)


class Pi0FastSize(SizeFile):
    """Every dimension of a pi0-FAST that its `config.json` cannot express."""

    network = "pi0-FAST"

    vlm: GemmaSize
    vision: SiglipSize
    vocab_size: Count


def build_pi0_fast(config: PI0FastConfig, size: Pi0FastSize | None = None, device: str = "cpu") -> PI0FastPolicy:
    """A `PI0FastPolicy` in eval mode with uninitialised weights and without tokenizers; see `build_pi0`."""
    device = building_device(device)
    config.device = device
    no_tokenizers = {"AutoProcessor": _NO_TOKENIZER, "AutoTokenizer": _NO_TOKENIZER}
    with sized(size, config), replaced(modeling_pi0_fast, no_tokenizers), torch.device(device):
        policy = PI0FastPolicy(config)
    policy.eval()
    joint: Any = policy.model.paligemma_with_expert
    joint.prompt_kv = PromptKV(len(joint.paligemma.model.language_model.layers))
    return cast(PI0FastPolicy, policy)


def full_size_pi0_fast() -> PI0FastPolicy:
    """The released size, on the meta device."""
    return build_pi0_fast(PI0FastConfig(device="cpu"), device="meta")


@contextmanager
def sized(size: Pi0FastSize | None, config: PI0FastConfig) -> Iterator[None]:
    """Inside, lerobot's module builds a network of this size; None for the released one."""
    if size is None:
        yield
        return
    build = sized_paligemma(modeling_pi0_fast, size.vlm, size.vision, size.vocab_size, config.image_resolution[0])
    replacements: dict[str, Callable[..., Any]] = {
        "get_gemma_config": lambda _: size.vlm,
        "PaliGemmaForConditionalGenerationWithPiGemma": build,
    }
    with replaced(modeling_pi0_fast, replacements):
        yield


@dataclass(frozen=True)
class TokenPrompt:
    """The inputs before the first action token. bos: id that begins the actions; end: id that ends them.

    images: (B, 3, H, W) in [-1, 1] of every camera. image_masks: (B,) of every camera. tokens, mask: (B, T).
    """

    images: list[Tensor]
    image_masks: list[Tensor]
    tokens: Tensor
    mask: Tensor
    bos: int
    end: int


def decode_tokens(
    model: Any, prompt: TokenPrompt, least: int, most: int, choose: Callable[[Tensor], Tensor]
) -> Tensor:
    """(B, n) ids of `least` to `most` tokens: until every row has put out `end`.

    model: lerobot's `PI0FastPytorch`. choose: (B,) ids of logits (B, V). A row that has ended is decoded
    with the others, so that no row depends on another one; what it puts out behind its `end` means nothing.
    """
    joint = model.paligemma_with_expert
    rows, device = len(prompt.tokens), prompt.tokens.device
    always = torch.ones((rows, 1), dtype=torch.bool, device=device)
    begin = torch.full((rows, 1), prompt.bos, dtype=torch.long, device=device)
    tokens, mask = torch.cat([prompt.tokens, begin], dim=1), torch.cat([prompt.mask, always], dim=1)
    entering, valid, attends, _, _ = model.embed_prefix_fast(prompt.images, prompt.image_masks, tokens, mask)
    entering = entering.to(_dtype(joint, entering))
    places, past = torch.cumsum(valid, dim=1) - 1, None
    ids: list[Tensor] = []
    ended = torch.zeros(rows, dtype=torch.bool, device=device)
    while True:
        (states, _), past = joint.forward(
            attention_mask=prepare_attention_masks_4d(attends, dtype=entering.dtype),
            position_ids=places,
            past_key_values=past,
            inputs_embeds=[entering, None],
            use_cache=True,
            adarms_cond=[None, None],
        )
        if not ids:  # what follows reads what is kept of the prompt
            joint.prompt_kv(past.layers)
        ids.append(choose(joint.paligemma.lm_head(states[:, -1:])[:, -1]))
        ended |= ids[-1] == prompt.end
        if len(ids) >= most or (len(ids) >= least and bool(ended.all())):
            return torch.stack(ids, dim=1)
        entering = joint.embed_language_tokens(ids[-1][:, None])
        entering = entering.to(_dtype(joint, entering))
        valid = torch.cat([valid, always], dim=1)
        places, attends = valid.sum(dim=1, keepdim=True) - 1, valid[:, None]


def _dtype(joint: Any, entering: Tensor) -> torch.dtype:
    """lerobot computes in bfloat16 where the attention's weights are."""
    stored: torch.dtype = joint.paligemma.model.language_model.layers[0].self_attn.q_proj.weight.dtype
    return torch.bfloat16 if stored == torch.bfloat16 else entering.dtype
