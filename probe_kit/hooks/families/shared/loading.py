"""Loading of a network: configuration, renamed weights, random weights, and the card."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import UsageError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, chosen_dtype, content_hashes, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, WeightsAudit, doubles, load_weights, read_weights
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.models.building import initialise, without_precision
from probe_kit.models.checkpoint_files import Renames, describe_picture_conflict, rename_tensor, renamed_tensors

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Loaded[Network: nn.Module]:
    """A network with its weights, what loading proved, and where it is from.

    Attributes:
        dtype: The dtype of the weights, as the card has it.
        checkpoint: The folder or hub id as it was requested.
        folder: The folder of the checkpoint's other files.
        weights_seed: Seed of random weights; None for weights from a file.
        notes: The first notes of the card.
        exact: As `ModelCard.exact`.
        adapter: The folder of a LoRA adapter, whose files count before those of `folder`; None for none.
    """

    network: Network
    audit: WeightsAudit
    dtype: str
    device: str
    checkpoint: str
    folder: Path
    weights_seed: int | None = None
    notes: tuple[str, ...] = ()
    exact: bool = True
    adapter: Path | None = None

    @property
    def folders(self) -> tuple[Path, ...]:
        """The folders that may hold its other files."""
        return (self.folder,) if self.adapter is None else (self.adapter, self.folder)

    def card(
        self,
        family: str,
        settings: Mapping[str, str],
        *,
        files: Mapping[str, Path] | None = None,
        tokenizer: str | Path | None = None,
        notes: Iterable[str] = (),
        **fields: Any,
    ) -> ModelCard:
        """The card of the model; its settings begin with the content of every file that is read.

        Args:
            family: Name of the family.
            settings: Further settings, which follow those of the files.
            files: The files besides the weights, by name; None takes those of the folder.
            tokenizer: A folder whose files are read too, where it is another one, or a name; None for the
                checkpoint's.
            notes: Notes behind those of loading.
            **fields: Further fields of `ModelCard`.
        """
        read = side_files(self.folder) if files is None else dict(files)
        conflict = describe_picture_conflict(self.folder)
        if tokenizer is not None and (other := Path(tokenizer).expanduser()) != self.folder and other.is_dir():
            read |= side_files(other, "tokenizer/")
        return ModelCard(
            family=family,
            checkpoint=self.checkpoint,
            weights_sha256=self.audit.sha256,
            random_weights=self.audit.random,
            parameters=self.audit.parameters,
            dtype=self.dtype,
            device=self.device,
            notes=(*self.notes, *notes, *filter(None, [conflict])),
            audit=self.audit.to_json(),
            settings={**content_hashes(read), **settings},
            exact=self.exact,
            weights_seed=self.weights_seed,
            **fields,
        )


def _nothing(_: object) -> None:
    """Do nothing with a network."""


def load_network[Network: nn.Module](
    build: Callable[[torch.dtype, str], Network],
    read: Callable[[], Weights],
    checkpoint: str,
    folder: Path,
    device: str,
    dtype: str | None,
    random_weights: bool,
    weights_seed: int,
    *,
    name_in_module: Callable[[str], str] = str,
    tensors_of: Callable[[Weights], Mapping[str, Tensor]] | None = None,
    draw: Callable[[Network, int], object] = initialise,
    finish: Callable[[Network], object] = _nothing,
) -> Loaded[Network]:
    """Load the network that `build(dtype, device)` makes, with exactly the weights of `read()` or random ones.

    A file may leave out parameters that are another one's double, such as tied output weights.

    Args:
        build: Makes an empty network of a dtype on a device, which may be `meta`.
        read: Reads the weights; not called for random ones.
        checkpoint: The folder or hub id as it was requested.
        folder: The folder of the checkpoint's files.
        device: The device to which the network goes.
        dtype: float32 or bfloat16; None takes that of the tensors in the file, float32 for random weights.
        random_weights: Whether the weights are drawn instead of read.
        weights_seed: Seed of random weights.
        name_in_module: The network's name of a tensor in the file.
        tensors_of: Gives the tensors under the network's names, where other names are not all that differs.
        draw: Draws random weights of a seed.
        finish: Called with the whole network, before it goes to the device.

    Raises:
        UsageError: For another dtype.
        WeightsError: For weights that are not exactly the network's.
    """
    if random_weights:
        name = chosen_dtype(dtype, None, DTYPES)
        network = build(DTYPES[name], "cpu")
        draw(network, weights_seed)
        weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
        audit = load_weights(network, weights, weights.tensors)
    else:
        weights = read()
        name = chosen_dtype(dtype, _stored_dtype(weights), DTYPES)
        # On the meta device, without memory: a parameter that no file fills stays empty and is found, and large
        # models are not held twice.
        network = build(DTYPES[name], "meta")
        tensors = (
            renamed_tensors(weights.tensors, name_in_module, weights.source)
            if tensors_of is None
            else tensors_of(weights)
        )
        owned = as_dtype(tensors, DTYPES[name], in_memory=torch.device(device).type == "cpu")
        audit = assign_weights(network, weights, owned, name_in_module)
    network.requires_grad_(False)  # a gradient is asked for at activations only
    finish(network)
    seed = weights_seed if random_weights else None
    notes = (audit.adapter,) if audit.adapter else ()
    return Loaded(network.to(device), audit, name, device, checkpoint, folder, seed, notes)


def assign_weights(
    network: nn.Module,
    weights: Weights,
    tensors: Mapping[str, Tensor],
    name_in_module: Callable[[str], str],
) -> WeightsAudit:
    """Make `tensors` the parameters of a network on the meta device, and tie doubles again.

    Args:
        network: The network on the meta device.
        weights: The files, which give the audit its hash.
        tensors: The content of the files under the network's names.
        name_in_module: The network's name of a tensor in the file.

    Raises:
        WeightsError: For a double with other numbers and for tensors without memory, and what `load_weights`
            raises.
    """
    tied = doubles(network)
    for double, original in tied.items():
        if double in tensors and original in tensors and not torch.equal(tensors[double], tensors[original]):
            raise WeightsError(
                f"{weights.source}: {double} differs from the tensor that config.json ties it to "
                "(tie_word_embeddings); one of the two files is another model's"
            )
    audit = load_weights(network, weights, tensors, tied, assign=True, name_in_module=name_in_module)
    for double, original in tied.items():
        weight, loaded = network.get_parameter(original), network.get_parameter(double)
        if loaded.is_meta or torch.equal(loaded, weight):  # an adapter may have set the two apart
            module, _, name = double.rpartition(".")
            setattr(network.get_submodule(module), name, weight)
    _check_filled(network, weights.source)
    return audit


def as_dtype(tensors: Mapping[str, Tensor], dtype: torch.dtype, in_memory: bool) -> dict[str, Tensor]:
    """Return the tensors, those of real numbers in `dtype`.

    Args:
        tensors: The tensors by name; of a safetensors file they are a map of that file.
        dtype: The dtype of real numbers; others keep theirs.
        in_memory: Whether every tensor gets memory of its own. Parameters that are a map of their file change with
            it, when a newer checkpoint is copied over it. A network that goes to another device is copied anyway.
    """
    return {
        name: value.to(dtype if value.is_floating_point() else value.dtype, copy=in_memory)
        for name, value in tensors.items()
    }


def _check_filled(network: nn.Module, source: str) -> None:
    """Raise WeightsError for tensors and buffers without memory."""
    every = {**network.state_dict(), **dict(network.named_buffers())}
    if empty := [name for name, tensor in every.items() if tensor.is_meta]:
        raise WeightsError(f"{source}: {len(empty)} tensors were never filled: {', '.join(empty[:8])}")


def _stored_dtype(weights: Weights) -> str:
    """Return `bfloat16` if every floating tensor of the file has it, else `float32`: no unasked rounding."""
    kinds = {tensor.dtype for tensor in weights.tensors.values() if tensor.is_floating_point()}
    return "bfloat16" if kinds == {torch.bfloat16} else "float32"


# -- vision-language models -----------------------------------------------------------------------------------

Build = Callable[[Any, torch.dtype, str], Any]
_OTHER_MODEL = "It describes no network of this family: download it again, or pass the right --model"


@dataclass(frozen=True)
class Recipe:
    """The way from the files of a checkpoint to a family's network.

    Attributes:
        config: Makes the configuration from the values of config.json.
        build: Makes an empty network of a configuration, dtype and device.
        names: The renames from tensors in files to those of the network.
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

    Raises:
        UsageError: Without a checkpoint.
        CheckpointError: For a configuration that describes no such network.
        WeightsError: For weights that are not exactly the network's.
    """
    if checkpoint is None:
        raise UsageError("name a folder or hub id as --checkpoint")
    folder = checkpoint_folder(checkpoint)
    file = folder / CONFIG_FILE
    with while_reading(file, advice=_OTHER_MODEL):
        config = recipe.config(without_precision(load_json(file)))

    def build(kind: torch.dtype, device: str) -> Any:
        with while_reading(file, advice=_OTHER_MODEL):
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
        name_in_module=lambda name: rename_tensor(name, recipe.names),
    )
