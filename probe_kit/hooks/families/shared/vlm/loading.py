"""Loading of a vision-language model: configuration, renamed weights, random weights."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.errors import StrictDataclassError

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.families.shared.network_loading import Loaded, load_network
from probe_kit.models.building import without_precision
from probe_kit.models.naming import Renames, renamed

Build = Callable[[Any, torch.dtype, str], Any]
# What Python, torch and transformers raise for numbers and names in a configuration that cannot be. Many kinds,
# because nothing checks a configuration before its numbers reach the layers.
_OF_VALUES = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, AssertionError)


@dataclass(frozen=True)
class Recipe:
    """The way from the files of a checkpoint to a family's network.

    config: of the values of config.json. build: an empty network of a configuration, dtype and device.
    names: from tensors in files to those of the network.
    """

    config: Callable[[Mapping[str, Any]], Any]
    build: Build
    names: Renames = ()


def load_vlm(
    recipe: Recipe,
    checkpoint: str | None,
    device: str,
    dtype: str | None,
    random_weights: bool,
    weights_seed: int,
) -> Loaded[Any]:
    """The network of a checkpoint with exactly the weights of its files, or its random twin.

    Raises UsageError without a checkpoint, CheckpointError for a configuration that describes no such network, and
    WeightsError for weights that are not exactly the network's.
    """
    if checkpoint is None:
        raise UsageError("name a folder or hub id as --checkpoint")
    folder = checkpoint_folder(checkpoint)
    file = folder / CONFIG_FILE
    with _describing(file):
        config = recipe.config(without_precision(load_json(file)))

    def build(kind: torch.dtype, device: str) -> Any:
        with _describing(file):
            return recipe.build(config, kind, device)

    return load_network(
        build,
        lambda: read_weights(folder),
        checkpoint,
        folder,
        device,
        dtype,
        random_weights,
        weights_seed,
        name_in_module=lambda name: renamed(name, recipe.names),
    )


@contextmanager
def _describing(file: Path) -> Iterator[None]:
    """Whatever goes wrong inside is because of what a configuration says. Raises CheckpointError."""
    try:
        yield
    except (*_OF_VALUES, StrictDataclassError, OSError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(
            f"{file} describes no network of this family ({type(error).__name__}: {reason}); download it "
            "again, or pass the right --model"
        ) from error
