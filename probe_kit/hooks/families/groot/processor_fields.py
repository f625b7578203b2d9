"""The fields of NVIDIA's `processor_config.json`: each is honoured, does nothing at inference, or is refused."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.shared.lerobot.pipelines import check_values

PROCESSOR_FILE = "processor_config.json"
_FLAG = (True, False)
_OFF = (False, None)
_ANY = None
_TOP: Mapping[str, tuple[Any, ...] | None] = {
    "processor_class": ("Gr00tN1d7Processor",),
    "processor_kwargs": _ANY,
}
_SETTINGS: Mapping[str, tuple[Any, ...] | None] = {
    **dict.fromkeys(
        ("modality_configs", "max_action_horizon", "max_state_dim", "max_action_dim", "image_crop_size",
         "image_target_size", "shortest_image_edge", "crop_fraction"), _ANY,
    ),
    **dict.fromkeys(
        ("use_percentiles", "clip_outliers", "formalize_language", "use_relative_action", "use_albumentations",
         "letter_box_transform", "apply_sincos_state_encoding", "exclude_state"), _FLAG,
    ),
    # Of training, or of a model that the network's configuration names too.
    **dict.fromkeys(
        ("random_rotation_angle", "color_jitter_params", "extra_augmentation_config", "state_dropout_prob",
         "model_name", "transformers_loading_kwargs"), _ANY,
    ),
    "model_type": ("qwen",),
    # NVIDIA's processor stores it and reads it nowhere: nothing says what a checkpoint that has it was trained on.
    "use_mean_std": _OFF,
    "use_tactile": _OFF,
    **dict.fromkeys(("tactile_state_keys", "tactile_input_shape", "tactile_embed_dim"), _ANY),
}  # fmt: skip
_MODALITIES = dict.fromkeys(("video", "state", "action", "language"), _ANY)
_MODALITY: Mapping[str, tuple[Any, ...] | None] = {
    **dict.fromkeys(
        ("delta_indices", "modality_keys", "sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"),
        _ANY,
    ),
    "exclude_state": (*_FLAG, None),
}
_ACTION = dict.fromkeys(("rep", "type", "format", "state_key"), _ANY)


@dataclass(frozen=True)
class StateFields:
    """The state of one embodiment. excluded: the network reads zeros. angles: groups read as sine and cosine.

    deviations, action_deviations: groups of the state and of the action that are mapped by mean and deviation.
    """

    excluded: bool
    angles: tuple[str, ...]
    deviations: tuple[str, ...]
    action_deviations: tuple[str, ...]


def processor_settings(folder: Path) -> dict[str, Any]:
    """The settings in `processor_config.json`. Raises CheckpointError for one that may change numbers unseen."""
    path = folder / PROCESSOR_FILE
    content = read_json_object(path, CheckpointError, "Download the checkpoint again")
    check_values(content, _TOP, str(path))
    settings = content.get("processor_kwargs")
    if not isinstance(settings, dict):
        raise CheckpointError(f"{path} has no processor_kwargs with fields. Download the checkpoint again")
    check_values(settings, _SETTINGS, str(path))
    for name in ("image_crop_size", "image_target_size"):
        _check_pair(path, name, settings.get(name))
    _check_number(path, "shortest_image_edge", settings.get("shortest_image_edge"), int, 1 << 16)
    _check_number(path, "crop_fraction", settings.get("crop_fraction"), (int, float), 1)
    return settings


def read_state_fields(folder: Path, settings: Mapping[str, Any], tag: str) -> StateFields:
    """The settings of the processor file for the state of embodiment `tag`.

    Raises CheckpointError for several frames of the state, and for a field that may change numbers unseen.
    """
    path = folder / PROCESSOR_FILE
    modalities = settings.get("modality_configs", {}).get(tag, {})
    check_values(modalities, _MODALITIES, f"{path}: {tag}")
    for name, modality in modalities.items():
        if not isinstance(modality, dict):
            raise CheckpointError(
                f"{path}: {name} of {tag} is {modality!r}; expected fields such as modality_keys"
            )
        check_values(modality, _MODALITY, f"{path}: {name} of {tag}")
        for action in modality.get("action_configs") or ():
            check_values(action, _ACTION, f"{path}: an action of {tag}")
    state, action = modalities.get("state", {}), modalities.get("action", {})
    if (frames := state.get("delta_indices", [0])) != [0]:
        raise CheckpointError(
            f"{path}: {tag} reads states of the steps {frames} (delta_indices); every inference here is given "
            "that of step 0. Take a checkpoint that reads one"
        )
    angles = _groups(path, state, "sin_cos_embedding_keys") if settings.get("apply_sincos_state_encoding") else ()
    return StateFields(
        excluded=bool(settings.get("exclude_state") or state.get("exclude_state")),
        angles=angles,
        # NVIDIA's processor looks for angles first.
        deviations=tuple(key for key in _groups(path, state, "mean_std_embedding_keys") if key not in angles),
        action_deviations=_groups(path, action, "mean_std_embedding_keys"),
    )


def check_widths(folder: Path, settings: Mapping[str, Any], network: Mapping[str, Any]) -> None:
    """Raise CheckpointError where processor and network say different widths of state or action."""
    for name in ("max_state_dim", "max_action_dim"):
        width, other = settings.get(name), network.get(name)
        if width is not None and other is not None and width != other:
            raise CheckpointError(
                f"{folder / PROCESSOR_FILE} says {name}: {width}, config.json {other}. The network reads the "
                "latter: take the original files"
            )


def _groups(path: Path, modality: Mapping[str, Any], field: str) -> tuple[str, ...]:
    """The groups that a field lists. Raises CheckpointError for one that the modality does not have."""
    listed = modality.get(field) or []
    keys = modality.get("modality_keys", [])
    if not isinstance(listed, list) or (strange := [key for key in listed if key not in keys]):
        raise CheckpointError(
            f"{path} says {field}: {listed!r}; expected groups of {keys!r}. Take the original file"
            + (f" (unknown: {', '.join(map(str, strange))})" if isinstance(listed, list) else "")
        )
    return tuple(listed)


def _check_pair(path: Path, name: str, value: Any) -> None:
    sides = value if isinstance(value, list) else []
    if value is not None and not (len(sides) == 2 and all(type(side) is int and side > 0 for side in sides)):
        raise CheckpointError(f"{path} says {name}: {value!r}; expected height and width in pixels")


def _check_number(path: Path, name: str, value: Any, kind: Any, most: int) -> None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, kind) or not 0 < value <= most):
        raise CheckpointError(f"{path} says {name}: {value!r}; expected a number above 0 and at most {most}")
