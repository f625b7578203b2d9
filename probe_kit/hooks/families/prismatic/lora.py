"""LoRA adapters: read, checked against the network, and merged into its weights by peft."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors.torch import load_file
from torch import Tensor

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import checkpoint_folder

if TYPE_CHECKING:
    from probe_kit.models.prismatic import PrismaticNetwork

ADAPTER_CONFIG = "adapter_config.json"
_FILES = ("adapter_model.safetensors", "adapter_model.bin")
_PREFIX, _PARTS = "base_model.model.", (".lora_A.", ".lora_B.", ".lora_magnitude_vector")


@dataclass(frozen=True)
class Adapter:
    """A LoRA adapter's files: base is the folder or hub id it names; tensors are its own."""

    folder: Path
    base: str
    tensors: dict[str, Tensor]

    @classmethod
    def read(cls, folder: Path) -> "Adapter":
        """Raises CheckpointError if it is no LoRA adapter or has no weights."""
        config = json.loads((folder / ADAPTER_CONFIG).read_text(encoding="utf-8"))
        if config.get("peft_type") != "LORA":
            raise CheckpointError(f"{folder} holds a {config.get('peft_type')} adapter; only LORA can be merged")
        if not config.get("base_model_name_or_path"):
            raise CheckpointError(f"{folder / ADAPTER_CONFIG} does not say its base_model_name_or_path; add it")
        file = next((folder / name for name in _FILES if (folder / name).is_file()), None)
        if file is None:
            raise CheckpointError(f"{folder} has {ADAPTER_CONFIG}, but neither {' nor '.join(_FILES)}")
        if file.suffix == ".bin":
            tensors = torch.load(file, map_location="cpu", weights_only=True)
        else:
            tensors = load_file(file)
        return cls(folder, str(config["base_model_name_or_path"]), tensors)

    def base_folder(self) -> Path:
        """Of the base's checkpoint; a relative path may start at the adapter. Raises CheckpointError."""
        beside = self.folder / self.base
        try:
            return beside.resolve() if beside.is_dir() else checkpoint_folder(self.base)
        except CheckpointError as error:
            raise CheckpointError(
                f"the LoRA adapter in {self.folder} was trained on {self.base!r}: {error}. "
                f"Correct base_model_name_or_path in its {ADAPTER_CONFIG}"
            ) from error

    def modules(self) -> set[str]:
        """Names of the modules it changes. Raises WeightsError for tensors that are no finite low-rank factors."""
        others = [name for name in self.tensors if not any(part in name for part in _PARTS)]
        if others or not self.tensors:
            found = ", ".join(others[:8]) or "no tensors at all"
            raise WeightsError(
                f"{self.folder} holds something else than low-rank factors: {found}. Merge it with the tool that "
                "made it, and pass the merged folder"
            )
        if damaged := [name for name, tensor in self.tensors.items() if not torch.isfinite(tensor).all()]:
            raise WeightsError(f"{self.folder}: NaN or infinite tensors in the adapter: {', '.join(damaged[:8])}")
        return {self._module(name) for name in self.tensors}

    @staticmethod
    def _module(name: str) -> str:
        bare = name.removeprefix(_PREFIX)
        return next(bare.partition(part)[0] for part in _PARTS if part in bare)


def merge_adapter(network: "PrismaticNetwork", adapter: Adapter) -> None:
    """Add the adapter to the network's weights, in place.

    Raises WeightsError unless every factor has its place in the network and every place its factors.
    """
    peft = require("peft", "openvla")
    modules = adapter.modules()
    if unknown := sorted(modules - {name for name, _ in network.named_modules()}):
        raise WeightsError(
            f"the LoRA adapter in {adapter.folder} changes {', '.join(unknown[:8])}, which the model does not "
            "have; it belongs to another model"
        )
    config = peft.PeftConfig.from_pretrained(str(adapter.folder))
    # The file says which modules it changes; "all-linear" and patterns would be resolved by peft's own rules.
    config.target_modules, config.modules_to_save, config.task_type = modules, None, None
    config.inference_mode, config.base_model_name_or_path = True, None
    wrapped = peft.get_peft_model(network, config)
    expected = {name: tensor.shape for name, tensor in peft.get_peft_model_state_dict(wrapped).items()}
    found = {name: tensor.shape for name, tensor in adapter.tensors.items()}
    if wrong := sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name)):
        raise WeightsError(
            f"the LoRA adapter in {adapter.folder} does not fit the model: {len(wrong)} tensors missing, extra or "
            f"of another shape: {', '.join(wrong[:8])}"
        )
    peft.set_peft_model_state_dict(wrapped, adapter.tensors)
    wrapped.merge_and_unload()
    network.eval()
