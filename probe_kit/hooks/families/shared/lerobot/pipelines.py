"""The processor pipelines of a lerobot checkpoint: which steps were saved, and what they decide."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import shard_name

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor", "policy_postprocessor"
_HARMLESS = (
    "rename_observations_processor", "to_batch_processor", "to_batch_processor_action",
    "to_batch_processor_observation", "to_batch_processor_complementary_data", "device_processor",
)  # fmt: skip
"""Steps that change no number: observations come here under the names of the policy."""
RELATIVE = ("relative_actions_processor", "absolute_actions_processor")
NORMALISERS = ("normalizer_processor", "unnormalizer_processor")
TOKENIZER, CROP = "tokenizer_processor", "image_crop_resize_processor"
_AGAIN = "Download the checkpoint again"


@dataclass(frozen=True)
class SavedStep:
    """One step. name: in lerobot's registry, or a class. config: its fields. state: the file of its tensors."""

    name: str
    config: Mapping[str, Any]
    state: str | None


def saved_steps(folder: Path, pipeline: str) -> tuple[SavedStep, ...]:
    """The steps in `<pipeline>.json`, in order; none where the file is missing. Raises CheckpointError."""
    path = folder / f"{pipeline}.json"
    if not path.is_file():
        return ()
    entries = read_json_object(path, CheckpointError, _AGAIN).get("steps")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CheckpointError(f"{path} has no list of steps. {_AGAIN}")
    return tuple(
        SavedStep(str(entry.get("registry_name", entry.get("class"))), entry.get("config") or {}, state)
        for entry in entries
        for state in [entry.get("state_file")]
    )


def every_step(folder: Path) -> tuple[SavedStep, ...]:
    """The steps before the policy, then those behind it."""
    return (*saved_steps(folder, PREPROCESSOR), *saved_steps(folder, POSTPROCESSOR))


def check_pipelines(folder: Path) -> None:
    """Raise CheckpointError unless both pipelines are there."""
    for pipeline in (PREPROCESSOR, POSTPROCESSOR):
        if not (path := folder / f"{pipeline}.json").is_file():
            raise CheckpointError(f"{path} is missing: without it pictures, state and actions have no meaning")


def check_steps(folder: Path, pipeline: str, known: Collection[str]) -> None:
    """Raise CheckpointError for a step whose effect is unknown here, and for pictures that are normalised.

    known: names of steps besides the harmless ones.
    """
    for step in saved_steps(folder, pipeline):
        if step.name not in _HARMLESS and step.name not in known:
            raise CheckpointError(
                f"{folder} has the processor step {step.name!r}, which changes numbers in a way probe_kit does "
                f"not know. Known are {', '.join((*_HARMLESS, *known))}"
            )
        if pictures := _normalised_pictures(folder, step):
            raise CheckpointError(
                f"{folder} normalises {', '.join(pictures)} by statistics ({step.name}), which probe_kit does "
                "not. Take a checkpoint whose norm_map has VISUAL: IDENTITY"
            )


def _normalised_pictures(folder: Path, step: SavedStep) -> list[str]:
    """Features whose pictures lerobot would change: it does so where it has statistics of them."""
    if (step.config.get("norm_map") or {}).get("VISUAL", "IDENTITY") == "IDENTITY" or step.state is None:
        return []
    pictures = [name for name, own in (step.config.get("features") or {}).items() if own.get("type") == "VISUAL"]
    try:
        with safe_open(folder / shard_name(step.state), "pt") as file:
            stored = {name.rpartition(".")[0] for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{folder / step.state} cannot be read ({error}); download it again") from error
    return [name for name in pictures if name in stored]


def adds_state(folder: Path) -> bool:
    """Whether lerobot adds the state to what the policy puts out."""
    return any(step.name in RELATIVE and bool(step.config.get("enabled")) for step in every_step(folder))


def text_length(folder: Path) -> int | None:
    """Positions that the text is padded to; None where no step says. Raises CheckpointError for other padding."""
    step = next((step for step in saved_steps(folder, PREPROCESSOR) if step.name == TOKENIZER), None)
    if step is None:
        return None
    if step.config.get("padding_side", "right") != "right":
        raise CheckpointError(
            f"{folder} pads its text in front; probe_kit pads behind it. Save it with lerobot's own"
        )
    length = step.config.get("max_length")
    return None if length is None else int(length)


def reads_state_as_it_is(step: SavedStep, feature: str) -> bool:
    """Whether a normaliser leaves out this feature of the observation."""
    features: Sequence[str] | Mapping[str, Any] = step.config.get("features") or ()
    keys = step.config.get("normalize_observation_keys")
    return (bool(features) and feature not in features) or (keys is not None and feature not in keys)
