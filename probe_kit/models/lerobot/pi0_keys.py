"""Names of the tensors of pi0, pi0.5 and pi0-FAST in older files, brought to the names lerobot 0.6 builds."""

from collections.abc import Mapping, Sequence

from torch import Tensor

_VLM = "paligemma_with_expert.paligemma"
# Layout of early-2025 files on the left (lerobot/pi0), today's on the right. Longest prefix first.
_MOVED = (
    (f"{_VLM}.language_model.model.", f"{_VLM}.model.language_model."),
    (f"{_VLM}.language_model.lm_head.", f"{_VLM}.lm_head."),
    (f"{_VLM}.vision_tower.", f"{_VLM}.model.vision_tower."),
    (f"{_VLM}.multi_modal_projector.", f"{_VLM}.model.multi_modal_projector."),
)
_TIME_OF_PI0 = (("time_mlp_in.", "action_time_mlp_in."), ("time_mlp_out.", "action_time_mlp_out."))
_TIME_OF_PI05 = tuple((new, old) for old, new in _TIME_OF_PI0)
# Statistics that old files kept among the weights; today they lie in the processor files.
STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
LM_HEAD = f"model.{_VLM}.lm_head.weight"
EMBEDDING = f"model.{_VLM}.model.language_model.embed_tokens.weight"


def current_pi0_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0 under the names lerobot 0.6 uses."""
    return _renamed(tensors, (*_MOVED, *_TIME_OF_PI0))


def current_pi05_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0.5 under the names lerobot 0.6 uses."""
    return _renamed(tensors, (*_MOVED, *_TIME_OF_PI05))


def current_pi0_fast_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0-FAST under the names lerobot 0.6 uses."""
    return _renamed(tensors, _MOVED)


def _renamed(tensors: Mapping[str, Tensor], names: Sequence[tuple[str, str]]) -> dict[str, Tensor]:
    return {_current(name, names): tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}


def _current(name: str, names: Sequence[tuple[str, str]]) -> str:
    bare = name.removeprefix("model.")
    for old, new in names:
        if bare.startswith(old):
            return f"model.{new}{bare.removeprefix(old)}"
    return f"model.{bare}"
