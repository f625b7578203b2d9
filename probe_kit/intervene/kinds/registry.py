"""All kinds of intervention, an entry each. To add one, see "To add a kind of intervention" in CONTRIBUTING.md."""

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.kind import Kind

if TYPE_CHECKING:
    from probe_kit.extract import Run
    from probe_kit.intervene.replay.conditions import Intervention

_ENTRIES = (
    "probe_kit.intervene.kinds.image_swap.kind",
    "probe_kit.intervene.kinds.instruction_swap.kind",
    "probe_kit.intervene.kinds.interchange.kind",
    "probe_kit.intervene.kinds.joint.kind",
    "probe_kit.intervene.kinds.attribution.kind",
    "probe_kit.intervene.kinds.steer.kind",
    "probe_kit.intervene.kinds.closed_loop.kind",
    "probe_kit.intervene.kinds.erase.kind",
    "probe_kit.intervene.kinds.attention.kind",
)
"""Modules whose `KIND` is an entry, in the order of help."""

KINDS: dict[str, Kind] = {kind.name: kind for kind in (import_module(name).KIND for name in _ENTRIES)}
"""By name. A package of its own registers a kind by adding it here before `probe-kit` is run."""


def kind_of(name: str) -> Kind:
    """The entry of a name. Raises UsageError for one that is not registered."""
    if name not in KINDS:
        raise UsageError(f"unknown kind of intervention {name!r}; expected one of {', '.join(KINDS)}")
    return KINDS[name]


def intervention_of(name: str, run: "Run", common: Mapping[str, Any], given: Mapping[str, Any]) -> "Intervention":
    """As the command asks for it. common: options of every kind. given: further ones, by name.

    Raises UsageError for an option that does not apply to the kind, and what the kind raises.
    """
    kind = kind_of(name)
    check_options(kind, given)
    found: Intervention = kind.function("build")(run, **common, **given)
    found.categories_in(run)
    return found


def check_options(kind: Kind, given: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that does not apply to a kind. given: by name, of the command line."""
    for option in given:
        if option not in kind.options:
            others = [other.name for other in KINDS.values() if option in other.options]
            raise UsageError(
                f"--{option.replace('_', '-')} does not apply to --kind {kind.name}; remove it or choose another "
                f"kind: {', '.join(others)}"
            )
