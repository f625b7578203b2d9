"""The adapter for SmolVLA, built from the VLM configuration its checkpoint names; no second download.

Prefix: per camera its patches (between special tokens, if the checkpoint says so), the language, then one state
token that the rest does not see. Suffix: the action chunk, causal. lerobot drives the layers piecewise and adds in
place, so no layer module ever fires; the norms at their entries do.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from numpy.typing import NDArray
from torch import Tensor
from transformers import AutoTokenizer, SmolVLMConfig

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES, is_on_hub
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.sites import PADDING
from probe_kit.hooks.families.shared.lerobot.flow import LerobotFlow
from probe_kit.hooks.families.shared.lerobot.normaliser import STATISTICS
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP, tokenizer_folder, tokenizer_name
from probe_kit.hooks.families.shared.taps import Note, Stack, flow_stacks, shares
from probe_kit.models.building import building_device, replace_attributes
from probe_kit.models.checkpoint_files import load_pretrained


def build_smolvla(config: SmolVLAConfig, folder: Path, device: str = "cpu") -> SmolVLAPolicy:
    """Build a `SmolVLAPolicy` in eval mode, float32, with uninitialised weights.

    Only the VLM's configuration and tokenizer are read: its weights are part of the policy's own file.

    Args:
        config: The configuration of lerobot; its `vlm_model_name` may be a path relative to `folder`, or a hub id.
        folder: The checkpoint.
        device: The device of the weights; `meta` serves to look at names and shapes.

    Raises:
        CheckpointError: If the VLM's configuration cannot be found.
    """
    device = building_device(device)
    config.device = device
    config.load_vlm_weights = False
    name = config.vlm_model_name
    config.vlm_model_name = locate_vlm(config, folder)
    try:
        # lerobot prints while it builds; stdout belongs to results.
        with (
            torch.device(device),
            redirect_stdout(sys.stderr),
            replace_attributes(smolvlm_with_expert, _without_code()),
        ):
            policy = SmolVLAPolicy(config)
    except OSError as error:
        raise CheckpointError(
            f"{folder} names the VLM {name!r}, whose configuration and tokenizer cannot be found: "
            f"{str(error).splitlines()[0]}. Check your network, or name a local copy in its config.json"
        ) from error
    policy.eval()
    return cast(SmolVLAPolicy, policy)


def _without_code() -> dict[str, Any]:
    """Return the loaders that lerobot calls, so that they run no Python code of the VLM's files."""
    loaders = {name: getattr(smolvlm_with_expert, name) for name in ("AutoConfig", "AutoProcessor")}
    return {
        name: SimpleNamespace(from_pretrained=partial(load_pretrained, loader)) for name, loader in loaders.items()
    }


def locate_vlm(config: SmolVLAConfig, folder: Path) -> str:
    """The folder of a checkpoint's VLM, where it lies relative to that of the checkpoint, or its hub id."""
    local = folder / config.vlm_model_name
    return str(local.resolve()) if local.is_dir() else config.vlm_model_name


def current_smolvla_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the same tensors without the statistics that old files kept among the weights."""
    return {name: tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}


def full_size_smolvla() -> SmolVLAPolicy:
    """Build the released size, on the meta device, without the hub: for names and shapes only."""
    with _released_vlm():
        return build_smolvla(SmolVLAConfig(device="cpu"), Path(), device="meta")


@contextmanager
def _released_vlm() -> Iterator[None]:
    """Answer lerobot in place of the hub, while the network is built, with SmolVLM2-500M's configuration."""
    config = SmolVLMConfig(
        text_config={
            "model_type": "llama",
            "hidden_size": 960,
            "num_hidden_layers": 32,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
            "head_dim": 64,
            "intermediate_size": 2560,
            "vocab_size": 49280,
        },
        vision_config={
            "hidden_size": 768,
            "num_hidden_layers": 12,
            "num_attention_heads": 12,
            "intermediate_size": 3072,
            "patch_size": 16,
            "image_size": 512,
        },
        scale_factor=4,
    )
    tokenizer = SimpleNamespace(fake_image_token_id=0, global_image_token_id=0)
    answers = {
        "AutoConfig": SimpleNamespace(from_pretrained=lambda _, **__: config),
        "AutoProcessor": SimpleNamespace(from_pretrained=lambda _, **__: SimpleNamespace(tokenizer=tokenizer)),
    }
    with replace_attributes(smolvlm_with_expert, answers):
        yield


class SmolVLA(LerobotFlow):
    """A loaded SmolVLA."""

    family = "smolvla"
    config_type = "smolvla"
    known_steps = (
        CROP,
        "smolvla_new_line_processor",
    )
    unread = ("model.vlm_with_expert.vlm.lm_head.weight",)
    current_names = current_smolvla_keys

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy in float32, without a second download of the VLM's weights.

        Raises:
            CheckpointError: For another dtype, and if the VLM's configuration cannot be found.
        """
        if getattr(config, "dtype", "float32") != "float32":
            raise CheckpointError(
                "SmolVLA runs in float32 here, because lerobot's mixed precision depends on how its VLM was "
                "loaded. Leave --dtype out"
            )
        config.vlm_named = locate_vlm(config, folder)
        config.vlm_model_name = str(_folder_of(config.vlm_named))
        return build_smolvla(config, folder)

    def _stacks(self) -> dict[str, Stack]:
        joint = self._joint
        backbone, expert, vision = joint.vlm.model.text_model, joint.lm_expert, joint.vlm.model.vision_model
        return flow_stacks(backbone, expert, vision, self.iterations)

    @property
    def _joint(self) -> Any:
        return self.network.model.vlm_with_expert

    @property
    def iterations(self) -> int:
        """The number of flow-matching steps per inference."""
        return int(self.config.num_steps)

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of the saved step, or else the VLM's, by its name where there is no network yet."""
        if (saved := tokenizer_folder(self.folder)) is not None:
            return load_pretrained(AutoTokenizer, saved)
        name = tokenizer_name(self.folder)
        vlm = getattr(self.config, "vlm_named", None) or locate_vlm(self.config, self.folder)
        if name is not None and name != vlm and is_on_hub(name) and is_on_hub(vlm):
            return load_pretrained(AutoTokenizer, checkpoint_folder(name, SMALL_FILES))
        if hasattr(self, "network"):
            return self._joint.processor.tokenizer
        return load_pretrained(AutoTokenizer, _folder_of(vlm))

    def parts(self) -> dict[str, Path]:
        """Return the folder of the VLM's configuration and tokenizer, where it is a folder here."""
        vlm = Path(self.config.vlm_model_name)
        return {"vlm": vlm} if vlm.is_dir() else {}

    @property
    def masked_cameras(self) -> int:
        """The count of masked cameras: of those not shown, `empty_cameras` are masked and the others left out."""
        return min(len(self.config.image_features) - len(self.shown_cameras), int(self.config.empty_cameras))

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """Return the labels of pictures, masked pictures, language and state, filled up to `prefix_length`."""
        images = [label for camera in self.shown_cameras for label in self._camera_labels(f"image.{camera}")]
        labels = [*images, *self._camera_labels(PADDING) * self.masked_cameras, *language, "state"]
        return labels + [PADDING] * (self.config.prefix_length - len(labels))

    def _camera_labels(self, role: str) -> list[str]:
        """Return one camera's positions; the special tokens around a masked picture are not masked."""
        labels = [role] * self.tokens_per_camera
        return ["special", "special", *labels, "special"] if self.config.add_image_special_tokens else labels

    @contextmanager
    def record_attention(self, note: Note) -> Iterator[None]:
        """Record attention that is computed once more: lerobot's attention is a method that returns no weights.

        Over the prompt it is called once per block, then in every iteration by each block that has an expert.
        """
        joint, calls = self._joint, count(-len(self.stacks["backbone"].layers))
        plain, stacks = joint.eager_attention_forward, [joint.get_vlm_model().text_model, joint.lm_expert]
        acting = [block for block, layer in enumerate(joint.get_model_layers(stacks)[1]) if layer is not None]
        prompt = 0

        def attending(
            mask: Tensor, batch: int, head_dim: int, queries: Tensor, keys: Tensor, values: Tensor
        ) -> Tensor:
            nonlocal prompt
            call = next(calls)
            if call < 0:
                prompt = keys.shape[1]
            else:
                keywords = {"attention_mask": mask[:, None]}
                weights = shares(queries.transpose(1, 2), keys.transpose(1, 2), head_dim**-0.5, keywords)
                note(acting[call % len(acting)], call // len(acting), weights[..., :prompt])
            read: Tensor = plain(mask, batch, head_dim, queries, keys, values)
            return read

        joint.eager_attention_forward = attending
        try:
            yield
        finally:
            del joint.eager_attention_forward

    def patch_order(self) -> NDArray[np.int64]:
        """Return the token of each patch: the connector's pixel shuffle makes one token of a square of patches."""
        vlm = self.network.model.vlm_with_expert.vlm.config
        side = vlm.vision_config.image_size // vlm.vision_config.patch_size
        rows, columns = np.divmod(np.arange(side**2), side)
        return np.asarray(rows // vlm.scale_factor * (side // vlm.scale_factor) + columns // vlm.scale_factor)

    @property
    def tokens_per_camera(self) -> int:
        """The number of patches after the connector's pixel shuffle."""
        vlm = self.network.model.vlm_with_expert.vlm.config
        patches = (vlm.vision_config.image_size // vlm.vision_config.patch_size) ** 2
        return int(patches // vlm.scale_factor**2)


def _folder_of(vlm: str) -> Path:
    """The folder with the small files of a vision-language model, a folder or a hub id."""
    return checkpoint_folder(vlm, SMALL_FILES) if is_on_hub(vlm) else Path(vlm)
