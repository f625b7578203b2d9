"""The processor pipelines and configuration fields of a lerobot checkpoint, and what they decide."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safetensors import safe_open

from probe_kit._system.bounded_files import load_json, read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, shard_name
from probe_kit.hooks.contract.card import DeclaredInputs
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE, cameras_of

Inert = Mapping[str, tuple[Any, ...] | None]
"""The fields of a newer lerobot by name, with the values under which inference is as without; None for any."""
_DELTAS = "observation_delta_indices"


def known_values(
    values: Mapping[str, Any],
    read_fields: Collection[str],
    inert: Inert,
    unread: Collection[str],
    source: Path,
    waived: bool = False,
) -> dict[str, Any]:
    """Return `values` without the fields that do nothing here.

    Args:
        values: The content of the file.
        read_fields: Fields that the installed lerobot reads.
        inert: Fields of a newer one, with the values under which they do nothing.
        unread: Fields that the caller says change nothing.
        source: The file, for messages.
        waived: Whether users can say so, with -M unread.

    Raises:
        CheckpointError: Naming every other field that lerobot does not know, and its value.
    """
    extra = {name: value for name, value in values.items() if name not in read_fields and name not in unread}
    changing = {
        name: inert[name] for name, value in extra.items() if name in inert and not _is_one_of(value, inert[name])
    }
    if changing:
        requested = ", ".join(f"{name}: {extra[name]!r}" for name in changing)
        plain = ", ".join(
            f"{name}: {' or '.join(map(repr, inert_values or ()))}" for name, inert_values in changing.items()
        )
        raise CheckpointError(
            f"{source} asks for {requested}, which a newer lerobot does in its inference and probe_kit does not. "
            f"Supported is {plain}: take a checkpoint that was trained so"
        )
    if unknown := sorted(set(extra) - set(inert)):
        listed = ", ".join(f"{name}: {extra[name]!r}" for name in unknown)
        way_out = (
            f"accept them with -M unread={','.join(unknown)}" if waived else "remove them from a copy of the file"
        )
        raise CheckpointError(
            f"{source} has unknown settings: {listed}. lerobot {version('lerobot')} does not read them. If they "
            f"change nothing that a picture, a state or an action depends on, {way_out}"
        )
    return {name: value for name, value in values.items() if name in read_fields}


def _is_one_of(value: Any, plain: tuple[Any, ...] | None) -> bool:
    """Whether a value is one of these, which None is for any; True is not 1 here."""
    return plain is None or any(value == candidate and type(value) is type(candidate) for candidate in plain)


def check_one_frame(config: Any, folder: Path) -> None:
    """Raise CheckpointError for a policy that reads several observations: every inference here is given one."""
    if (frames := int(getattr(config, "n_obs_steps", 1))) != 1:
        raise CheckpointError(
            f"{folder} reads the last {frames} observations (n_obs_steps); every inference here is given one. "
            "Take a checkpoint with n_obs_steps 1"
        )
    for name in (name for name in dir(type(config)) if name.endswith(_DELTAS)):
        frames = getattr(config, name)
        if frames is not None and list(frames) != [0]:
            raise CheckpointError(
                f"{folder} reads observations of the steps {list(frames)} ({name}); every inference here is given "
                "that of step 0. Take a checkpoint that reads one"
            )


# -- pipelines ------------------------------------------------------------------------------------------------

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor", "policy_postprocessor"
RENAMING = "rename_observations_processor"
_HARMLESS = (
    RENAMING, "to_batch_processor", "to_batch_processor_action",
    "to_batch_processor_observation", "to_batch_processor_complementary_data", "device_processor",
)  # fmt: skip
"""The steps that change no number: observations come here under the names of the policy."""
RELATIVE = ("relative_actions_processor", "absolute_actions_processor")
NORMALISERS = ("normalizer_processor", "unnormalizer_processor")
TOKENIZER, CROP = "tokenizer_processor", "image_crop_resize_processor"
MASKED = ("molmoact2_masked_normalizer", "molmoact2_masked_unnormalizer")
_ANY = None
"""The mark of values that are all honoured, or that change no number here."""
_NORMALISED = dict.fromkeys(("eps", "features", "norm_map", "normalize_observation_keys"), _ANY)
_FRAME = dict.fromkeys(("joint_signs", "joint_offsets"), _ANY)
_TASK = ("task",)
"""The values of `task_key` that are honoured: lerobot puts the instruction there."""
_FIELDS: Mapping[str, Mapping[str, tuple[Any, ...] | None]] = {
    RENAMING: {"rename_map": _ANY},
    "device_processor": {"device": _ANY, "float_dtype": (None, "float32")},
    **dict.fromkeys((*NORMALISERS, *MASKED), _NORMALISED),
    RELATIVE[0]: dict.fromkeys(("enabled", "exclude_joints", "action_names"), _ANY),
    RELATIVE[1]: {"enabled": _ANY},
    # What is padded is masked, and no text is ever cut here.
    TOKENIZER: {
        "tokenizer_name": _ANY, "max_length": _ANY, "truncation": _ANY, "task_key": _TASK,
        "padding": ("max_length", "longest"), "padding_side": ("right",),
    },
    CROP: dict.fromkeys(("crop_params_dict", "resize_size"), _ANY),
    "pi05_prepare_state_tokenizer_processor_step": {
        "max_state_dim": _ANY, "task_key": _TASK, "include_state_in_prompt": (True,),
    },
    "pi0_fast_prepare_state_tokenizer_processor_step": {"max_state_dim": _ANY, "task_key": _TASK},
    # The actions of training; those of inference are decoded as the configuration says.
    "action_tokenizer_processor": dict.fromkeys(
        ("action_tokenizer_name", "trust_remote_code", "max_action_tokens", "fast_skip_tokens",
         "paligemma_tokenizer_name", "allow_truncation"), _ANY,
    ),
    "molmoact2_clamp_normalized": {"normalization_masks": _ANY},
    "molmoact2_state_frame_transform": _FRAME,
    "molmoact2_action_frame_transform": _FRAME,
    "molmoact2_pack_inputs": dict.fromkeys(
        ("checkpoint_path", "checkpoint_revision", "checkpoint_force_download", "action_mode",
         "discrete_action_tokenizer", "image_keys", "allow_image_key_fallback", "setup_type", "control_mode",
         "normalize_language", "add_setup_tokens", "add_control_tokens", "num_state_tokens",
         "max_sequence_length", "chunk_size", "max_action_dim", "env_action_dim"), _ANY,
    ),
    "eo1_conversation_template_processor": dict.fromkeys(("input_features", "chunk_size"), _ANY),
    "eo1_qwen_processor": dict.fromkeys(
        ("processor_name", "image_min_pixels", "image_max_pixels", "use_fast_processor"), _ANY
    ),
    "xvla_image_to_float": {"image_keys": _ANY, "validate_range": _ANY},
    "xvla_imagenet_normalize": {"image_keys": _ANY},
    "xvla_add_domain_id": {"domain_id": _ANY},
}  # fmt: skip
"""The fields of every step that is known to a family, with the values that are; other steps have none."""
_ENTRY = ("registry_name", "class", "config", "state_file", "artifacts")
_AGAIN = "Download the checkpoint again"


@dataclass(frozen=True)
class SavedStep:
    """One step of a saved pipeline.

    Attributes:
        name: The name in lerobot's registry, or a class.
        config: The fields of the step.
        state: The file of its tensors; None for a step without tensors.
    """

    name: str
    config: Mapping[str, Any]
    state: str | None


def saved_steps(folder: Path, pipeline: str) -> tuple[SavedStep, ...]:
    """The steps in `<pipeline>.json`, in order; none where the file is missing.

    Raises:
        CheckpointError: For a file that lists no steps, or a step with other entries than lerobot's.
    """
    path = folder / f"{pipeline}.json"
    if not path.is_file():
        return ()
    entries = read_json_object(path, CheckpointError, _AGAIN).get("steps")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CheckpointError(f"{path} has no list of steps. {_AGAIN}")
    for entry in entries:
        if (strange := sorted(set(entry) - set(_ENTRY))) or not isinstance(entry.get("config") or {}, dict):
            raise CheckpointError(
                f"{path} has the step {entry.get('registry_name')!r} with "
                f"{', '.join(strange) or 'a config without fields'}; expected {', '.join(_ENTRY)}. Save it with "
                "lerobot's own pipeline"
            )
    return tuple(
        SavedStep(str(entry.get("registry_name", entry.get("class"))), entry.get("config") or {}, state)
        for entry in entries
        for state in [entry.get("state_file")]
    )


def step_fields(folder: Path) -> dict[str, Mapping[str, Any]]:
    """The fields of every saved step by its name, those before the policy first."""
    steps = (*saved_steps(folder, PREPROCESSOR), *saved_steps(folder, POSTPROCESSOR))
    return {step.name: step.config for step in steps}


def rename_map(folder: Path) -> dict[str, str]:
    """Return the policy's name of a feature by that of the data set, as the saved preprocessor renames them.

    `lerobot-train --rename_map` saves it. lerobot renames what begins with `observation.`, and all at once.

    Raises:
        CheckpointError: For a map that does not map names to names.
    """
    renames: dict[str, str] = {}
    for step in saved_steps(folder, PREPROCESSOR):
        if step.name != RENAMING:
            continue
        saved = step.config.get("rename_map") or {}
        if not isinstance(saved, dict) or not all(isinstance(name, str) for name in saved.values()):
            raise CheckpointError(
                f"{folder / PREPROCESSOR}.json has the rename_map {saved!r}; expected names of features by names. "
                "Save it with lerobot's own pipeline"
            )
        later = {name: saved.get(renamed, renamed) for name, renamed in renames.items()}
        renames = {**saved, **later}
    return {name: renamed for name, renamed in renames.items() if name != renamed}


def declared_inputs(folder: Path) -> DeclaredInputs | None:
    """Return the inputs that a checkpoint in lerobot's layout declares; None for another layout.

    Raises:
        CheckpointError: For a preprocessor that cannot be read.
        LfsPointerError: For a Git LFS pointer.
    """
    try:
        config = load_json(folder / CONFIG_FILE)
        features = config["input_features"]
        state = int(features[STATE]["shape"][0]) if STATE in features else None
        names, kind = list(features), str(config.get("type"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None  # what it reads is known once it is loaded
    renames, packs = rename_map(folder), step_fields(folder)
    if kind == "molmoact2":  # the order of the step, else of the configuration
        names = list(packs.get("molmoact2_pack_inputs", config).get("image_keys") or names)
    if kind == "groot" and (views := packs.get(PACKING_STEP, {}).get("video_modality_keys")):
        names = read_views(names, views)
    return DeclaredInputs(cameras_of(names, renames), state, renames)


PACKING_STEP = "groot_n1_7_pack_inputs_v1"
_OTHER_NAMES = {"wrist_image": "image2"}
"""The name that lerobot also accepts for a view of GR00T."""


def read_views(features: Sequence[str], views: Sequence[str]) -> list[str]:
    """Return the features that lerobot packs for GR00T, in their order: one for each view, or else all."""
    names = ([f"{IMAGES}{name}" for name in (view, _OTHER_NAMES.get(view, view))] for view in views)
    packed = {next((name for name in either if name in features), None) for either in names}
    return [name for name in features if name in packed] or list(features)


def check_pipelines(folder: Path) -> None:
    """Raise CheckpointError unless both pipelines are there."""
    for pipeline in (PREPROCESSOR, POSTPROCESSOR):
        if not (path := folder / f"{pipeline}.json").is_file():
            raise CheckpointError(f"{path} is missing: without it pictures, state and actions have no meaning")


def check_steps(folder: Path, pipeline: str, family_steps: Collection[str]) -> None:
    """Raise CheckpointError for a step or a field whose effect is unknown here, and for normalised pictures.

    Args:
        folder: The folder of the checkpoint.
        pipeline: `policy_preprocessor` or `policy_postprocessor`.
        family_steps: Names of steps besides the harmless ones.
    """
    steps = saved_steps(folder, pipeline)
    names = [step.name for step in steps]
    for step in steps:
        if step.name not in _HARMLESS and step.name not in family_steps:
            raise CheckpointError(
                f"{folder} has the processor step {step.name!r}, which changes numbers in a way probe_kit does "
                f"not know. Known are {', '.join((*_HARMLESS, *family_steps))}"
            )
        if step.name not in _HARMLESS and names.count(step.name) > 1:
            raise CheckpointError(
                f"{folder / pipeline}.json has the step {step.name!r} twice; probe_kit takes one of each. Save "
                "the pipeline that the policy was trained with"
            )
        check_values(step.config, _FIELDS.get(step.name, {}), f"{folder / pipeline}.json: the step {step.name!r}")
        if pictures := _normalised_pictures(folder, step):
            raise CheckpointError(
                f"{folder} normalises {', '.join(pictures)} by statistics ({step.name}), which probe_kit does "
                "not. Take a checkpoint whose norm_map has VISUAL: IDENTITY"
            )


def check_values(values: Mapping[str, Any], honoured: Mapping[str, tuple[Any, ...] | None], subject: str) -> None:
    """Raise CheckpointError for a field whose effect is unknown here, and for a value that is not honoured.

    Args:
        values: The fields, by name.
        honoured: Fields with the values that are honoured; None for any.
        subject: The file and the part of it, for messages.
    """
    for name, value in values.items():
        if name not in honoured:
            fields = ", ".join(honoured) or "none"
            raise CheckpointError(
                f"{subject} has the field {name}: {value!r}, which may change numbers in a way probe_kit does not "
                f"know. Known are {fields}. If it changes nothing, remove it from a copy of the file"
            )
        if not _is_one_of(value, plain := honoured[name]):
            raise CheckpointError(
                f"{subject} says {name}: {value!r}, which probe_kit does not repeat. Supported is "
                f"{' or '.join(map(repr, plain or ()))}: take a checkpoint that was trained so"
            )


def check_same(folder: Path, step: str, saved: Mapping[str, Any], configured: Mapping[str, Any]) -> None:
    """Raise CheckpointError for a value that a step was saved with where `config.json` says otherwise.

    Args:
        folder: The folder of the checkpoint.
        step: Name of the step, for messages.
        saved: The fields of the step; None stands for no value.
        configured: The fields as `config.json` has them.
    """
    wrong = [
        f"{name}: {saved[name]!r} (config.json: {value!r})"
        for name, value in configured.items()
        if saved.get(name) not in (None, value)
    ]
    if wrong:
        raise CheckpointError(f"{folder}: the step {step} has {', '.join(wrong)}. Save the two files together")


def tokenizer_name(folder: Path) -> str | None:
    """The name of the tokenizer in the saved step; None where no step has one."""
    name = step_fields(folder).get(TOKENIZER, {}).get("tokenizer_name")
    return name if isinstance(name, str) and name else None


def tokenizer_folder(folder: Path) -> Path | None:
    """The folder of the tokenizer that lerobot saved into the checkpoint; None where the step names none there."""
    name = tokenizer_name(folder)
    if name is None or Path(name).is_absolute() or ".." in Path(name).parts:
        return None
    return folder / name if (folder / name / "tokenizer.json").is_file() else None


def _normalised_pictures(folder: Path, step: SavedStep) -> list[str]:
    """Return features whose pictures lerobot would change: it does so where it has statistics of them."""
    if (step.config.get("norm_map") or {}).get("VISUAL", "IDENTITY") == "IDENTITY" or step.state is None:
        return []
    pictures = [
        name for name, feature in (step.config.get("features") or {}).items() if feature.get("type") == "VISUAL"
    ]
    with (
        while_reading(folder / step.state, advice=_AGAIN),
        safe_open(folder / shard_name(step.state), "pt") as file,
    ):
        stored = {name.rpartition(".")[0] for name in file.keys()}  # noqa: SIM118
    return [name for name in pictures if name in stored]


def adds_state(folder: Path) -> bool:
    """Whether lerobot adds the state to what the policy puts out."""
    fields = step_fields(folder)
    return any(fields.get(name, {}).get("enabled") for name in RELATIVE)


def text_length(folder: Path) -> int | None:
    """Return the number of positions that the text is padded to; None where no step says it."""
    length = step_fields(folder).get(TOKENIZER, {}).get("max_length")
    return None if length is None else int(length)


def reads_state_as_it_is(step: SavedStep, feature: str) -> bool:
    """Whether a normaliser leaves out this feature of the observation."""
    features: Sequence[str] | Mapping[str, Any] = step.config.get("features") or ()
    keys = step.config.get("normalize_observation_keys")
    return (bool(features) and feature not in features) or (keys is not None and feature not in keys)
