"""The adapter for X-VLA.

Backbone: Florence-2's encoder over the first camera's picture and the text. Expert: one sequence of the noisy
actions, the end of the backbone, the further cameras and the robot's soft prompts, at every denoising step. All
attend to all. Florence-2 norms behind each addition, so nothing in the backbone's stream only adds.

lerobot's `predict_action_chunk` ignores the noise it is given and draws its own for a whole batch at once.
`denoised_actions` calls the same modules with noise that is given.

Source: arXiv 2510.10274, through lerobot's `XVLAPolicy`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.xvla.configuration_xvla import XVLAConfig
from lerobot.policies.xvla.modeling_xvla import (
    XVLAPolicy,
    _is_vendored_florence_state_dict,
    _remap_vendored_florence_state_dict,
)
from lerobot.utils.constants import IMAGENET_STATS
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, ObservationError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE, Evaluation
from probe_kit.hooks.families.shared.lerobot.flow import DenoisingPolicy
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    NORMALISERS,
    POSTPROCESSOR,
    TOKENIZER,
    check_pipelines,
    check_steps,
    step_fields,
    text_length,
    tokenizer_folder,
)
from probe_kit.hooks.families.shared.taps import Stack
from probe_kit.hooks.families.xvla import BLOCK, INTERVENTIONS
from probe_kit.hooks.outputs import Produce, RecordedRun, numpy_of
from probe_kit.models.building import build_empty, building_device
from probe_kit.models.checkpoint_files import load_pretrained

_LANGUAGE = "model.vlm.language_model."
EMBEDDINGS = (f"{_LANGUAGE}shared.weight", f"{_LANGUAGE}encoder.embed_tokens.weight")
"""The two names of one tensor, of which a file may hold either."""
FLORENCE_LARGE: dict[str, Any] = {
    "vision_config": {
        "embed_dim": [256, 512, 1024, 2048],
        "num_heads": [8, 16, 32, 64],
        "num_groups": [8, 16, 32, 64],
        "projection_dim": 1024,
    },
    "text_config": {
        "vocab_size": 51289,
        "d_model": 1024,
        "encoder_layers": 12,
        "encoder_attention_heads": 16,
        "encoder_ffn_dim": 4096,
        "max_position_embeddings": 4096,
    },
}
"""The sizes of Florence-2 large, the backbone that the paper names; the rest as transformers has it by default."""


def build_xvla(config: XVLAConfig, device: str = "cpu") -> XVLAPolicy:
    """Build a `XVLAPolicy` in eval mode with uninitialised weights, in the precision that `config` names."""
    device = building_device(device)
    config.device = device
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    return cast(XVLAPolicy, build_empty(lambda: XVLAPolicy(config), dtype, device))


def full_size_xvla() -> XVLAPolicy:
    """Build Florence-2 large under lerobot's default transformer, on the meta device."""
    config = XVLAConfig(
        device="cpu",
        florence_config=FLORENCE_LARGE,
        input_features={
            "observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 224, 224)),
            "observation.state": PolicyFeature(FeatureType.STATE, (20,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (20,))},
    )
    return build_xvla(config, device="meta")


def current_xvla_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a file's tensors under the names lerobot's network has.

    Files of 2025 have Florence-2 in its authors' layout.
    """
    stored = dict(tensors)
    return _remap_vendored_florence_state_dict(stored) if _is_vendored_florence_state_dict(stored) else stored


def denoised_actions(policy: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """Return actions (B, chunk, D) from noise: lerobot's denoising, one inference.

    The network predicts actions, not a velocity: every step mixes them with the noise.

    Args:
        policy: The policy of lerobot.
        inputs: A batch in lerobot's keys.
        noise: (B, chunk, widest action).
    """
    model, steps = policy.model, max(1, int(policy.config.num_denoising_steps))
    model_inputs = policy._build_model_inputs(dict(inputs))
    dtype = model._get_target_dtype()
    proprio, noise = model_inputs["proprio"].to(dtype), noise.to(dtype)
    prompt = model.forward_vlm(
        model_inputs["input_ids"], model_inputs["image_input"].to(dtype), model_inputs["image_mask"]
    )
    actions = torch.zeros_like(noise)
    for remaining in range(steps, 0, -1):
        time = torch.full((len(noise),), remaining / steps, device=noise.device, dtype=dtype)
        share = time.view(-1, 1, 1)
        state, noisy = model.action_space.preprocess(proprio, noise * share + actions * (1 - share))
        actions = model.transformer(
            domain_id=model_inputs["domain_id"], action_with_noise=noisy, proprio=state, t=time, **prompt
        )
    return cast(Tensor, model.action_space.postprocess(actions))


# -- settings of processor steps ------------------------------------------------------------------------------

_MEAN, _DOMAIN = "xvla_imagenet_normalize", "xvla_add_domain_id"
STEPS = ("xvla_image_to_float", _MEAN, _DOMAIN)


def read_steps(config: Any, folder: Path, domain: int | None) -> None:
    """Put what the processor files say into lerobot's configuration.

    `imagenet` says whether pictures are normalised with ImageNet's mean and deviation. `tokenizer_name` is also
    the folder in the checkpoint. lerobot takes robot 0 where nothing names one: here it is an error, and so is a
    step that changes numbers in another way.

    Args:
        config: The configuration of lerobot, which is changed.
        folder: The folder of the checkpoint.
        domain: The robot's number, which counts over that of the files; None for theirs.

    Raises:
        CheckpointError: If nothing names a robot, and for a step that changes numbers in another way.
    """
    check_pipelines(folder)
    check_steps(folder, POSTPROCESSOR, (*NORMALISERS, *STEPS))
    fields = step_fields(folder)
    for name in STEPS:
        keys = fields.get(name, {}).get("image_keys")
        if keys is not None and (left_out := sorted(set(config.image_features) - set(keys))):
            raise CheckpointError(
                f"{folder}: the step {name!r} leaves out {', '.join(left_out)} (image_keys); every picture is "
                "treated alike here. Take a checkpoint whose image_keys are null or name all"
            )
    if domain is None and _DOMAIN not in fields:
        raise CheckpointError(f"{folder} names no robot; say whose soft prompts are read with -M domain=N")
    text = fields.get(TOKENIZER, {})
    if text.get("padding", "max_length") != "max_length":
        raise CheckpointError(f"{folder} pads its text in another way than behind its end up to a fixed length")
    config.domain = int(fields.get(_DOMAIN, {}).get("domain_id", 0) if domain is None else domain)
    config.imagenet = _MEAN in fields
    config.tokenizer_name = str(tokenizer_folder(folder) or text.get("tokenizer_name") or config.tokenizer_name)
    config.tokenizer_max_length = text_length(folder) or config.tokenizer_max_length


# -- the adapter ----------------------------------------------------------------------------------------------

SOFT_PROMPT = "soft_prompt"
"""The role of the robot's learned tokens."""


@dataclass(frozen=True)
class XvlaChoice(Evaluation):
    """The choices that X-VLA's files may leave open; see the options of its family."""

    domain: int | None = None


_FLORENCE = {"attention": "self_attn.out_proj", "heads": "self_attn.out_proj", "mlp": "fc2"}
_EXPERT = {"attention": "attn", "heads": "attn.proj", "mlp": "mlp"}
"""The paths of what a block adds or reads, by quantity."""


class Xvla(DenoisingPolicy):
    """A loaded X-VLA."""

    family = "xvla"
    config_type = "xvla"
    choice = XvlaChoice
    known_steps = STEPS
    tied: ClassVar[Mapping[str, str]] = dict((EMBEDDINGS, EMBEDDINGS[::-1]))
    current_names = current_xvla_keys
    interventions = INTERVENTIONS

    other_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    suffix_roles = ("action", SOFT_PROMPT)

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """Return lerobot's configuration, with what the processor files say."""
        config = super().parse_config(folder, evaluation)
        read_steps(config, folder, evaluation.domain)
        config.picture = evaluation.picture or ("padded" if config.resize_imgs_with_padding else None)
        if config.picture and config.resize_imgs_with_padding is None:
            height, width = next(iter(config.image_features.values())).shape[-2:]
            config.resize_imgs_with_padding = (width, height)
        return config

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy.

        Raises:
            CheckpointError: For a state that it would cut.
            UsageError: For a robot that it does not have.
        """
        numbers = config.robot_state_feature.shape[0] if config.robot_state_feature else 0
        if config.use_proprio and numbers > config.max_state_dim:
            raise CheckpointError(
                f"{folder} has a state of {numbers} numbers and reads {config.max_state_dim}: lerobot leaves out "
                "the rest. Take the original configuration"
            )
        if not 0 <= config.domain < config.num_domains:
            raise UsageError(f"-M domain={config.domain}: {folder} has the robots 0 to {config.num_domains - 1}")
        return build_xvla(config)

    def further_settings(self) -> dict[str, str]:
        """Return the robot whose soft prompts are read, and how pictures come to their size."""
        return {"domain": str(self.config.domain), "picture": str(self.config.picture)}

    def _notes(self) -> tuple[str, ...]:
        if self.config.picture is None:
            how = "are read at the size that they have; X-VLA's authors squash them (-M picture=squashed)"
        else:
            size = " x ".join(map(str, self.config.resize_imgs_with_padding))
            squashed = f"squashed to {size}, bicubic, as X-VLA's authors; lerobot pads"
            padded = f"padded to {size}, as lerobot; X-VLA's authors squash them (-M picture=squashed)"
            how = f"are {squashed if self.config.picture == 'squashed' else padded}"
        return (*super()._notes(), f"pictures {how}")

    def look(self, camera: str, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return pictures (B, 3, H, W) in [0, 1]: squashed where that is chosen; lerobot pads any other."""
        if self.config.picture == "squashed":
            size = tuple(self.config.resize_imgs_with_padding)
            images = [
                np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)) for image in images
            ]
        return super().look(camera, images)

    def parts(self) -> dict[str, Path]:
        """Return the folder of the tokenizer, where it is another folder."""
        folder = self._tokenizer_folder
        return {} if folder == self.folder else {"tokenizer": folder}

    @property
    def _tokenizer_folder(self) -> Path:
        name = self.config.tokenizer_name
        inside = (self.folder / "tokenizer.json").is_file() and not Path(name).is_dir()
        return self.folder if inside else checkpoint_folder(name, SMALL_FILES)

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of the folder itself, or the one it names."""
        from transformers import AutoTokenizer

        return load_pretrained(AutoTokenizer, self._tokenizer_folder)

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """Return the instructions as they are."""
        del state
        return list(instructions)

    # -- acting ------------------------------------------------------------------------------------------

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return a batch as lerobot's processors leave it.

        Args:
            observations: The B rows of the batch.
            state: (B, numbers) as the network reads them; None for that of the observations.

        Raises:
            ObservationError: For a picture of another size where the checkpoint resizes nothing.
        """
        batch = super().batch(observations, state)
        mean, deviation = (torch.tensor(IMAGENET_STATS[name]).view(3, 1, 1) for name in ("mean", "std"))
        for camera in self.shown_cameras:
            picture = batch[f"{IMAGES}{camera}"]
            expected = tuple(self.config.image_features[f"{IMAGES}{camera}"].shape[-2:])
            if self.config.resize_imgs_with_padding is None and tuple(picture.shape[-2:]) != expected:
                raise ObservationError(
                    f"the picture of {camera} is {tuple(picture.shape[-2:])}; this checkpoint resizes nothing and "
                    f"expects {expected}"
                )
            if self.config.imagenet:
                batch[f"{IMAGES}{camera}"] = (picture - mean.to(picture)) / deviation.to(picture)
        if not self.config.use_proprio:
            del batch[STATE]
        batch["domain_id"] = torch.full((len(observations),), self.config.domain, device=self.config.device)
        return batch

    @property
    def unguarded_state(self) -> str | None:
        """The reason also where its network reads no state."""
        return super().unguarded_state if self.config.use_proprio else "no state is read (use_proprio: false)"

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return the actions as the base does."""
        return denoised_actions(self.network, batch, noise)

    @property
    def noise_shape(self) -> tuple[int, int]:
        """The shape of one row's noise: actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.network.model.dim_action

    # -- the sequences -----------------------------------------------------------------------------------

    @property
    def masked_cameras(self) -> int:
        """The number of views without a picture, whose zeros the expert attends to: their role is `special`."""
        return int(self.config.num_image_views) - len(self.shown_cameras)

    @cached_property
    def tokens_per_camera(self) -> int:
        """The number of tokens of a picture: its mean, then its patches."""
        first = self.config.image_features[f"{IMAGES}{self.cameras[0]}"].shape[-2:]
        vision = self.network.model.vlm.config.vision_config
        sides: list[int] = []
        for side in self.config.resize_imgs_with_padding or first:
            for patch, stride, padding in zip(
                vision.patch_size, vision.patch_stride, vision.patch_padding, strict=True
            ):
                side = (side + 2 * padding - patch) // stride + 1
            sides.append(side)
        return 1 + sides[0] * sides[1]

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """Return the labels of a text; padding is `special`, because the network attends to it."""
        labels = super().text_labels(ids, valid)
        return ["special" if label == PADDING else label for label in labels]

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """Return the labels of the first camera's picture, then of the text."""
        return [*[f"image.{self.shown_cameras[0]}"] * self.tokens_per_camera, *language]

    def packed_roles(self, tokens: Tensor, mask: Tensor) -> dict[str, list[Roles]]:
        """Return the roles; the backbone's tokens are once more in the expert.

        There they stand between actions, and further cameras and soft prompts.
        """
        prompts = [
            self.prefix_labels(self.text_labels(row, valid))
            for row, valid in zip(tokens.tolist(), mask.tolist(), strict=True)
        ]
        other_views = [f"image.{camera}" for camera in self.shown_cameras[1:]] + ["special"] * self.masked_cameras
        views = [label for label in other_views for _ in range(self.tokens_per_camera)]
        ends = [*views, *[SOFT_PROMPT] * int(self.config.len_soft_prompts)]
        return {
            "backbone": [Roles.from_labels(prompt) for prompt in prompts],
            "expert": [Roles.from_labels([*self.suffix_labels(), *prompt, *ends]) for prompt in prompts],
        }

    def _show(self, cameras: tuple[str, ...]) -> None:
        super()._show(cameras)
        views = tuple(f"image.{camera}" for camera in cameras)
        self.role_names = {
            "backbone": (views[0], *self.other_roles),
            "expert": ("action", *views, *self.other_roles, SOFT_PROMPT),
        }

    def _stacks(self) -> dict[str, Stack]:
        encoder, expert = self.network.model.vlm.language_model.encoder, self.network.model.transformer
        steps = max(1, int(self.config.num_denoising_steps))
        layers, blocks, width = encoder.layers, expert.blocks, int(encoder.config.d_model)
        normed = {"quantities": BLOCK, "sums": False, "heads": int(layers[0].self_attn.num_heads)}
        prompted = {"quantities": BLOCK, "heads": int(blocks[0].attn.num_heads)}
        return {
            # A block norms behind each addition: `residual` is the normed stream.
            "backbone": Stack(layers, layers[-1], width, None, "", _FLORENCE, "output", stream_fields=normed),
            # The whole sequence: the norm behind the last block reads the actions alone.
            "expert": Stack(
                blocks,
                blocks[-1],
                int(expert.hidden_size),
                steps,
                "norm1",
                _EXPERT,
                "output",
                stream_fields=prompted,
            ),
        }

    # -- verification ------------------------------------------------------------------------------------

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the module whose output is the chunk that every step predicts."""
        return {"predicted": self.network.model.transformer.action_decoder}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return the pictures as the network reads them."""
        return {"pixels": lambda: numpy_of(self.network._prepare_images(run.batch)[0])}
