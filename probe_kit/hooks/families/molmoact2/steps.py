"""The settings in lerobot's processor files of MolmoAct2 besides statistics: packing, joint frames, clamps."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.molmoact2.units import SAME_FRAME, JointFrame
from probe_kit.hooks.families.shared.lerobot.features import STATE
from probe_kit.hooks.families.shared.lerobot.pipelines import MASKED, check_same, every_step

_PACK, _CLAMP_STATE, _CLAMP_ACTION = (
    "molmoact2_pack_inputs",
    "molmoact2_clamp_normalized",
    "molmoact2_clamp_action",
)
_FRAMES = ("molmoact2_state_frame_transform", "molmoact2_action_frame_transform")
STEPS = (*MASKED, _PACK, _CLAMP_STATE, _CLAMP_ACTION, *_FRAMES)
_PACKED = (
    "image_keys", "setup_type", "control_mode", "normalize_language", "add_setup_tokens", "add_control_tokens",
    "num_state_tokens", "max_sequence_length",
)  # fmt: skip
"""Fields of the configuration that the packing step has too."""
_SAME = {
    "checkpoint_path": "checkpoint_path",
    "chunk_size": "chunk_size",
    "max_action_dim": "expected_max_action_dim",
}
"""Fields of the packing step that are read from the configuration, under its name."""


@dataclass(frozen=True)
class MolmoAct2Steps:
    """The processor steps of one checkpoint. packing: fields that count over those of the configuration.

    state_frame, action_frame: of the joints. clamps_state, clamps_action: whether numbers are moved to -1 to 1.
    unclamped: (D,) True for numbers of the state that the clamp leaves out; None for those without statistics.
    """

    packing: Mapping[str, Any]
    state_frame: JointFrame
    action_frame: JointFrame
    clamps_state: bool
    clamps_action: bool
    unclamped: NDArray[np.bool_] | None


def read_steps(folder: Path, config: Any) -> MolmoAct2Steps:
    """The saved steps; without a packing step, those that lerobot makes of the configuration.

    Raises CheckpointError for frames that are none, and for a packing step of another configuration.
    """
    saved = {step.name: step.config for step in every_step(folder)}
    if _PACK not in saved:
        frame = _frame(vars(config), folder)
        return MolmoAct2Steps({}, frame, frame, clamps_state=True, clamps_action=True, unclamped=None)
    check_same(folder, _PACK, saved[_PACK], {name: getattr(config, theirs) for name, theirs in _SAME.items()})
    state_frame, action_frame = (_frame(saved.get(name, {}), folder) for name in _FRAMES)
    scaled = (saved.get(_CLAMP_STATE, {}).get("normalization_masks") or {}).get(STATE, [])
    return MolmoAct2Steps(
        {name: saved[_PACK][name] for name in _PACKED if name in saved[_PACK]},
        state_frame,
        action_frame,
        clamps_state=_CLAMP_STATE in saved,
        clamps_action=_CLAMP_ACTION in saved,
        unclamped=~np.array(scaled, bool),
    )


def _frame(fields: Mapping[str, Any], folder: Path) -> JointFrame:
    signs, offsets = fields.get("joint_signs"), fields.get("joint_offsets")
    if signs is None or offsets is None:
        return SAME_FRAME
    if len(signs) != len(offsets) or not set(signs) <= {1, -1}:
        raise CheckpointError(
            f"{folder} has joint_signs {signs} and joint_offsets {offsets}; expected 1 or -1, and one offset each"
        )
    return JointFrame(np.array(signs, np.float32), np.array(offsets, np.float32))


def in_packed_order(config: Any, folder: Path) -> dict[str, Any]:
    """The input features with the pictures that the packing reads, in its order. Raises CheckpointError."""
    if not config.image_keys:
        return dict(config.input_features)
    if missing := [key for key in config.image_keys if key not in config.input_features]:
        raise CheckpointError(f"{folder} packs {', '.join(missing)}, which its configuration does not have")
    pictures = {key: config.input_features[key] for key in config.image_keys}
    other_features = {
        key: feature for key, feature in config.input_features.items() if key not in config.image_features
    }
    return {**pictures, **other_features}
