"""The settings in lerobot's processor files of X-VLA besides units: robot, tokenizer, ImageNet's mean."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    NORMALISERS,
    POSTPROCESSOR,
    TOKENIZER,
    check_pipelines,
    check_steps,
    every_step,
    text_length,
    tokenizer_folder,
)

_MEAN, _DOMAIN = "xvla_imagenet_normalize", "xvla_add_domain_id"
STEPS = ("xvla_image_to_float", _MEAN, _DOMAIN)


@dataclass(frozen=True)
class XvlaSteps:
    """The settings of one checkpoint. domain: the robot's number. tokenizer: its name, None where no file has one.

    imagenet: whether pictures are normalised with ImageNet's mean and deviation. length: positions of the text.
    """

    domain: int
    imagenet: bool
    tokenizer: str | None
    length: int | None


def read_steps(folder: Path, domain: int | None, pictures: Sequence[str] = ()) -> XvlaSteps:
    """Read the processor files; `domain` counts over theirs. pictures: keys of all. Raises CheckpointError.

    lerobot takes robot 0 where nothing names one: here it is an error, and so is a step that changes numbers in
    another way.
    """
    check_pipelines(folder)
    check_steps(folder, POSTPROCESSOR, (*NORMALISERS, *STEPS))
    configs: dict[str, Mapping[str, Any]] = {step.name: step.config for step in every_step(folder)}
    for name in STEPS:
        keys = configs.get(name, {}).get("image_keys")
        if keys is not None and (left_out := sorted(set(pictures) - set(keys))):
            raise CheckpointError(
                f"{folder}: the step {name!r} leaves out {', '.join(left_out)} (image_keys); every picture is "
                "treated alike here. Take a checkpoint whose image_keys are null or name all"
            )
    if domain is None and _DOMAIN not in configs:
        raise CheckpointError(f"{folder} names no robot; say whose soft prompts are read with -M domain=N")
    text, length = configs.get(TOKENIZER, {}), text_length(folder)
    if text.get("padding", "max_length") != "max_length":
        raise CheckpointError(f"{folder} pads its text in another way than behind its end up to a fixed length")
    tokenizer = str(saved) if (saved := tokenizer_folder(folder)) is not None else text.get("tokenizer_name")
    robot = configs.get(_DOMAIN, {}).get("domain_id", 0) if domain is None else domain
    return XvlaSteps(int(robot), _MEAN in configs, tokenizer, length)
