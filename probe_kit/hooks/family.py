"""A model family by name: what it is, how it is loaded, verified and asked for. Imports no torch."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from probe_kit.errors import UsageError
from probe_kit.hooks.options import Option, check_options

if TYPE_CHECKING:
    from probe_kit.hooks.model import Model

DTYPES = ("float32", "bfloat16")


@dataclass(frozen=True)
class Family:
    """A model family by name.

    default_checkpoint: hub id, or None for the embedded one. streams: layers and iterations at full size.
    loader, verifier, full_size: `module:function`, imported only when used. loader(checkpoint, device, dtype,
    random_weights) gives a Model, and takes `weights_seed` if its random twins can differ; verifier(folder,
    recorded arrays) gives comparisons; full_size() gives the network of the released size on the meta device.
    options: what else the loader takes as keyword arguments. acts, reads: whether it is a Policy, a Reader.
    hub: what the default checkpoint is loaded from, hub ids with a file each whose presence tells; default its
    config.json. packages: modules of an extra that it needs, with the name of that extra.
    unstored: tensors of a checkpoint that the network does not have, by name or prefix ending in a dot;
    `verify --keys` prints them.
    Raises UsageError if an option is not declared as an `Option`.
    """

    name: str
    description: str
    default_checkpoint: str | None
    loader: str
    streams: str = ""
    embodiment: str = "7-DoF end-effector delta"
    notes: str = ""
    verifier: str | None = None
    full_size: str | None = None
    options: tuple[Option, ...] = ()
    acts: bool = True
    reads: bool = False
    unstored: tuple[str, ...] = ()
    hub: tuple[tuple[str, str], ...] = ()
    packages: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        for option in self.options:
            if not isinstance(option, Option):
                raise UsageError(
                    f"the family {self.name} declares its option as {option!r}; since 0.3 options have a type and "
                    f"help: Option({str(option)!r}, str, 'what it does') from probe_kit.hooks"
                )

    def load(
        self,
        checkpoint: str | None,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        options: Mapping[str, Any] = MappingProxyType({}),
        weights_seed: int = 0,
    ) -> "Model":
        """Load a model; `checkpoint` None means the default one.

        options: by name, as text or values. weights_seed: of a random twin's weights.
        Raises UsageError for an option it lacks, and for a device, dtype or seed that cannot be used.
        """
        chosen = check_options(self.name, self.options, options)
        if weights_seed and not random_weights:
            raise UsageError("weights_seed belongs to a random twin; ask for random weights too, or leave it out")
        check_machine(device, dtype)
        load = imported(self.loader)
        if weights_seed:
            if "weights_seed" not in inspect.signature(load).parameters:
                raise UsageError(f"{self.name} has one random twin only: its loader takes no weights_seed")
            chosen["weights_seed"] = weights_seed
        model: Model = load(checkpoint or self.default_checkpoint, device, dtype, random_weights, **chosen)
        # What an adapter does not say of its options itself is part of the identity all the same.
        said = {name: str(value) for name, value in chosen.items() if name != "weights_seed"}
        model.card = replace(model.card, settings={**said, **model.card.settings})
        return model

    def function(self, purpose: Literal["verifier", "full_size"]) -> Callable[..., Any]:
        """The family's function for `purpose`. Raises UsageError if it has none."""
        path = getattr(self, purpose)
        if path is None:
            raise UsageError(f"{self.name} has no {purpose.replace('_', '-')}; it cannot be verified this way")
        return imported(path)

    def missing(self) -> str:
        """What this machine lacks to load the default checkpoint; empty if it is ready."""
        from huggingface_hub import try_to_load_from_cache

        files = self.hub
        if self.default_checkpoint is not None and self.default_checkpoint not in dict(files):
            files = ((self.default_checkpoint, "config.json"), *files)
        absent = [name for name, file in files if not isinstance(try_to_load_from_cache(name, file), str)]
        lacking = [f"extra {extra}" for module, extra in self.packages if find_spec(module) is None]
        if absent:
            lacking.append(f"download of {', '.join(absent)}")
        return " and ".join(lacking)


def check_machine(device: str, dtype: str | None) -> None:
    """Raise UsageError for a dtype that is not offered or a device that this machine does not have."""
    import torch

    if dtype not in (None, *DTYPES):
        raise UsageError(f"dtype is {dtype!r}; expected one of {', '.join(DTYPES)}")
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # what torch raises: unknown, absent
        reason = str(error).partition("\n")[0]
        raise UsageError(f"device {device!r} cannot be used: {reason}. Try 'cpu'") from error


def imported(path: str) -> Callable[..., Any]:
    """The function that `module:function` names."""
    module, function = path.split(":")
    found: Callable[..., Any] = getattr(import_module(module), function)
    return found
