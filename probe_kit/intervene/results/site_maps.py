"""What a run's stored interventions found inside the network: maps, directions, steering. Needs no model.

Each is read by itself, independent of other stored results; see `store.selection`. Family-wise p-values are
against everything that was tried in the same stream on the same episodes, in one intervention or in several.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import ALL, PlaceName
from probe_kit.intervene.kinds.base import ConditionName
from probe_kit.intervene.kinds.site_effects import PatchEffect, patch_effects
from probe_kit.intervene.store.answers import IMAGE_SWAP
from probe_kit.intervene.store.selection import PooledConditions, Rank, pool_conditions, stored_results
from probe_kit.train.data.run_reader import RunReader, seed_text_of

BACKBONE = "backbone"
WHOLE, USUAL, WRONG = "none", "mean-difference", "wrong"
"""Settings: no direction, that of the class means, and the side to which steering goes if nothing is said."""


def stored_site_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """By category, the maps: what happens where tokens are patched in full, a row for every place and role.

    The backbone first and `kv` last, shallow before deep. Raises RunDamagedError.
    """
    return _by_category(run, _maps(run))


def stored_subspace_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """By category, what is carried along single directions, and by the random ones beside them."""
    return _by_category(run, _along(run))


def stored_steering(run: RunReader) -> dict[str, dict[str, list[PatchEffect]]]:
    """By category and place (`backbone.02 image`), the effect of steering at every coefficient, controls included.

    Another direction than that of the class means, and another side than the wrong one, stand apart
    (`backbone.02 image, probe, toward left`).
    """
    found: dict[str, dict[str, list[PatchEffect]]] = {}
    for one, rows in _rows_of(_steering(run), seed_text_of(run)):
        found.setdefault(one.group.like.category, {})[_in_words(one)] = rows
    return found


def keys_in_use(run: RunReader) -> set[str]:
    """Of the stored interventions of which any number is in a map, a direction or a steering above."""
    every = [*_maps(run), *_along(run), *_steering(run)]
    return {one.group.sources[name].stored.key for one in every for name in one.conditions}


def localised_sites(rows: Sequence[PatchEffect]) -> tuple[str, ...]:
    """The places, each once, that carry half of the effect or more when their tokens are patched in full.

    Those of `kv` with the role of the tokens (`kv.01 language`), unless only all of a block together carry it.
    Without those that carry it by construction.
    """
    found = [row for row in rows if row.is_localised and not row.direction and not row.is_by_construction]
    by_role = {row.place for row in found if row.role != ALL and _is_read(row)}
    names = [
        row.name if row.place in by_role else row.place
        for row in found
        if row.place not in by_role or row.role != ALL
    ]
    return tuple(dict.fromkeys(names))


def _is_read(row: PatchEffect) -> bool:
    return PlaceName.parse(row.place).stream == KV_STREAM


def is_backbone_layer(row: PatchEffect) -> bool:
    """Whether the backbone's stream itself was patched, not a part of a block such as one head."""
    name = PlaceName.parse(row.place)
    return name.stream == BACKBONE and name.is_whole_layer


def is_upstream(place: str) -> bool:
    """Whether a place of the backbone holds the images themselves, upstream of all that reads them."""
    return PlaceName.parse(place).layer == 0


def stored_localised_sites(run: RunReader) -> dict[str, tuple[str, ...]]:
    """By category, `localised_sites` of its maps; without categories that were not searched.

    Searched is one of which all tokens of some layer of the backbone were patched, or of which a place was found:
    a null result for one role, iteration or block does not rule out the others.
    """
    maps = stored_site_effects(run)
    searched = {
        category
        for category, rows in maps.items()
        if any(row.role == ALL and is_backbone_layer(row) for row in rows)
    }
    found = {category: localised_sites(rows) for category, rows in maps.items()}
    return {category: places for category, places in found.items() if places or category in searched}


def stored_carrying_directions(run: RunReader) -> dict[str, tuple[str, ...]]:
    """By category, the directions that carry half of the effect, beyond random ones: `mean-difference at
    backbone.02 image`.
    """
    return {
        category: tuple(f"{row.direction} at {row.place} {row.role}" for row in rows if _is_carrier(row))
        for category, rows in stored_subspace_effects(run).items()
    }


def _is_carrier(row: PatchEffect) -> bool:
    return row.is_localised and row.control_displacement is not None


@dataclass(frozen=True)
class _Selection:
    """The conditions that stand for a subject. merit: of several, the largest is chosen."""

    group: PooledConditions
    conditions: tuple[str, ...]
    merit: tuple[Rank, int, tuple[str, str]]


def _maps(run: RunReader) -> list[_Selection]:
    result = [own for own in stored_results(run, "interchange") if _direction(own.stored.settings) == WHOLE]
    return _chosen(pool_conditions(result), ())


def _along(run: RunReader) -> list[_Selection]:
    result = [own for own in stored_results(run, "interchange") if _direction(own.stored.settings) != WHOLE]
    return _chosen(pool_conditions(result, ("direction", "seed")), ("direction",))


def _steering(run: RunReader) -> list[_Selection]:
    return _chosen(
        pool_conditions(stored_results(run, "steer"), ("direction", "seed", "target_side")),
        ("direction", "target_side"),
    )


def _chosen(groups: Sequence[PooledConditions], setting: Sequence[str]) -> list[_Selection]:
    """One per category, place, role and values of these settings, by depth within a category."""
    found: dict[str, dict[tuple[str, ...], _Selection]] = {}
    for group in groups:
        values = [str(group.like.stored.settings.get(name)) for name in setting]
        own = found.setdefault(group.like.category, {})
        for subject, conditions in _by_place(group).items():
            made = max(group.sources[name].made for name in conditions)
            candidate = _Selection(group, conditions, (group.like.rank, len(conditions), made))
            before = own.setdefault((*subject, *values), candidate)
            if before.merit < candidate.merit:
                own[*subject, *values] = candidate
    return [own[subject] for own in found.values() for subject in sorted(own, key=_depth)]


def _by_place(group: PooledConditions) -> dict[tuple[str, str], tuple[str, ...]]:
    """The conditions of every place and role, controls and coefficients among them."""
    found: dict[tuple[str, str], list[str]] = {}
    for condition in sorted(group.sources):
        named = ConditionName.parse(condition)
        found.setdefault((named.place, named.role), []).append(condition)
    return {cell: tuple(names) for cell, names in found.items()}


def _rows_of(chosen: Sequence[_Selection], seed_text: str) -> Iterator[tuple[_Selection, list[PatchEffect]]]:
    """The numbers of each, tested against everything that its group tried in the same stream."""
    tested: dict[tuple[int, str], dict[str, PatchEffect]] = {}
    for one in chosen:
        stream = _stream(one.conditions[0])
        at = id(one.group), stream
        if at not in tested:
            tested[at] = _test_together(one.group, stream, seed_text)
        yield one, [tested[at][name] for name in one.conditions]


def _test_together(group: PooledConditions, stream: str, seed_text: str) -> dict[str, PatchEffect]:
    conditions = sorted(name for name in group.sources if _stream(name) == stream)
    target_side = str(group.like.stored.settings.get("target_side", IMAGE_SWAP))
    rows = patch_effects(group.outcomes(conditions), seed_text, target_side)
    return {
        name: replace(row, key=group.sources[name].stored.key) for name, row in zip(conditions, rows, strict=True)
    }


def _by_category(run: RunReader, chosen: Sequence[_Selection]) -> dict[str, list[PatchEffect]]:
    found: dict[str, list[PatchEffect]] = {}
    for one, rows in _rows_of(chosen, seed_text_of(run)):
        found.setdefault(one.group.like.category, []).extend(rows)
    return found


def _direction(settings: Mapping[str, Any]) -> str:
    return str(settings.get("direction", WHOLE))


def _in_words(steered: _Selection) -> str:
    named, settings = ConditionName.parse(steered.conditions[0]), steered.group.like.stored.settings
    direction, target_side = str(settings.get("direction", USUAL)), str(settings.get("target_side", WRONG))
    further = [direction] * (direction != USUAL) + [f"toward {target_side}"] * (target_side != WRONG)
    return ", ".join([f"{named.place} {named.role}", *further])


def _stream(condition: str) -> str:
    return ConditionName.parse(condition).place.partition(".")[0]


def _depth(subject: tuple[str, ...]) -> tuple[object, ...]:
    """The backbone, then the acting stream, then `kv`; shallow before deep, all tokens before single roles."""
    place, role, *values = subject
    name = PlaceName.parse(place)
    part = {BACKBONE: 0, KV_STREAM: 2}.get(name.stream, 1)
    return part, name.stream, *name.depth, role != ALL, role, *values
