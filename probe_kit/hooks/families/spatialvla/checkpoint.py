"""Loading of SpatialVLA checkpoints: released ones, fine-tunes in the same layout, random weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import WeightsAudit, load_weights, read_weights
from probe_kit.hooks.families.shared.network_loading import DTYPES, as_dtype, audit_of_twin
from probe_kit.models.initialisation import initialise
from probe_kit.models.spatialvla import SpatialVLAConfig, SpatialVLANetwork, build_spatialvla

PROCESSOR_FILE = "processor_config.json"


@dataclass(frozen=True)
class LoadedSpatialVLA:
    """A loaded network and what belongs to it.

    checkpoint: as asked for. processor: the content of `processor_config.json`: bins, statistics, cameras.
    dtype: of the weights, as the card says it. weights_seed: of a random twin.
    """

    checkpoint: str
    network: SpatialVLANetwork
    folder: Path
    processor: Mapping[str, Any]
    audit: WeightsAudit
    dtype: str
    device: str
    weights_seed: int | None

    @property
    def config(self) -> SpatialVLAConfig:
        """The network's."""
        return self.network.config

    @property
    def processor_file(self) -> str:
        """The file named by errors about bins, statistics and cameras."""
        return str(self.folder / PROCESSOR_FILE)

    @property
    def chunk(self) -> int:
        """Steps that one inference plans. Raises CheckpointError for none."""
        steps = int(self.processor.get("action_chunk_size", 1))
        if steps < 1:
            raise CheckpointError(f"{self.processor_file}: action_chunk_size is {steps}; expected at least 1")
        return steps


def load_checkpoint(
    checkpoint: str, device: str, dtype: str | None, random_weights: bool, weights_seed: int = 0
) -> LoadedSpatialVLA:
    """Load a folder or hub id.

    dtype: float32 or bfloat16; default what the checkpoint says. Raises CheckpointError, WeightsError, UsageError
    for another dtype.
    """
    folder = checkpoint_folder(checkpoint)
    config = SpatialVLAConfig.from_folder(folder)
    name = chosen_dtype(dtype, config.dtype, DTYPES)
    processor = read_processor(folder)
    if random_weights:
        network, audit = _random(config, DTYPES[name], checkpoint, weights_seed)
    else:
        network, audit = _stored(config, DTYPES[name], folder)
    network.requires_grad_(False)
    network.embed_actions()
    return LoadedSpatialVLA(
        checkpoint=checkpoint,
        network=network.to(device),
        folder=folder,
        processor=processor,
        audit=audit,
        dtype=name,
        device=device,
        weights_seed=weights_seed if random_weights else None,
    )


def read_processor(folder: Path) -> dict[str, Any]:
    """The content of `processor_config.json`. Raises CheckpointError if it is missing."""
    file = folder / PROCESSOR_FILE
    if not file.is_file():
        raise CheckpointError(
            f"{file} is missing: it holds the action bins, statistics and cameras. Copy it from the model's page"
        )
    return dict(load_json(file))


def _random(
    config: SpatialVLAConfig, dtype: torch.dtype, checkpoint: str, seed: int
) -> tuple[SpatialVLANetwork, WeightsAudit]:
    network = build_spatialvla(config, dtype, device="cpu")
    initialise(network, seed)
    return network, audit_of_twin(network, checkpoint)


def _stored(config: SpatialVLAConfig, dtype: torch.dtype, folder: Path) -> tuple[SpatialVLANetwork, WeightsAudit]:
    weights = read_weights(folder)
    network = build_spatialvla(config, dtype)
    return network, load_weights(network, weights, as_dtype(weights.tensors, dtype), assign=True)
