"""Names of pi0's tensors in older files, brought to the names lerobot 0.6 builds."""

from collections.abc import Mapping

from torch import Tensor

_VLM = "paligemma_with_expert.paligemma"
# Layout of early-2025 files on the left (lerobot/pi0), today's on the right. Longest prefix first.
_RENAMED = (
    (f"{_VLM}.language_model.model.", f"{_VLM}.model.language_model."),
    (f"{_VLM}.language_model.lm_head.", f"{_VLM}.lm_head."),
    (f"{_VLM}.vision_tower.", f"{_VLM}.model.vision_tower."),
    (f"{_VLM}.multi_modal_projector.", f"{_VLM}.model.multi_modal_projector."),
    ("time_mlp_in.", "action_time_mlp_in."),
    ("time_mlp_out.", "action_time_mlp_out."),
)
# Statistics that old files kept among the weights; today they lie in the processor files.
STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
_LM_HEAD = f"model.{_VLM}.lm_head.weight"
_EMBEDDING = f"model.{_VLM}.model.language_model.embed_tokens.weight"


def current_pi0_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under the names lerobot 0.6 uses.

    pi0_base holds the tied token embedding once, as `lm_head`; where both are present `embed_tokens` wins.
    """
    renamed = {_current(name): tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}
    if _LM_HEAD in renamed:
        renamed.setdefault(_EMBEDDING, renamed[_LM_HEAD])
    return renamed


def _current(name: str) -> str:
    bare = name.removeprefix("model.")
    for old, new in _RENAMED:
        if bare.startswith(old):
            return f"model.{new}{bare.removeprefix(old)}"
    return f"model.{bare}"
