"""The registry of model families: those of probe_kit, and third-party ones from entry points.

A family of ours is a folder in `families/` whose package lists its `FAMILIES`, and its name in `FOLDERS`.
"""

import warnings
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UnknownModelError, UsageError
from probe_kit.hooks.family import Family

if TYPE_CHECKING:
    from probe_kit.hooks.contract.model import Model, Policy

ENTRY_POINTS = "probe_kit.policies"
FOLDERS = (
    "pi0",
    "smolvla",
    "openvla",
    "spatialvla",
    "prismatic",
    "magma",
    "xiaomi",
    "internvla",
    "paligemma",
    "qwen2_5_vl",
    "qwen3_vl",
    "internvl",
    "ovis2_5",
)
"""In the order in which `probe-kit models` lists them."""


class BrokenFamilyWarning(UserWarning):
    """A third party's family cannot be used; all others can."""


def known_families() -> dict[str, Family]:
    """All families by name. Third parties add theirs as entry points that name a `Family`.

    One that cannot be loaded is left out with a BrokenFamilyWarning that says what to change.
    """
    found = dict(_own_families())
    for entry in entry_points(group=ENTRY_POINTS):
        family = _third_party(entry)
        if family is not None:
            found.setdefault(family.name, family)
    return found


@cache
def _own_families() -> dict[str, Family]:
    folders = (import_module(f"probe_kit.hooks.families.{folder}") for folder in FOLDERS)
    return {family.name: family for folder in folders for family in folder.FAMILIES}


def _third_party(entry: EntryPoint) -> Family | None:
    try:
        family = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - other people's code may raise anything
        reason = f"{type(error).__name__}: {error}"
    else:
        if isinstance(family, Family):
            return family
        reason = f"it is a {type(family).__name__}, not a probe_kit.hooks.Family"
    warnings.warn(
        f"the model family {entry.name!r} ({entry.value}) cannot be used: {reason}. Its contract is described in "
        "docs/capture.md; import names from probe_kit.hooks, not from its modules",
        BrokenFamilyWarning,
        stacklevel=3,
    )
    return None


def find_family(name: str, others: tuple[str, ...] = ()) -> Family:
    """The family called `name`. `others` are further names to suggest if there is none.

    Entry points of third parties are looked through only for a name that is not ours.
    """
    if (ours := _own_families().get(name)) is not None:
        return ours
    known = known_families()
    if name not in known:
        names = [*known, *others]
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UnknownModelError(f"unknown model {name!r}; known: {', '.join(names)}.{hint}")
    return known[name]


def load_model(
    name: str,
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
    **options: Any,
) -> "Model":
    """Load the model `name`, from `checkpoint` (folder or hub id) or the family's default.

    options: what only some families have, such as `unnorm_key`; see `Family.options`.
    Raises UnknownModelError, UsageError, CheckpointError or WeightsError.
    """
    return find_family(name).load(checkpoint, device, dtype, random_weights, options, weights_seed)


def load_policy(
    name: str,
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    weights_seed: int = 0,
    **options: Any,
) -> "Policy":
    """Load a model that acts; as `load_model`. Raises UsageError for one that answers only."""
    from probe_kit.hooks.contract.model import Policy

    if not find_family(name).acts:
        raise UsageError(f"{name} answers and does not act; load it with load_model")
    model = load_model(name, checkpoint, device, dtype, random_weights, weights_seed, **options)
    if not isinstance(model, Policy):
        raise UsageError(f"{name} returned a {type(model).__name__}, not a Policy; fix the loader")
    return model
