"""What a run's stored interventions found inside the network: maps, directions, steering. Needs no model.

Each is read by itself, whatever else was stored before or after it; see `standing`. Family-wise p-values are
against everything that was tried in the same stream on the same episodes, in one intervention or in several.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.hooks.contract.sites import MEMORY_STREAM
from probe_kit.intervene.edits.sites import ALL
from probe_kit.intervene.kinds.site_effects import Named, Passing, passing
from probe_kit.intervene.store.answers import EXCHANGED
from probe_kit.intervene.store.selection import Joined, Rank, joined, told_of
from probe_kit.train.data.run_reader import RunReader

BACKBONE = "backbone"
WHOLE, USUAL, WRONG = "none", "mean-difference", "wrong"
"""Settings: no direction, that of the class means, and the side to which steering goes if nothing is said."""


def stored_passing(run: RunReader) -> dict[str, list[Passing]]:
    """By category, the maps: what happens where tokens are taken over whole, a row for every place and role.

    The backbone first and the memory last, shallow before deep. Raises RunDamagedError.
    """
    return _by_category(run, _maps(run))


def stored_along(run: RunReader) -> dict[str, list[Passing]]:
    """By category, what is carried along single directions, and by the random ones beside them."""
    return _by_category(run, _along(run))


def stored_steering(run: RunReader) -> dict[str, dict[str, list[Passing]]]:
    """By category and place (`backbone.02 image`), what steering did at every dose, controls included.

    Another direction than that of the class means, and another side than the wrong one, stand apart
    (`backbone.02 image, probe, toward left`).
    """
    found: dict[str, dict[str, list[Passing]]] = {}
    for one, rows in _rows_of(_steering(run), run.suite):
        found.setdefault(one.group.like.category, {})[_in_words(one)] = rows
    return found


def keys_inside(run: RunReader) -> set[str]:
    """Of the stored interventions of which any number is in a map, a direction or a steering above."""
    every = [*_maps(run), *_along(run), *_steering(run)]
    return {one.group.sources[name].stored.key for one in every for name in one.conditions}


def located_in(rows: Sequence[Passing]) -> tuple[str, ...]:
    """The places, each once, that carry half of the effect or more when their tokens are taken over whole."""
    return tuple(dict.fromkeys(row.place for row in rows if row.is_located and not row.direction))


def stored_places(run: RunReader) -> dict[str, tuple[str, ...]]:
    """By category, `located_in` of its maps; without categories that nobody searched.

    Searched is one of which all tokens of some layer of the backbone were exchanged, or of which a place was
    found. That a single role, iteration or block carries nothing says nothing of the others.
    """
    maps = stored_passing(run)
    searched = {
        category
        for category, rows in maps.items()
        if any(row.role == ALL and row.place.startswith(f"{BACKBONE}.") for row in rows)
    }
    found = {category: located_in(rows) for category, rows in maps.items()}
    return {category: places for category, places in found.items() if places or category in searched}


def stored_carriers(run: RunReader) -> dict[str, tuple[str, ...]]:
    """By category, the directions that carry half of the effect, beyond random ones: `mean-difference at
    backbone.02 image`.
    """
    return {
        category: tuple(f"{row.direction} at {row.place} {row.role}" for row in rows if _is_carrier(row))
        for category, rows in stored_along(run).items()
    }


def _is_carrier(row: Passing) -> bool:
    return row.is_located and row.control_shift is not None


@dataclass(frozen=True)
class _Chosen:
    """The conditions that stand for a subject. merit: of several, the largest is chosen."""

    group: Joined
    conditions: tuple[str, ...]
    merit: tuple[Rank, int, tuple[str, str]]


def _maps(run: RunReader) -> list[_Chosen]:
    told = [own for own in told_of(run, "interchange") if _direction(own.stored.settings) == WHOLE]
    return _chosen(joined(told), ())


def _along(run: RunReader) -> list[_Chosen]:
    told = [own for own in told_of(run, "interchange") if _direction(own.stored.settings) != WHOLE]
    return _chosen(joined(told, ("direction", "seed")), ("direction",))


def _steering(run: RunReader) -> list[_Chosen]:
    return _chosen(joined(told_of(run, "steer"), ("direction", "seed", "toward")), ("direction", "toward"))


def _chosen(groups: Sequence[Joined], setting: Sequence[str]) -> list[_Chosen]:
    """One per category, place, role and values of these settings, by depth within a category."""
    found: dict[str, dict[tuple[str, ...], _Chosen]] = {}
    for group in groups:
        values = [str(group.like.stored.settings.get(name)) for name in setting]
        own = found.setdefault(group.like.category, {})
        for subject, conditions in _by_place(group).items():
            made = max(group.sources[name].made for name in conditions)
            candidate = _Chosen(group, conditions, (group.like.rank, len(conditions), made))
            before = own.setdefault((*subject, *values), candidate)
            if before.merit < candidate.merit:
                own[*subject, *values] = candidate
    return [own[subject] for own in found.values() for subject in sorted(own, key=_depth)]


def _by_place(group: Joined) -> dict[tuple[str, str], tuple[str, ...]]:
    """The conditions of every place and role, controls and doses among them."""
    found: dict[tuple[str, str], list[str]] = {}
    for condition in sorted(group.sources):
        named = Named.of(condition)
        found.setdefault((named.place, named.role), []).append(condition)
    return {cell: tuple(names) for cell, names in found.items()}


def _rows_of(chosen: Sequence[_Chosen], suite: str) -> Iterator[tuple[_Chosen, list[Passing]]]:
    """The numbers of each, tested against everything that its group tried in the same stream."""
    tested: dict[tuple[int, str], dict[str, Passing]] = {}
    for one in chosen:
        stream = _stream(one.conditions[0])
        at = id(one.group), stream
        if at not in tested:
            tested[at] = _tested(one.group, stream, suite)
        yield one, [tested[at][name] for name in one.conditions]


def _tested(group: Joined, stream: str, suite: str) -> dict[str, Passing]:
    conditions = sorted(name for name in group.sources if _stream(name) == stream)
    toward = str(group.like.stored.settings.get("toward", EXCHANGED))
    rows = passing(group.answers(conditions), suite, toward)
    return {
        name: replace(row, key=group.sources[name].stored.key) for name, row in zip(conditions, rows, strict=True)
    }


def _by_category(run: RunReader, chosen: Sequence[_Chosen]) -> dict[str, list[Passing]]:
    found: dict[str, list[Passing]] = {}
    for one, rows in _rows_of(chosen, run.suite):
        found.setdefault(one.group.like.category, []).extend(rows)
    return found


def _direction(settings: Mapping[str, Any]) -> str:
    return str(settings.get("direction", WHOLE))


def _in_words(steered: _Chosen) -> str:
    named, settings = Named.of(steered.conditions[0]), steered.group.like.stored.settings
    direction, toward = str(settings.get("direction", USUAL)), str(settings.get("toward", WRONG))
    further = [direction] * (direction != USUAL) + [f"toward {toward}"] * (toward != WRONG)
    return ", ".join([f"{named.place} {named.role}", *further])


def _stream(condition: str) -> str:
    return Named.of(condition).place.partition(".")[0]


def _depth(subject: tuple[str, ...]) -> tuple[object, ...]:
    """The backbone, then what acts, then the memory; shallow before deep, all tokens before single roles."""
    place, role, *values = subject
    stream, _, rest = place.partition(".")
    layer, _, iterations = rest.partition("@")
    first, _, last = iterations.partition("-")
    part = {BACKBONE: 0, MEMORY_STREAM: 2}.get(stream, 1)
    return part, stream, int(layer), int(first or 0), int(last or first or 0), role != ALL, role, *values
