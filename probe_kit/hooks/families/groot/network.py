"""The `GrootPolicy` of lerobot at the size a checkpoint has, its flow, and NVIDIA's own layout of its files.

The constructor of lerobot downloads and loads weights and allows remote code; here the network is built empty, of
transformers' own classes. Its flow draws noise for a whole batch at once; `flow_actions` calls the same modules
with noise that is given.

Source: arXiv 2503.14734 and the released GR00T N1.7, through lerobot's `GrootPolicy`.
"""

import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.groot import groot_n1_7, modeling_groot
from lerobot.policies.groot.configuration_groot import (
    GROOT_N1_5_REMOVAL_GUIDANCE,
    GROOT_N1_7_BACKBONE_MODEL,
    GrootConfig,
    is_raw_groot_n1_7_checkpoint,
)
from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config, Qwen3Backbone
from lerobot.policies.groot.modeling_groot import GrootPolicy
from lerobot.policies.groot.utils import stat_dim_from_entry
from torch import Tensor
from transformers import BatchFeature

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.families.groot.packing import check_widths, processor_settings, read_state_fields
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE, Evaluation
from probe_kit.models.building import build_empty, building_device, replace_attributes

VLM = GROOT_N1_7_BACKBONE_MODEL
"""The model whose configuration lerobot holds itself; any other is read from its folder."""


def network_config(values: Mapping[str, Any], config: GrootConfig, vlm: str) -> GR00TN17Config:
    """Return the network's configuration: the content of its `config.json`, and what `config` sets over it.

    Args:
        values: The content of the network's `config.json`.
        config: The configuration of lerobot.
        vlm: `VLM`, or the folder of the vision-language model's configuration.

    Raises:
        CheckpointError: For another kind of backbone.
    """
    network = GR00TN17Config.from_dict(dict(values))
    if network.backbone_model_type != "qwen":
        raise CheckpointError(
            f"the backbone is {network.backbone_model_type!r}; lerobot's GR00T N1.7 has a Qwen3-VL, 'qwen'"
        )
    network.model_name, network.use_flash_attention, network.load_bf16 = vlm, False, False
    if config.num_inference_timesteps is not None:
        network.num_inference_timesteps = config.num_inference_timesteps
    return network


def build_groot(config: GrootConfig, network: GR00TN17Config, device: str = "cpu") -> GrootPolicy:
    """Build a `GrootPolicy` in eval mode with uninitialised weights; in float32 where `config` says so."""
    device = building_device(device)
    config.device = device
    dtype = torch.float32 if config.model_params_fp32 else torch.bfloat16

    def built(*_: Any, **__: Any) -> Any:
        model = build_empty(
            lambda: GR00TN17(network, {"trust_remote_code": False}, load_backbone_weights=False), dtype, device
        )
        for parameter in model.parameters():  # transformers builds parts in the precision their own files name
            parameter.data = parameter.data.to(dtype)
        return model

    with (
        replace_attributes(modeling_groot, {"GR00TN17": SimpleNamespace(from_pretrained=built)}),
        replace_attributes(
            groot_n1_7, {"get_backbone_cls": lambda _: Qwen3Backbone}
        ),  # which warns of every other name
    ):
        policy = GrootPolicy(config)
    policy.eval()
    return cast(GrootPolicy, policy)


def full_size_groot() -> GrootPolicy:
    """Build the size that lerobot's configuration of GR00T N1.7 has by default, on the meta device."""
    picture = PolicyFeature(FeatureType.VISUAL, (3, 256, 256))
    config = GrootConfig(device="cpu", input_features={"observation.images.image": picture})
    return build_groot(config, network_config({}, config, VLM), device="meta")


def flow_actions(policy: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """Return normalised actions (B, H, D) from noise of that shape: lerobot's flow, one inference.

    Args:
        policy: The policy of lerobot.
        inputs: The tensors that lerobot's processors pack.
        noise: (B, H, D), of the network's own horizon H and widest action D.
    """
    model, head = policy._groot_model, policy._groot_model.action_head
    placed = {name: _place_tensor(tensor, model) for name, tensor in inputs.items()}
    with _precision(policy, noise.device.type):
        prompt = model.backbone(BatchFeature(placed))
        features = head._encode_features(prompt, BatchFeature(placed))
        read, state = features.backbone_features, features.state_features
        masks = {"image_mask": prompt.image_mask, "backbone_attention_mask": prompt.backbone_attention_mask}
        actions = noise.to(read.dtype)
        for step in range(head.num_inference_timesteps):
            time = int(step / float(head.num_inference_timesteps) * head.num_timestep_buckets)
            times = torch.full((len(noise),), time, device=noise.device)
            noisy = head.action_encoder(actions, times, placed["embodiment_id"])
            if head.config.add_pos_embed:
                noisy = noisy + head.position_embedding(torch.arange(noisy.shape[1], device=noise.device))[None]
            read_by = head.model(
                hidden_states=torch.cat((state, noisy), dim=1),
                encoder_hidden_states=read,
                timestep=times,
                **(masks if head.config.use_alternate_vl_dit else {}),
            )
            velocity = head.action_decoder(read_by, placed["embodiment_id"])[:, -head.action_horizon :]
            actions = actions + 1.0 / head.num_inference_timesteps * velocity
    return actions


def _place_tensor(tensor: Tensor, model: Any) -> Tensor:
    """Return a tensor as the network's own `prepare_input` does: numbers in the precision of its weights."""
    return tensor.to(model.device, model.dtype if tensor.is_floating_point() else tensor.dtype)


def _precision(policy: Any, device: str) -> AbstractContextManager[Any]:
    """The precision in which lerobot runs a checkpoint whose configuration says `use_bf16`."""
    return torch.autocast(device_type=device, dtype=torch.bfloat16, enabled=policy.config.use_bf16)


_AGAIN = "Download the checkpoint again"


@dataclass(frozen=True)
class GrootChoice(Evaluation):
    """The choices that GR00T's files leave open; see the options of its family."""

    embodiment: str | None = None
    vlm: str | None = None
    resize: str | None = None
    letterbox: bool | None = None


@dataclass(frozen=True)
class PartFolders:
    """The folders of a checkpoint's parts.

    Attributes:
        network: Content of the network's `config.json`.
        base: Folder of the base model.
        vlm: Folder of the vision-language model.
        model_name: The vision-language model as the network's configuration is to name it.
    """

    network: Mapping[str, Any]
    base: Path
    vlm: Path
    model_name: str

    @classmethod
    def of(cls, folder: Path, base: str, vlm: str | None) -> "PartFolders":
        """Find the parts of a checkpoint.

        Args:
            folder: The folder of the checkpoint.
            base: The base model as the policy's configuration names it, a folder in the checkpoint or a hub id.
            vlm: Another vision-language model, a folder or hub id; None for the one that the base model names.

        Raises:
            CheckpointError: For a part that is not there.
        """
        base_folder = inside_or_hub(folder, base)
        content = read_json_object(base_folder / CONFIG_FILE, CheckpointError, _AGAIN)
        model_name = str(content.get("model_name", VLM))
        files = inside_or_hub(base_folder, vlm or model_name)
        return cls(content, base_folder, files, VLM if model_name.rstrip("/") == VLM else str(files))


_OLDER = re.compile(r"gr00t[-_]?n1(?:[_.d]([0-6]))?(?![_.d]?\d)|^n?1[_.d]?([0-6])$", re.IGNORECASE)
"""The name of a version before N1.7, as base models and `model_version` spell it."""


def check_version(values: Mapping[str, Any], path: Path) -> None:
    """Raise CheckpointError for the configuration of a fine-tune of an older GR00T, with lerobot's way out."""
    if values.get("tokenizer_assets_repo") is not None:  # of N1.5 alone
        minor: str | None = "5"
    else:
        texts = (values.get(name) for name in ("base_model_path", "model_version"))
        older = next((match for text in texts if (match := _OLDER.search(str(text)))), None)
        minor = None if older is None else older[1] or older[2] or ""
    if minor is not None:
        raise CheckpointError(
            f"{path} describes a fine-tune of GR00T N1{minor and '.'}{minor}; lerobot {version('lerobot')} reads "
            f"N1.7 alone. {GROOT_N1_5_REMOVAL_GUIDANCE if minor == '5' else 'Take a fine-tune of N1.7'}"
        )


def is_nvidias(folder: Path) -> bool:
    """Whether a folder has NVIDIA's layout."""
    return bool(is_raw_groot_n1_7_checkpoint(folder))


def nvidias_config(folder: Path, embodiment: str | None) -> GrootConfig:
    """Return lerobot's configuration for a checkpoint in NVIDIA's layout.

    Args:
        folder: The folder of the checkpoint.
        embodiment: The tag of the embodiment; None where the files have one only.

    Raises:
        CheckpointError: For missing files.
        UsageError: For a tag that they do not have.
    """
    settings = processor_settings(folder)
    statistics, numbers = (
        read_json_object(folder / name, CheckpointError, _AGAIN)
        for name in ("statistics.json", "embodiment_id.json")
    )
    modalities = settings.get("modality_configs", {})
    tags = sorted(set(modalities) & set(statistics) & set(numbers))
    tag = tags[0] if embodiment is None and len(tags) == 1 else embodiment
    if tag is None or tag not in tags:
        problem = "no embodiment was chosen" if embodiment is None else f"there is no embodiment {embodiment!r}"
        raise UsageError(f"{folder}: {problem}. Choose with -M embodiment=TAG; it has {', '.join(tags) or 'none'}")
    network = read_json_object(folder / CONFIG_FILE, CheckpointError, _AGAIN)
    read_state_fields(folder, settings, tag)
    check_widths(folder, settings, network)
    widths = {
        feature: sum(stat_dim_from_entry(statistics[tag].get(feature, {}).get(key, {})) for key in keys)
        for feature in ("state", "action")
        for keys in [modalities[tag].get(feature, {}).get("modality_keys", [])]
    }
    if not all(widths.values()):
        raise CheckpointError(f"{folder}: statistics.json has no numbers for state or action of {tag!r}. {_AGAIN}")
    cameras = modalities[tag].get("video", {}).get("modality_keys", [])
    with while_reading(folder / CONFIG_FILE):
        return GrootConfig(
            device="cpu",
            base_model_path=str(folder),
            embodiment_tag=tag,
            max_state_dim=network.get("max_state_dim", 132),
            max_action_dim=network.get("max_action_dim", 132),
            input_features={
                **{f"{IMAGES}{camera}": PolicyFeature(FeatureType.VISUAL, (3, 256, 256)) for camera in cameras},
                STATE: PolicyFeature(FeatureType.STATE, (widths["state"],)),
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (widths["action"],))},
        )
