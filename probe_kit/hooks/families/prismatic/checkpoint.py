"""Loading of Prismatic and OpenVLA checkpoints: plain folders, LoRA adapters, random weights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.adapter_files import AdapterFiles, adapter_in
from probe_kit.hooks.checkpoints.checkpoint import PATTERNS, RUN_WEIGHTS, chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, read_weights, with_adapter
from probe_kit.hooks.families.prismatic.quantised import check_quantisation, quantise
from probe_kit.hooks.families.prismatic.release import read_release
from probe_kit.hooks.families.shared.network_loading import DTYPES, Loaded, load_network
from probe_kit.models.prismatic import PrismaticConfig, PrismaticNetwork, build_prismatic
from probe_kit.models.statistics_choice import stored_statistics

FILES = (*PATTERNS, RUN_WEIGHTS)
"""What is needed of a hub repository, or of the folder of one model of it."""
# Files of OpenVLA-OFT: its actions come from heads that its language model's checkpoint does not name.
_OTHER_HEADS = ("action_head--*", "proprio_projector--*", "noisy_action_projector--*", "vision_backbone--*")


@dataclass(frozen=True, kw_only=True)
class LoadedPrismatic(Loaded[PrismaticNetwork]):
    """A loaded network and what belongs to it.

    folders: where its other files may lie, an adapter's own before that of its base. text: the folder of a
    tokenizer that does not come with the checkpoint.
    """

    folders: tuple[Path, ...]
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
    loaded = load_network(
        partial(build_prismatic, config),
        lambda: _read(config, base, adapter),
        checkpoint,
        base,
        device,
        chosen_dtype(dtype, config.dtype, DTYPES),
        random_weights,
        weights_seed,
        finish=lambda network: None if bits is None else quantise(network, bits),
    )
    folders = tuple(dict.fromkeys((folder, base)))
    if bits is not None:
        notes = (
            *loaded.notes,
            f"not exact: language model in {bits} bits",
        )
        loaded = replace(loaded, dtype=f"{loaded.dtype}, {bits}-bit", exact=False, notes=notes)
    return LoadedPrismatic(**vars(loaded), folders=folders)


def _check_other_heads(folders: tuple[Path, ...]) -> None:
    for folder in folders:
        for pattern in _OTHER_HEADS:
            if files := sorted(folder.glob(pattern)):
                raise CheckpointError(
                    f"{files[0]} belongs to OpenVLA-OFT, which does not decode its actions as tokens: "
                    "running it as OpenVLA would give other actions than its authors'"
                )


def _read(config: PrismaticConfig, folder: Path, adapter: AdapterFiles | None) -> Weights:
    released = folder / RUN_WEIGHTS
    weights = read_release(released, config) if released.is_file() else read_weights(folder)
    return weights if adapter is None or weights.adapter is not None else with_adapter(weights, adapter)


def prismatic_statistics(config: PrismaticConfig, folders: tuple[Path, ...]) -> tuple[Mapping[str, Any], str]:
    """The statistics beside the weights, or else those of the base's config; see `stored_statistics`."""
    return stored_statistics(folders, config.statistics, f"config.json in {folders[-1]}")
