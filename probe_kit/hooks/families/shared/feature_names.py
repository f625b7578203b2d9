"""The names of a feature's numbers, in every spelling that data sets and checkpoints have. Imports no torch."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from probe_kit._system.table_cells import is_count

_Names = tuple[str, ...]


def read_names(spelling: Any) -> _Names | None:
    """Return the names in the order of the numbers.

    Data sets spell `names` as a list, as lists in a list, as groups of either by name (`{"motors": […]}`), as the
    place by name, or as one name for all. Where two groups share a name, their own name stands before it.

    Args:
        spelling: The value of `names`.

    Returns:
        Empty where nothing is named; None for a spelling from which no order follows.
    """
    places = [] if spelling is None else list(_places(spelling))
    if not places:
        return ()
    if any(name is None for name, _, _ in places):
        return None
    if not (ordered := _in_order(places)):
        return None
    names = [str(name) for name, _, _ in ordered]
    if len(set(names)) < len(names) and len({group for _, _, group in ordered}) > 1:
        names = [".".join((*group, name)) for name, (_, _, group) in zip(names, ordered, strict=True)]
    return tuple(names)


def names_misfit(spelling: Any, count: int) -> str:
    """Return why the names of `count` numbers name none of them; empty where they fit, or there are none."""
    names = read_names(spelling)
    if names is None:
        return f"names in no known spelling: {str(spelling)[:200]}"
    if not names or len(names) == count:
        return ""
    if len(names) == 1:
        return f"one name for all: {names[0]}"
    return f"its {len(names)} names do not fit: {', '.join(names)[:200]}"


def names_of(spelling: Any, count: int) -> _Names | None:
    """Return the names of `count` numbers; None where there are none, or they do not fit."""
    names = read_names(spelling)
    return names if names and len(names) == count else None


_Leaf = tuple[str | None, int | None, _Names]
"""A name, its place where one is spelled, and the groups that it is in; a name of None fits no spelling."""


def _places(spelling: Any, group: _Names = ()) -> Iterator[_Leaf]:
    if isinstance(spelling, str):
        yield spelling, None, group
    elif isinstance(spelling, Mapping):
        for name, part in spelling.items():
            if type(part) is int:
                yield str(name), part, group
            elif isinstance(part, str) and is_count(str(name)):
                yield part, int(name), group
            else:
                yield from _places(part, (*group, str(name)))
    elif isinstance(spelling, Sequence):
        for number, part in enumerate(spelling):
            nested = isinstance(part, Mapping | Sequence) and not isinstance(part, str)
            yield from _places(part, (*group, str(number)) if nested else group)
    else:
        yield (None if spelling is None else str(spelling)), None, group


def _in_order(places: Sequence[_Leaf]) -> list[_Leaf]:
    """Return names in the order of their places, which count through all groups or anew in each; else nothing."""
    numbers = [number for _, number, _ in places if number is not None]
    if not numbers:
        return list(places)
    groups = list(dict.fromkeys(group for _, _, group in places))
    if len(numbers) == len(places) == len(set(numbers)):
        return sorted(places, key=lambda leaf: leaf[1] or 0)
    if len(numbers) == len(places) == len({(number, group) for _, number, group in places}):
        return sorted(places, key=lambda leaf: (groups.index(leaf[2]), leaf[1] or 0))
    return []
