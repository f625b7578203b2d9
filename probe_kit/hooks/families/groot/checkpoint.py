"""The two layouts of a GR00T checkpoint: lerobot's, and NVIDIA's own."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.groot.configuration_groot import GrootConfig, is_raw_groot_n1_7_checkpoint
from lerobot.policies.groot.utils import stat_dim_from_entry

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.families.groot.processor_fields import check_widths, processor_settings, read_state_fields
from probe_kit.hooks.families.shared.lerobot.evaluation import Evaluation
from probe_kit.hooks.families.shared.lerobot.features import IMAGES, STATE
from probe_kit.models.lerobot.groot import VLM

_AGAIN = "Download the checkpoint again"


@dataclass(frozen=True)
class GrootChoice(Evaluation):
    """The choices that GR00T's files leave open.

    embodiment: tag of NVIDIA's layout; None where there is one only. vlm: folder or hub id of the vision-language
    model's configuration, tokenizer and processor, where not the one that the checkpoint names. resize: `nvidia`
    or `lerobot`, whose code resizes pictures; None for the layout's own. letterbox: whether black bars make
    pictures square first; None for what the files say.
    """

    embodiment: str | None = None
    vlm: str | None = None
    resize: str | None = None
    letterbox: bool | None = None


@dataclass(frozen=True)
class Places:
    """The folders of a checkpoint's parts. network: content of the network's `config.json`. base, vlm: folders.

    model_name: the vision-language model as the network's configuration is to name it.
    """

    network: Mapping[str, Any]
    base: Path
    vlm: Path
    model_name: str

    @classmethod
    def of(cls, folder: Path, base: str, vlm: str | None) -> "Places":
        """base: as the policy's configuration names it, a folder in the checkpoint or a hub id. vlm: another one.

        Raises CheckpointError for what is not there.
        """
        base_folder = inside_or_hub(folder, base)
        content = read_json_object(base_folder / CONFIG_FILE, CheckpointError, _AGAIN)
        model_name = str(content.get("model_name", VLM))
        files = inside_or_hub(base_folder, vlm or model_name)
        return cls(content, base_folder, files, VLM if model_name.rstrip("/") == VLM else str(files))


def is_nvidias(folder: Path) -> bool:
    """Whether a folder has NVIDIA's layout."""
    return bool(is_raw_groot_n1_7_checkpoint(folder))


def nvidias_config(folder: Path, embodiment: str | None) -> GrootConfig:
    """lerobot's configuration for a checkpoint in NVIDIA's layout.

    embodiment: its tag; None where the files have one only. Raises CheckpointError for missing files, UsageError
    for a tag that they do not have.
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
