"""The registry of model families: those of probe_kit, and third-party ones from entry points.

A third party's module is imported only when its family is named: it may import torch, or fail.

A family of ours is a folder in `families/` whose package lists its `FAMILIES`, and its name in `FOLDERS`.
"""

import warnings
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any

from probe_kit._system.imports import entry_points
from probe_kit._system.machine import AUTO
from probe_kit.errors import UnknownModelError, UsageError
from probe_kit.hooks.family import Family

if TYPE_CHECKING:
    from probe_kit.hooks.contract.model import Model, Policy

ENTRY_POINTS = "probe_kit.policies"
FOLDERS = (
    "pi0",
    "pi0_fast",
    "molmoact2",
    "groot",
    "xvla",
    "eo1",
    "smolvla",
    "openvla",
    "spatialvla",
    "prismatic",
    "magma",
    "xiaomi",
    "internvla",
    "paligemma",
    "qwen_vl",
    "internvl",
    "ovis2_5",
)
"""The folders of our families, in the order in which `probe-kit models` lists them."""


class BrokenFamilyWarning(UserWarning):
    """A third party's family cannot be used; all others can."""


def known_families() -> dict[str, Family]:
    """All families by name; third parties add theirs as entry points that name a `Family`.

    Imports the modules of all of them, of which some import torch; `get_family` imports one. A family that cannot
    be loaded is left out with a BrokenFamilyWarning that says what to change.
    """
    families = dict(own_families())
    for name in third_party_families():
        if (family := get_family(name)) is not None:
            families[name] = family
    return families


@cache
def own_families() -> dict[str, Family]:
    """The families of probe_kit by name, in the order of `FOLDERS`."""
    folders = (import_module(f"probe_kit.hooks.families.{folder}") for folder in FOLDERS)
    return {family.name: family for folder in folders for family in folder.FAMILIES}


def family_names() -> list[str]:
    """The names of all families, also of those that cannot be loaded; imports no third party."""
    return [*own_families(), *third_party_families()]


def third_party_families() -> dict[str, str]:
    """The names of third parties' families, and what their packages say of themselves; imports none of them."""
    return {entry.name: _summary(entry) for entry in family_entries() if entry.name not in own_families()}


def family_entries() -> tuple[EntryPoint, ...]:
    """The entry points of third parties' families."""
    return entry_points(group=ENTRY_POINTS)


def _summary(entry: EntryPoint) -> str:
    package = entry.dist
    if package is None:
        return entry.value
    summary = package.metadata.get("Summary")
    return f"{summary} ({package.name})" if summary else f"of the package {package.name}"


def entry_module(name: str) -> str | None:
    """The module in which a third party names its family `name`; None for a family of probe_kit."""
    entries = [] if name in own_families() else [entry for entry in family_entries() if entry.name == name]
    return entries[0].module if entries else None


def get_family(name: str) -> Family | None:
    """Return the family called `name`, or None; of third parties' modules only that of `name` is imported.

    One that cannot be loaded is None as well, with a BrokenFamilyWarning that says what to change.
    """
    try:
        return _get(name)
    except UnknownModelError as error:
        warnings.warn(str(error), BrokenFamilyWarning, stacklevel=3)
        return None


def find_family(name: str, suggestions: tuple[str, ...] = ()) -> Family:
    """The family called `name`; `suggestions` are further names to suggest if there is none.

    Raises:
        UnknownModelError: If there is none, or if it cannot be loaded.
    """
    if (family := _get(name)) is not None:
        return family
    names = [*family_names(), *suggestions]
    near = get_close_matches(name, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise UnknownModelError(f"unknown model {name!r}; known: {', '.join(names)}.{hint}")


def _get(name: str) -> Family | None:
    """Return the family called `name`, or None.

    Raises:
        UnknownModelError: For a family of a third party that cannot be loaded.
    """
    if (ours := own_families().get(name)) is not None:
        return ours
    entries = [entry for entry in family_entries() if entry.name == name]
    return _third_party(entries[0]) if entries else None


def _third_party(entry: EntryPoint) -> Family:
    try:
        family = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - other people's code may raise anything
        reason = f"{type(error).__name__}: {error}"
    else:
        if isinstance(family, Family) and family.name == entry.name:
            return family
        reason = f"it is a {type(family).__name__}, not a probe_kit.hooks.Family"
        if isinstance(family, Family):
            reason = f"the family is called {family.name!r} and its entry point {entry.name!r}; give both one name"
    raise UnknownModelError(
        f"the model family {entry.name!r} ({entry.value}) cannot be used: {reason}. Its contract is described in "
        "docs/capture.md; import names from probe_kit.hooks, not from its modules"
    )


def load_model(
    name: str,
    checkpoint: str | None = None,
    device: str = AUTO,
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
    **options: Any,
) -> "Model":
    """Load the model `name`, from `checkpoint` (folder or hub id) or the family's default.

    Args:
        name: Name of the family, as `probe-kit models` lists it.
        checkpoint: Folder or hub id; None loads the family's default.
        device: Device in torch's spelling, such as `cuda:0`. `auto` takes a GPU where torch finds one.
        dtype: `float32` or `bfloat16`; None leaves the choice to the loader.
        random_weights: Whether the network stays untrained.
        weights_seed: Seed of an untrained network's weights.
        **options: Options that only some families have, such as `unnorm_key`; see `Family.options`.

    Raises:
        UnknownModelError: For a family that does not exist or cannot be loaded.
        UsageError: For an option that the family lacks, and for a device, dtype or seed that cannot be used.
        CheckpointError: For a checkpoint that is not there or cannot be loaded.
        WeightsError: For weights that are not exactly the network's.
    """
    return find_family(name).load(checkpoint, device, dtype, random_weights, options, weights_seed)


def load_policy(
    name: str,
    checkpoint: str | None = None,
    device: str = AUTO,
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
    **options: Any,
) -> "Policy":
    """Load a model that acts, with the arguments and errors of `load_model`.

    Raises:
        UsageError: For a model that answers only.
    """
    from probe_kit.hooks.contract.model import Policy

    if not find_family(name).abilities.acts:
        raise UsageError(f"{name} answers and does not act; load it with load_model")
    model = load_model(name, checkpoint, device, dtype, random_weights, weights_seed, **options)
    if not isinstance(model, Policy):
        raise UsageError(f"{name} returned a {type(model).__name__}, not a Policy; fix the loader")
    return model
