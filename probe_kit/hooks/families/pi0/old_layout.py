"""`config.json` of pi0 as lerobot wrote it in early 2025, converted to what lerobot 0.6 reads.

That lerobot kept statistics among the weights or left them to the evaluation; it padded pictures on the left and
top.
"""

from collections.abc import Mapping
from typing import Any

from probe_kit.errors import CheckpointError

_MARKS = ("resize_imgs_with_padding", "num_steps", "proj_width", "train_state_proj", "attention_implementation")
"""Fields that only old files have."""
_RENAMED = {"resize_imgs_with_padding": "image_resolution", "num_steps": "num_inference_steps"}
_FIXED = {"adapt_to_pi_aloha": False, "use_delta_joint_actions_aloha": False}
"""What lerobot 0.6 no longer does to states and actions; checkpoints that need it are refused."""
_WITHOUT_EFFECT = ("proj_width", "use_cache", "attention_implementation", "train_state_proj")
"""Training, speed, and the expert's width, which the weights say themselves."""


def is_old_layout(config: Mapping[str, Any]) -> bool:
    """Whether lerobot 0.6 would refuse or misread this `config.json` of a pi0."""
    return any(name in config for name in _MARKS)


def current_config(config: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The same settings under today's names. source: where the config lies, for messages.

    Raises CheckpointError for a setting that is no longer supported.
    """
    wrong = {name: config[name] for name, value in _FIXED.items() if config.get(name, value) != value}
    if wrong:
        raise CheckpointError(
            f"{source} asks for {', '.join(f'{name}={value}' for name, value in wrong.items())}, which changes "
            "states and actions and is not supported; use a checkpoint without it"
        )
    dropped = {*_WITHOUT_EFFECT, *_FIXED}
    current = {_RENAMED.get(name, name): value for name, value in config.items() if name not in dropped}
    if current.get("image_resolution", True) is None:
        del current["image_resolution"]  # pictures as they are given; they are given at today's default
    return current
