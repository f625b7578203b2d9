"""Loading of SpatialVLA checkpoints: released ones, fine-tunes in the same layout, random weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.families.shared.network_loading import DTYPES, Loaded, load_network
from probe_kit.models.spatialvla import SpatialVLAConfig, SpatialVLANetwork, build_spatialvla

PROCESSOR_FILE = "processor_config.json"


@dataclass(frozen=True, kw_only=True)
class LoadedSpatialVLA(Loaded[SpatialVLANetwork]):
    """A loaded network. processor: the content of `processor_config.json`: bins, statistics, cameras."""

    processor: Mapping[str, Any]

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
    processor = read_processor(folder)
    loaded = load_network(
        partial(build_spatialvla, config),
        lambda: read_weights(folder),
        checkpoint,
        folder,
        device,
        chosen_dtype(dtype, config.dtype, DTYPES),
        random_weights,
        weights_seed,
        finish=lambda network: network.embed_actions(),
    )
    return LoadedSpatialVLA(**vars(loaded), processor=processor)


def read_processor(folder: Path) -> dict[str, Any]:
    """The content of `processor_config.json`. Raises CheckpointError if it is missing."""
    file = folder / PROCESSOR_FILE
    if not file.is_file():
        raise CheckpointError(
            f"{file} is missing: it holds the action bins, statistics and cameras. Copy it from the model's page"
        )
    return dict(load_json(file))
