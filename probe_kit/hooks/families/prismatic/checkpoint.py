"""Loading of Prismatic and OpenVLA checkpoints: plain folders, LoRA adapters, random weights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.adapter_files import AdapterFiles, adapter_in
from probe_kit.hooks.checkpoints.checkpoint import PATTERNS, RUN_WEIGHTS, chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import WeightsAudit, read_weights, with_adapter
from probe_kit.hooks.families.prismatic.quantised import check_quantisation, quantise
from probe_kit.hooks.families.prismatic.release import read_release
from probe_kit.hooks.families.shared.network_loading import DTYPES, as_dtype, assign_weights, audit_of_twin
from probe_kit.models.initialisation import initialise
from probe_kit.models.prismatic import PrismaticConfig, PrismaticNetwork, build_prismatic
from probe_kit.models.statistics_choice import stored_statistics

FILES = (*PATTERNS, RUN_WEIGHTS)
"""What is needed of a hub repository, or of the folder of one model of it."""
# Files of OpenVLA-OFT: its actions come from heads that its language model's checkpoint does not name.
_OTHER_HEADS = ("action_head--*", "proprio_projector--*", "noisy_action_projector--*", "vision_backbone--*")


@dataclass(frozen=True)
class LoadedPrismatic:
    """A loaded network and what belongs to it.

    checkpoint: as asked for. folders: where its other files may lie, an adapter's own before that of its base.
    statistics: per data set, what un-normalises its actions. statistics_source: the file that holds them.
    dtype: of the weights, as the card says it. text: the
    folder of a tokenizer that does not come with the checkpoint.
    """

    checkpoint: str
    network: PrismaticNetwork
    config: PrismaticConfig
    folders: tuple[Path, ...]
    statistics: Mapping[str, Any]
    statistics_source: str
    audit: WeightsAudit
    dtype: str
    device: str
    exact: bool
    notes: tuple[str, ...]
    weights_seed: int | None = None
    text: Path | None = None

    @property
    def text_folders(self) -> tuple[Path, ...]:
        """The folders that may hold the tokenizer."""
        return self.folders if self.text is None else (*self.folders, self.text)


def checkpoint_folders(checkpoint: str, files: Sequence[str] = FILES) -> tuple[Path, ...]:
    """The folders that may hold a checkpoint's files: an adapter's own before that of its base."""
    folder = checkpoint_folder(checkpoint, files)
    adapter = adapter_in(folder)
    return (folder,) if adapter is None else tuple(dict.fromkeys((folder, adapter.base_folder(files))))


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
    adapter = adapter_in(folder)
    base = folder if adapter is None else adapter.base_folder()
    _check_other_heads((folder, base))
    config = PrismaticConfig.from_folder(base)
    name = chosen_dtype(dtype, config.dtype, DTYPES)
    if random_weights:
        network, audit = _random(config, DTYPES[name], checkpoint, weights_seed)
    else:
        network, audit = _stored(config, base, DTYPES[name], adapter)
    network.requires_grad_(False)
    notes: tuple[str, ...] = (audit.adapter,) if audit.adapter else ()
    if bits is not None:
        quantise(network, bits)
        notes += (f"not exact: language model in {bits} bits",)
    folders = tuple(dict.fromkeys((folder, base)))
    statistics, statistics_source = prismatic_statistics(config, folders)
    return LoadedPrismatic(
        checkpoint=checkpoint,
        network=network.to(device),
        config=config,
        folders=folders,
        statistics=statistics,
        statistics_source=statistics_source,
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
            if files := sorted(folder.glob(pattern)):
                raise CheckpointError(
                    f"{files[0]} belongs to OpenVLA-OFT, which does not decode its actions as tokens: "
                    "running it as OpenVLA would give other actions than its authors'"
                )


def _random(
    config: PrismaticConfig, dtype: torch.dtype, checkpoint: str, seed: int
) -> tuple[PrismaticNetwork, WeightsAudit]:
    network = build_prismatic(config, dtype, device="cpu")
    initialise(network, seed)
    return network, audit_of_twin(network, checkpoint)


def _stored(
    config: PrismaticConfig, folder: Path, dtype: torch.dtype, adapter: AdapterFiles | None
) -> tuple[PrismaticNetwork, WeightsAudit]:
    released = folder / RUN_WEIGHTS
    weights = read_release(released, config) if released.is_file() else read_weights(folder)
    if adapter is not None and weights.adapter is None:
        weights = with_adapter(weights, adapter)
    network = build_prismatic(config, dtype)
    tied = {"language_model.lm_head.weight"} if config.text.tie_word_embeddings else set()
    audit = assign_weights(
        network, weights, as_dtype(weights.tensors, dtype), tied, network.language_model.tie_weights
    )
    return network, audit


def prismatic_statistics(config: PrismaticConfig, folders: tuple[Path, ...]) -> tuple[Mapping[str, Any], str]:
    """The statistics beside the weights, or else those of the base's config; see `stored_statistics`."""
    return stored_statistics(folders, config.statistics, f"config.json in {folders[-1]}")
