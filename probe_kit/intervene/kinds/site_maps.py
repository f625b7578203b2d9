"""Edits of places: the effect of each, and what a run's stored interventions found inside the network.

Effects are signed: the *target side* is the one on which the correct picture lies once the two are swapped, or the
side that is steered to. A flip rate alone says nothing: actions flip away from it as well.

Maps, directions and steering are each read by themselves, independent of other stored results; see `selection`.
Family-wise p-values are against everything that was tried in the same stream on the same episodes, in one
intervention or in several. Needs no model.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.base import (
    ConditionName,
    EffectRow,
    Values,
    common_columns,
    mean_of,
    test_against_controls,
)
from probe_kit.intervene.kinds.image_swap import SMALLEST_REACH, net_interval, share_of_swap, swap_sign
from probe_kit.intervene.outcomes import CLEAN, IMAGE_SWAP, UNCHANGED, ConditionOutcomes
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.patching.sweep import SwapShare, share_fields, share_of_whole
from probe_kit.intervene.places import ALL, RESIDUAL, PlaceName
from probe_kit.intervene.selection import PooledConditions, Rank, pool_conditions, stored_results
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.significance import SIGNIFICANCE

# -- effects of edits at places ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PatchEffect(EffectRow):
    """The effect of an edit at one place, in one category; see `EffectRow`.

    net: share of episodes whose action flips to the target side, minus those that flip away from it; net_left,
    net_right: the same by target side. coefficient: of steering, else empty. effect: share of what the whole image
    swap does to where the action goes, toward the target side, with its 95 % interval by groups; None if that does
    nothing, so that a share would be a ratio of noise. mean_displacement, control_displacement: metres toward the
    target side, of the edit and of its matched controls. t, p, p_fwe: of the displacement beyond the controls',
    one-sided, by sign flips of whole groups, of an interchange in the direction of the swap itself; p_fwe against
    the largest t of all edits of the category.
    """

    coefficient: str
    effect: float | None
    effect_ci: tuple[float, float] | None
    net_left: float
    net_right: float
    mean_displacement: float
    control_displacement: float | None
    t: float
    p: float | None
    p_fwe: float | None
    action_share: float | None = None
    action_share_ci: tuple[float, float] | None = None

    @property
    def is_localised(self) -> bool:
        """Whether it carries half of the effect, beyond chance among all that was tried."""
        enough = self.effect is not None and self.effect >= LOCALISATION_SHARE
        return enough and self.p_fwe is not None and self.p_fwe < SIGNIFICANCE

    @property
    def moves_action(self) -> bool:
        """Whether it moves the action to the target side beyond chance, and by the smallest reach of a policy."""
        beyond = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE
        return beyond and self.mean_displacement >= SMALLEST_REACH

    @property
    def is_dose(self) -> bool:
        """Whether it is a steering by more than nothing."""
        return self.coefficient not in ("", "0")

    @property
    def is_by_construction(self) -> bool:
        """Whether its place carries the effect in every policy that acts on the images, and so locates nothing.

        The first layer of the backbone holds the swapped images themselves, and the acting stream the action.
        """
        parsed = PlaceName.parse(self.place)
        is_first = parsed.stream == "backbone" and parsed.layer == 0 and parsed.quantity in ("", RESIDUAL)
        return parsed.stream not in ("backbone", KV_STREAM) or is_first

    @property
    def name(self) -> str:
        """Return the edit in a few words."""
        return " ".join(filter(None, (super().name, self.coefficient and f"coefficient {self.coefficient}")))


def patch_effects(
    outcomes: ConditionOutcomes, seed_text: str, target_side: str = IMAGE_SWAP, key: str = ""
) -> list[PatchEffect]:
    """Return one per category and edit. target_side: `image_swap`, or the side that is steered to."""
    return [
        row
        for category, part in outcomes.by_category()
        for row in _of_category(part, category, seed_text, target_side, key)
    ]


def target_sign(outcomes: ConditionOutcomes, target_side: str) -> NDArray[np.float64]:
    """Return (E,) the side that is pushed to, +1 for left."""
    fixed = {"left": 1.0, "right": -1.0}
    if target_side in fixed:
        return np.full(outcomes.correct_sign.size, fixed[target_side])
    return outcomes.correct_sign if target_side == "correct" else -outcomes.correct_sign


def _of_category(
    outcomes: ConditionOutcomes, category: str, seed_text: str, target_side: str, key: str
) -> list[PatchEffect]:
    push, clean = target_sign(outcomes, target_side), outcomes.of(CLEAN)
    rows = [row for row, name in enumerate(outcomes.conditions) if name not in UNCHANGED]
    if not rows:
        return []
    names = [ConditionName.parse(outcomes.conditions[row]) for row in rows]
    displacements = push * (outcomes.displacement[rows] - clean)
    sign = swap_sign(outcomes) if target_side == IMAGE_SWAP else 1.0
    tests = test_against_controls(sign * displacements, names, outcomes, seed_text, (), ())
    effects = []
    for at, (row, name, test) in enumerate(zip(rows, names, tests, strict=True)):
        flips = _flips(push, _crossed(outcomes, clean), _crossed(outcomes, outcomes.displacement[row]))
        toward = _share_toward(outcomes, row, seed_text)
        # The swap moves actions to the wrong side; steering to another side is compared with its size.
        share = share_of_swap(outcomes, -outcomes.correct_sign * displacements[at], seed_text)
        columns: dict[str, Any] = common_columns(outcomes, row, name)
        effects.append(
            PatchEffect(
                category=category,
                **columns,
                coefficient=name.coefficient,
                effect=None if share is None else share.value,
                effect_ci=None if share is None else (share.low, share.high),
                net=float(flips.mean()),
                net_ci=net_interval(flips, outcomes, seed_text),
                net_left=mean_of(flips[push > 0]) or 0.0,
                net_right=mean_of(flips[push < 0]) or 0.0,
                mean_displacement=float(displacements[at].mean()),
                control_displacement=mean_of(displacements[test.controls]),
                t=test.t or 0.0,
                p=test.p,
                p_fwe=test.p_fwe,
                **share_fields("action_share", toward),
                key=key,
            )
        )
    return effects


def _crossed(outcomes: ConditionOutcomes, displacement: Values) -> Values:
    """Return (E,) above zero on the left; without sides, where the action is nearer to the source's."""
    if outcomes.has_sides or IMAGE_SWAP not in outcomes.conditions:
        return displacement
    return np.asarray(displacement - outcomes.of(IMAGE_SWAP) / 2)


def _share_toward(outcomes: ConditionOutcomes, row: int, seed_text: str) -> SwapShare | None:
    """Return the displacement toward the source's action as a share of the full exchange; None without one."""
    if outcomes.toward is None or IMAGE_SWAP not in outcomes.conditions:
        return None
    exchange = outcomes.toward[outcomes.conditions.index(IMAGE_SWAP)]
    return share_of_whole(outcomes.toward[row], exchange, outcomes.groups, seed_text) if exchange.any() else None


def _flips(push: Values, clean: Values, edited: Values) -> Values:
    """Return (E,) 1 where the action flips to the target side, −1 where it flips away from it, else 0."""
    flips: Values = (push * edited > 0).astype(float) - (push * clean > 0)
    return flips


BACKBONE = "backbone"
WHOLE, USUAL, WRONG = "none", "mean-difference", "wrong"
"""Settings: no direction, that of the class means, and the side to which steering goes if nothing is said."""


def stored_site_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return the maps by category: the effects of tokens patched in full, a row for every place and role.

    The backbone first and `kv` last, shallow before deep. Raises RunDamagedError.
    """
    return _by_category(run, _maps(run))


def stored_subspace_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return by category the effects of patches along single directions, and along their random controls."""
    return _by_category(run, _along(run))


def stored_steering(run: RunReader) -> dict[str, dict[str, list[PatchEffect]]]:
    """Return by category and place (`backbone.02 image`) the effects of steering, all coefficients and controls.

    Another direction than that of the class means, and another side than the wrong one, stand apart
    (`backbone.02 image, probe, toward left`).
    """
    steering: dict[str, dict[str, list[PatchEffect]]] = {}
    for selection, rows in _rows_of(_steering(run), run.seed_text):
        steering.setdefault(selection.group.like.category, {})[_in_words(selection)] = rows
    return steering


def keys_in_use(run: RunReader) -> set[str]:
    """Return the keys of stored interventions of which any number is in a map, a direction or a steering above."""
    every = [*_maps(run), *_along(run), *_steering(run)]
    return {selection.group.sources[name].stored.key for selection in every for name in selection.conditions}


def localised_sites(rows: Sequence[PatchEffect]) -> tuple[str, ...]:
    """The places, each once, that carry half of the effect or more when their tokens are patched in full.

    Those of `kv` with the role of the tokens (`kv.01 language`), unless only all of a block together carry it.
    Without those that carry it by construction.
    """
    localised = [row for row in rows if row.is_localised and not row.direction and not row.is_by_construction]
    by_role = {row.place for row in localised if row.role != ALL and _is_read(row)}
    names = [
        row.name if row.place in by_role else row.place
        for row in localised
        if row.place not in by_role or row.role != ALL
    ]
    return tuple(dict.fromkeys(names))


def _is_read(row: PatchEffect) -> bool:
    return PlaceName.parse(row.place).stream == KV_STREAM


def is_backbone_layer(row: PatchEffect) -> bool:
    """Whether the backbone's stream itself was patched, not a part of a block such as one head."""
    name = PlaceName.parse(row.place)
    return name.stream == BACKBONE and name.is_whole_layer


def is_upstream(site: str) -> bool:
    """Whether a place of the backbone holds the images themselves, upstream of all that reads them."""
    return PlaceName.parse(site).layer == 0


def localised_by_category(maps: Mapping[str, Sequence[PatchEffect]]) -> dict[str, tuple[str, ...]]:
    """Return by category `localised_sites` of `stored_site_effects`; without categories that were not searched.

    Searched is one of which all tokens of some layer of the backbone were patched, or of which a place was found:
    a null result for one role, iteration or block does not rule out the others.
    """
    searched = {
        category
        for category, rows in maps.items()
        if any(row.role == ALL and is_backbone_layer(row) for row in rows)
    }
    localised = {category: localised_sites(rows) for category, rows in maps.items()}
    return {category: places for category, places in localised.items() if places or category in searched}


def carrying_directions(along: Mapping[str, Sequence[PatchEffect]]) -> dict[str, tuple[str, ...]]:
    """Return by category the directions that carry half of the effect, beyond random ones.

    along: as `stored_subspace_effects` gives it. A direction is spelt `mean-difference at backbone.02 image`.
    """
    return {
        category: tuple(f"{row.direction} at {row.place} {row.role}" for row in rows if _is_carrier(row))
        for category, rows in along.items()
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
    results = [
        result for result in stored_results(run, "interchange") if _direction(result.stored.settings) == WHOLE
    ]
    return _selections(pool_conditions(results), ())


def _along(run: RunReader) -> list[_Selection]:
    results = [
        result for result in stored_results(run, "interchange") if _direction(result.stored.settings) != WHOLE
    ]
    return _selections(pool_conditions(results, ("direction", "seed")), ("direction",))


def _steering(run: RunReader) -> list[_Selection]:
    return _selections(
        pool_conditions(stored_results(run, "steer"), ("direction", "seed", "target_side")),
        ("direction", "target_side"),
    )


def _selections(groups: Sequence[PooledConditions], setting: Sequence[str]) -> list[_Selection]:
    """One per category, place, role and values of these settings, by depth within a category."""
    selected: dict[str, dict[tuple[str, ...], _Selection]] = {}
    for group in groups:
        values = [str(group.like.stored.settings.get(name)) for name in setting]
        by_subject = selected.setdefault(group.like.category, {})
        for subject, conditions in _by_place(group).items():
            created = max(group.sources[name].newest for name in conditions)
            candidate = _Selection(group, conditions, (group.like.rank, len(conditions), created))
            before = by_subject.setdefault((*subject, *values), candidate)
            if before.merit < candidate.merit:
                by_subject[*subject, *values] = candidate
    return [by_subject[subject] for by_subject in selected.values() for subject in sorted(by_subject, key=_depth)]


def _by_place(group: PooledConditions) -> dict[tuple[str, str], tuple[str, ...]]:
    """The conditions of every place and role, controls and coefficients among them."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for condition in sorted(group.sources):
        name = ConditionName.parse(condition)
        grouped.setdefault((name.site, name.role), []).append(condition)
    return {cell: tuple(names) for cell, names in grouped.items()}


def _rows_of(selections: Sequence[_Selection], seed_text: str) -> Iterator[tuple[_Selection, list[PatchEffect]]]:
    """The numbers of each, tested against everything that its group tried in the same stream."""
    tested: dict[tuple[int, str], dict[str, PatchEffect]] = {}
    for selection in selections:
        stream = _stream(selection.conditions[0])
        at = id(selection.group), stream
        if at not in tested:
            tested[at] = _test_together(selection.group, stream, seed_text)
        yield selection, [tested[at][name] for name in selection.conditions]


def _test_together(group: PooledConditions, stream: str, seed_text: str) -> dict[str, PatchEffect]:
    conditions = sorted(name for name in group.sources if _stream(name) == stream)
    target_side = str(group.like.stored.settings.get("target_side", IMAGE_SWAP))
    rows = patch_effects(group.outcomes(conditions), seed_text, target_side)
    return {
        name: replace(row, key=group.sources[name].stored.key) for name, row in zip(conditions, rows, strict=True)
    }


def _by_category(run: RunReader, selections: Sequence[_Selection]) -> dict[str, list[PatchEffect]]:
    effects: dict[str, list[PatchEffect]] = {}
    for selection, rows in _rows_of(selections, run.seed_text):
        effects.setdefault(selection.group.like.category, []).extend(rows)
    return effects


def _direction(settings: Mapping[str, Any]) -> str:
    return str(settings.get("direction", WHOLE))


def _in_words(steered: _Selection) -> str:
    name, settings = ConditionName.parse(steered.conditions[0]), steered.group.like.stored.settings
    direction, target_side = str(settings.get("direction", USUAL)), str(settings.get("target_side", WRONG))
    qualifiers = [direction] * (direction != USUAL) + [f"toward {target_side}"] * (target_side != WRONG)
    return ", ".join([f"{name.site} {name.role}", *qualifiers])


def _stream(condition: str) -> str:
    return ConditionName.parse(condition).site.partition(".")[0]


def _depth(subject: tuple[str, ...]) -> tuple[object, ...]:
    """The backbone, then the acting stream, then `kv`; shallow before deep, all tokens before single roles."""
    site, role, *values = subject
    name = PlaceName.parse(site)
    part = {BACKBONE: 0, KV_STREAM: 2}.get(name.stream, 1)
    return part, name.stream, *name.depth, role != ALL, role, *values


def best_patch_targets(run: RunReader, categories: Sequence[str]) -> tuple[str, ...]:
    """`PLACE|ROLE`, of each category the last place of the backbone that was located, in its narrowest role.

    The last one is behind everything else through which the answer passes; where none of the backbone was located,
    the last of the acting stream or of `kv`. Of its roles the one with the largest effect, and all tokens only
    where no single role carries half of it. Raises UsageError if none was located.
    """
    stored = stored_site_effects(run)
    best = [best_cell(stored.get(category, [])) for category in categories]
    cells = tuple(dict.fromkeys(str(ConditionName(cell.place, cell.role)) for cell in best if cell is not None))
    if not cells:
        raise UsageError(
            f"no stored interchange of {run.location} located a place of {', '.join(categories)}: run "
            "`probe-kit intervene RUN --kind interchange` first, or name --sites and --roles"
        )
    return cells


def best_cell(rows: Sequence[PatchEffect]) -> PatchEffect | None:
    """The patch behind which nothing of the answer passes, of one category; see `best_patch_targets`."""
    located = [row for row in rows if row.is_localised and not row.direction]
    if not located:
        return None
    deepest = ([row for row in located if is_backbone_layer(row)] or located)[-1]
    last = [row for row in located if row.place == deepest.place]
    return max(last, key=lambda row: (row.role != ALL, row.effect or 0.0))
