"""Kinds of intervention. Each is one file: its options, conditions, effects with their columns, and its sentence.

A file in this folder is a kind, and so is a module that `register` is called with. `base.Intervention` is what
they extend.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.hooks.contract.declared import InterventionKind
    from probe_kit.intervene.kinds.base import Intervention

_HOMES = {
    file.stem.replace("_", "-"): f"{__name__}.{file.stem}"
    for file in sorted(Path(__file__).parent.glob("*.py"))
    if file.stem not in ("__init__", "base")
}


def kind_names() -> tuple[str, ...]:
    """Return the names of all kinds, without importing any."""
    return tuple(_HOMES)


def kind_of(name: str) -> "type[Intervention]":
    """Return the kind of a name.

    Raises:
        UsageError: For a name that does not exist.
    """
    if name not in _HOMES:
        raise UsageError(f"unknown kind of intervention {name!r}; expected one of {', '.join(_HOMES)}")
    kind: type[Intervention] = import_module(_HOMES[name]).KIND
    return kind


def every_kind() -> "list[type[Intervention]]":
    """Return all kinds, in the order of help."""
    return sorted(map(kind_of, _HOMES), key=lambda kind: kind.position)


def kinds_that_need(capability: "InterventionKind") -> tuple[str, ...]:
    """Return the kinds that a family supports only with a capability, the last one of their `needs`."""
    return tuple(kind.kind for kind in every_kind() if capability in kind.needs[-1:])


def register(name: str, module: str) -> None:
    """Add the kind of another package: its name, and the module that has it as `KIND`."""
    _HOMES[name] = module
