"""What lerobot's processor files of X-VLA say besides units: robot, tokenizer, ImageNet's mean."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError

_HARMLESS = (
    "rename_observations_processor", "to_batch_processor", "xvla_image_to_float", "device_processor",
    "normalizer_processor", "unnormalizer_processor",
)  # fmt: skip
"""Steps that are done here too, or change no number."""
_TOKENIZER, _MEAN, _DOMAIN = "tokenizer_processor", "xvla_imagenet_normalize", "xvla_add_domain_id"


@dataclass(frozen=True)
class XvlaSteps:
    """Of one checkpoint. domain: the robot's number. tokenizer: name of its tokenizer, None where no file says.

    imagenet: whether pictures are normalised with ImageNet's mean and deviation. length: positions of the text.
    """

    domain: int
    imagenet: bool
    tokenizer: str | None
    length: int | None


def read_steps(folder: Path, domain: int | None) -> XvlaSteps:
    """From the processor files; `domain` counts over theirs. Raises CheckpointError.

    lerobot takes robot 0 where nothing names one: here it is an error, and so is a step that changes numbers in
    another way.
    """
    found: dict[str, Mapping[str, Any]] = {}
    for name in ("policy_preprocessor", "policy_postprocessor"):
        path = folder / f"{name}.json"
        if not path.is_file():
            raise CheckpointError(f"{path} is missing: without it pictures, state and actions have no meaning")
        content = read_json_object(path, CheckpointError, "Download the checkpoint again")
        for step in content.get("steps", []):
            kind = str(step.get("registry_name"))
            if kind not in (*_HARMLESS, _TOKENIZER, _MEAN, _DOMAIN):
                raise CheckpointError(
                    f"{path} has the step {kind!r}, which changes numbers in a way probe_kit does not know. Known "
                    f"are {', '.join((*_HARMLESS, _TOKENIZER, _MEAN, _DOMAIN))}"
                )
            found[kind] = step.get("config", {})
    if domain is None and _DOMAIN not in found:
        raise CheckpointError(f"{folder} names no robot; say whose soft prompts are read with -M domain=N")
    text = found.get(_TOKENIZER, {})
    if text.get("padding_side", "right") != "right" or text.get("padding", "max_length") != "max_length":
        raise CheckpointError(f"{folder} pads its text in another way than behind its end up to a fixed length")
    own = found.get(_DOMAIN, {}).get("domain_id", 0) if domain is None else domain
    return XvlaSteps(int(own), _MEAN in found, text.get("tokenizer_name"), text.get("max_length"))
