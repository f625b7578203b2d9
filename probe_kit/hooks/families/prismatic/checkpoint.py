"""Loading of Prismatic and OpenVLA checkpoints: plain folders, LoRA adapters, random weights."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import PATTERNS, RUN_WEIGHTS, checkpoint_folder, chosen_dtype
from probe_kit.hooks.checkpoints.weights import Weights, WeightsAudit, load_weights, read_weights
from probe_kit.hooks.families.prismatic.lora import ADAPTER_CONFIG, Adapter, merge_adapter
from probe_kit.hooks.families.prismatic.quantised import check_quantisation, quantise
from probe_kit.hooks.families.prismatic.release import read_release
from probe_kit.models.initialisation import initialise
from probe_kit.models.prismatic import PrismaticConfig, PrismaticNetwork, build_prismatic

STATISTICS_FILE = "dataset_statistics.json"
FILES = (*PATTERNS, RUN_WEIGHTS)
"""What is needed of a hub repository, or of the folder of one model of it."""
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
# Files of OpenVLA-OFT: its actions come from heads that its language model's checkpoint does not name.
_OTHER_HEADS = ("action_head--*", "proprio_projector--*", "noisy_action_projector--*", "vision_backbone--*")


@dataclass(frozen=True)
class LoadedPrismatic:
    """A loaded network and what belongs to it.

    checkpoint: as asked for. folders: where its other files may lie, an adapter's own before that of its base.
    statistics: per data set, what un-normalises its actions. dtype: of the weights, as the card says it. text: the
    folder of a tokenizer that does not come with the checkpoint.
    """

    checkpoint: str
    network: PrismaticNetwork
    config: PrismaticConfig
    folders: tuple[Path, ...]
    statistics: Mapping[str, Any]
    audit: WeightsAudit
    dtype: str
    device: str
    exact: bool
    notes: tuple[str, ...]
    weights_seed: int | None = None
    text: Path | None = None

    @property
    def text_folders(self) -> tuple[Path, ...]:
        """Where the tokenizer may lie."""
        return self.folders if self.text is None else (*self.folders, self.text)


def checkpoint_folders(checkpoint: str, files: Sequence[str] = FILES) -> tuple[Path, ...]:
    """Where the files of a checkpoint may lie: an adapter's own folder before that of its base."""
    folder = checkpoint_folder(checkpoint, files)
    if not (folder / ADAPTER_CONFIG).is_file():
        return (folder,)
    return folder, Adapter.read(folder).base_folder()


def load_checkpoint(
    checkpoint: str,
    device: str,
    dtype: str | None,
    random_weights: bool,
    bits: int | None = None,
    weights_seed: int = 0,
) -> LoadedPrismatic:
    """Load a folder or hub id, which may hold a LoRA adapter that names its base, or a training run's files.

    dtype: float32 or bfloat16; default what the checkpoint says. bits: quantise the language model after the
    audit. Raises CheckpointError, WeightsError, UsageError for another dtype, MissingExtraError.
    """
    if bits is not None:
        check_quantisation(bits, device)
    folder = checkpoint_folder(checkpoint, FILES)
    adapter = Adapter.read(folder) if (folder / ADAPTER_CONFIG).is_file() else None
    base = folder if adapter is None else adapter.base_folder()
    _check_other_heads((folder, base))
    config = PrismaticConfig.from_folder(base)
    name = chosen_dtype(dtype, config.dtype, _DTYPES)
    if random_weights:
        network, audit = _random(config, _DTYPES[name], checkpoint, weights_seed)
    else:
        network, audit = _stored(config, base, _DTYPES[name], adapter)
    network.requires_grad_(False)
    notes: tuple[str, ...] = () if adapter is None else (f"LoRA adapter merged into {base}",)
    if bits is not None:
        quantise(network, bits)
        notes += (f"not exact: language model in {bits} bits",)
    folders = tuple(dict.fromkeys((folder, base)))
    return LoadedPrismatic(
        checkpoint=checkpoint,
        network=network.to(device),
        config=config,
        folders=folders,
        statistics=_statistics(config, folders),
        audit=audit,
        dtype=name if bits is None else f"{name}, {bits}-bit",
        device=device,
        exact=bits is None,
        notes=notes,
        weights_seed=weights_seed if random_weights else None,
    )


def _check_other_heads(folders: tuple[Path, ...]) -> None:
    for folder in folders:
        for pattern in _OTHER_HEADS:
            if found := sorted(folder.glob(pattern)):
                raise CheckpointError(
                    f"{found[0]} belongs to OpenVLA-OFT, which does not decode its actions as tokens: "
                    "running it as OpenVLA would give other actions than its authors'"
                )


def _random(
    config: PrismaticConfig, dtype: torch.dtype, checkpoint: str, seed: int
) -> tuple[PrismaticNetwork, WeightsAudit]:
    network = build_prismatic(config, dtype, device="cpu")
    initialise(network, seed)
    weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
    return network, load_weights(network, weights, weights.tensors)


def _stored(
    config: PrismaticConfig, folder: Path, dtype: torch.dtype, adapter: Adapter | None
) -> tuple[PrismaticNetwork, WeightsAudit]:
    released = folder / RUN_WEIGHTS
    weights = read_release(released, config) if released.is_file() else read_weights(folder)
    network = build_prismatic(config, dtype)
    tied = {"language_model.lm_head.weight"} if config.text.tie_word_embeddings else set()
    named = weights if adapter is None else Weights(
        {**weights.tensors, **adapter.tensors}, f"{folder} and {adapter.folder}", weights.random
    )  # fmt: skip
    audit = load_weights(network, named, _as_dtype(weights.tensors, dtype), tied, assign=True)
    if tied:
        network.language_model.tie_weights()
    if empty := [name for name, tensor in network.state_dict().items() if tensor.is_meta]:
        raise WeightsError(f"weights in {folder}: {len(empty)} tensors were never filled: {', '.join(empty[:8])}")
    if adapter is not None:
        merge_adapter(network, adapter)
    return network, audit


def _as_dtype(tensors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {name: t.to(dtype) if t.is_floating_point() else t for name, t in tensors.items()}


def _statistics(config: PrismaticConfig, folders: tuple[Path, ...]) -> dict[str, Any]:
    """Those of the config, and above them what fine-tuning wrote beside the weights."""
    found = dict(config.statistics)
    for folder in reversed(folders):
        if (folder / STATISTICS_FILE).is_file():
            found |= json.loads((folder / STATISTICS_FILE).read_text(encoding="utf-8"))
    return found
