"""LoRA adapters: their tensors, and the weights that peft merges them into."""

from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import WeightsError
from probe_kit.hooks.checkpoints.adapter_files import SCALING, AdapterFiles

_PREFIX, _COPY = "base_model.model.", "modules_to_save."
_FACTORS = (
    ".lora_A.", ".lora_B.", ".lora_embedding_A", ".lora_embedding_B", ".lora_magnitude_vector",
)  # fmt: skip


@dataclass(frozen=True)
class Adapter:
    """A LoRA adapter with its tensors, by the names that peft gave them."""

    files: AdapterFiles
    tensors: Mapping[str, Tensor]

    @property
    def folder(self) -> Path:
        """Its folder."""
        return self.files.folder

    @property
    def scaling(self) -> dict[str, Any]:
        """The settings that decide how much it adds."""
        return {name: self.files.settings[name] for name in SCALING if self.files.settings.get(name)}

    def merged(
        self, module: nn.Module, tensors: Mapping[str, Tensor], name_in_module: Callable[[str], str] = str
    ) -> dict[str, Tensor]:
        """`tensors` with the adapter in them: W + s B A in float32, rounded once to the weight's own dtype.

        module: the network that they belong to, on any device; it stays as it is. tensors: the base's, under the
        module's names. name_in_module: the module's name of a tensor in a file.
        Raises WeightsError unless every tensor of the adapter has its place in the network and every place its
        factors, and MissingExtraError without peft.
        """
        factors, copies = self._sorted()
        merged = dict(tensors)
        for name, tensor in copies.items():
            target = self._target(name, merged, name_in_module)
            if merged[target].shape != tensor.shape:
                raise WeightsError(
                    f"the LoRA adapter in {self.folder} replaces {name} of shape {tuple(merged[target].shape)} by "
                    f"{tuple(tensor.shape)}; it belongs to another model"
                )
            merged[target] = tensor.to(merged[target].dtype)
        for path, layer_factors in factors.items():
            weight = self._target(f"{path}.weight", merged, name_in_module)
            layer = module.get_submodule(weight.removesuffix(".weight"))
            bias = f"{weight.removesuffix('.weight')}.bias"
            parts = {"weight": merged[weight], **({"bias": merged[bias]} if bias in merged else {})}
            for name, tensor in self._merged_layer(path, layer, parts, layer_factors).items():
                target = weight if name == "weight" else bias
                merged[target] = tensor.to(merged[target].dtype)
        return merged

    def _sorted(self) -> tuple[dict[str, dict[str, Tensor]], dict[str, Tensor]]:
        """Low-rank factors per module, and whole tensors that replace the base's. Raises WeightsError."""
        if damaged := [name for name, tensor in self.tensors.items() if not torch.isfinite(tensor).all()]:
            raise WeightsError(f"{self.folder}: NaN or infinite tensors in the adapter: {_few(damaged)}")
        factors: dict[str, dict[str, Tensor]] = {}
        copies: dict[str, Tensor] = {}
        for name, tensor in self.tensors.items():
            bare = name.removeprefix(_PREFIX)
            if (part := next((part for part in _FACTORS if part in bare), None)) is not None:
                factors.setdefault(bare.partition(part)[0], {})[name] = tensor
            else:
                copies[bare.replace(_COPY, "").replace(".default.", ".")] = tensor
        replaced = tuple(self.files.settings.get("modules_to_save") or ())
        biases = self.files.settings.get("bias", "none") != "none"
        strange = [name for name in copies if not (_inside(name, replaced) or (biases and name.endswith(".bias")))]
        if strange or not self.tensors:
            raise WeightsError(
                f"{self.folder} holds something else than low-rank factors: {_few(strange) or 'no tensors'}. "
                "Merge it with the tool that made it, and pass the merged folder"
            )
        if lost := [module for module in replaced if not any(_inside(name, (module,)) for name in copies)]:
            raise WeightsError(
                f"{self.folder} has no tensors of {_few(lost)}, which its modules_to_save name. Download the "
                "adapter again"
            )
        return factors, copies

    def _target(self, name: str, tensors: Mapping[str, Tensor], name_in_module: Callable[[str], str]) -> str:
        """The network's name of a weight that the adapter changes."""
        for candidate in (name, name_in_module(name)):
            if candidate in tensors:
                return candidate
        raise WeightsError(
            f"the LoRA adapter in {self.folder} changes {name}, which the model does not have; it belongs to "
            "another model"
        )

    def _merged_layer(
        self, path: str, layer: nn.Module, parts: Mapping[str, Tensor], factors: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Weight and bias of one layer after peft merged its factors, float32."""
        peft: Any = require("peft", "lora")
        twin = deepcopy(layer).to_empty(device="cpu").float()
        twin.load_state_dict({name: tensor.float() for name, tensor in parts.items()})
        tree, (*parents, last) = nn.Module(), path.split(".")
        inner = tree
        for parent in parents:
            inner.add_module(parent, nn.Module())
            inner = inner.get_submodule(parent)
        inner.add_module(last, twin)
        # The tensors say which modules change; "all-linear" and patterns would be resolved by peft's own rules.
        config = peft.LoraConfig(target_modules=[path], bias="none", inference_mode=True, **self.scaling)
        try:
            wrapped = peft.get_peft_model(tree, config)
        except (ValueError, TypeError) as error:
            raise WeightsError(f"the LoRA adapter in {self.folder} cannot be merged at {path}: {error}") from error
        placed = peft.get_peft_model_state_dict(wrapped, save_embedding_layers=False)
        expected = {name: tensor.shape for name, tensor in placed.items()}
        shapes = {name: tensor.shape for name, tensor in factors.items()}
        if wrong := sorted(
            name for name in expected.keys() | shapes.keys() if expected.get(name) != shapes.get(name)
        ):
            raise WeightsError(
                f"the LoRA adapter in {self.folder} does not fit the model: tensors missing, extra or of another "
                f"shape: {_few(wrong)}"
            )
        peft.set_peft_model_state_dict(wrapped, {name: tensor.float() for name, tensor in factors.items()})
        return dict(wrapped.merge_and_unload().get_submodule(path).state_dict())


def _inside(name: str, modules: Iterable[str]) -> bool:
    """Whether a tensor belongs to one of these modules, which may be named by the end of their path."""
    return any(f".{module}." in f".{name}" for module in modules)


def _few(names: list[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
