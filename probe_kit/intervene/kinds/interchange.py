"""Edits of places by interchange (activation patching), and what a run's stored edits found inside the network.

Tokens are patched from the same inference with swapped images. What is patched in is what this policy computes
there in this state, so it is on the policy's own distribution, has no strength to choose, and can do no more than
the image swap: with all that differs patched, the effect is 1.

Effects are signed: the *target side* is the one on which the correct picture lies once the two are swapped, or the
side that is steered to. A flip rate alone says nothing: actions flip away from it as well. Maps, directions and
steering are each read by themselves. Family-wise p-values are against everything that was tried in the same stream
on the same episodes, in one intervention or in several.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import KV_STREAM, Site
from probe_kit.intervene.kinds.base import (
    NONE,
    AlongDirection,
    ConditionName,
    EffectRow,
    Measurement,
    TableContext,
    Values,
    common_columns,
    count_edits,
    effect_table,
    interval_text,
    lines_of,
    mean_of,
    share_of_edits,
    test_against_controls,
    text_of,
)
from probe_kit.intervene.kinds.image_swap import SMALLEST_REACH, net_interval, share_of_swap, swap_sign
from probe_kit.intervene.outcomes import (
    CLEAN,
    IMAGE_SWAP,
    UNCHANGED,
    ConditionOutcomes,
    PooledConditions,
    Rank,
    pool_conditions,
    stored_results,
)
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.patching.patch import Cell, sites_of_cells
from probe_kit.intervene.patching.sweep import SwapShare, share_fields, share_of_whole
from probe_kit.intervene.places import ALL, RESIDUAL, TILES, PlaceName, SiteGroup, resolve_all, roles_of
from probe_kit.intervene.replay import CleanRun, Condition, Patched, SourceRun
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run import Run
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.directions import DirectionBasis
    from probe_kit.intervene.sessions import ReplaySession


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


_LEGEND = (
    "effect: share of what the whole image swap does, n/a where that is not beyond chance; net flip rate: share "
    "of episodes that flip to the target side, minus those that flip away from it; p: family-wise over all edits "
    "of the category, one-sided; relative change: how far tokens were moved, in their own norms; *: carries the "
    "effect by construction and locates nothing; unread: nothing that acts reads this place"
)


# -- patches of cells ----------------------------------------------------------------------------------------


def cells_at(session: "ReplaySession", places: Iterable[SiteGroup], roles: Sequence[str]) -> list[Cell]:
    """Return the cells of these roles at places, as far as tokens play them."""
    return [
        Cell(site_group, role)
        for site_group in places
        for role in roles_of(session.policy, site_group.stream, roles)
    ]


def patch_of(cell: Cell, source_sites: tuple[Site, ...], prefix: str = "") -> Patched:
    """Return the patch of one cell in full. prefix: of its name."""
    return Patched(f"{prefix}{ConditionName(cell.site_group.name, cell.role)}", {"": (cell,)}, source_sites)


def patches_within(
    direction: str, bases: "DirectionBasis", cell: Cell, source_sites: tuple[Site, ...]
) -> list[Patched]:
    """Return the patch along a direction, and along each of its controls."""
    names = {
        name: str(ConditionName(cell.site_group.name, cell.role, name))
        for name in (direction, *bases.control_names)
    }
    return [Patched(name, {"": (cell,)}, source_sites, along, bases) for along, name in names.items()]


def check_sites_and_roles(sites: Sequence[str], roles: Sequence[str], subject: str) -> None:
    """Raise UsageError without sites, or for roles that share tokens."""
    if not sites or not roles or ALL in roles:
        raise UsageError(f"{subject} at least one site, and roles that share no token (not all)")


@dataclass(frozen=True, kw_only=True)
class Interchange(AlongDirection):
    """Every place is tried at every role, alone.

    sites: patterns, see `resolve_sites`. roles: of the tokens that are patched; a stream is tried at those
    that it has. direction: patches tokens within it alone; `none` in full. controls: so many times as many random
    directions, per place and role; see `AlongDirection`.
    """

    kind: ClassVar[str] = "interchange"
    summary: ClassVar[str] = "Activation patching: where does the swapped image pass?"
    position: ClassVar[int] = 3
    asks_where: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "where tokens are patched; default backbone.*",
        "roles": "of the patched tokens; default all,image,language",
        "direction": "patch within it: mean-difference, probe (of means), mean-difference:K (tokens), FILE#NAME",
        "controls": "random directions; default 5 with --direction",
        "seed": "of controls and folds; default 0",
    }

    sites: tuple[str, ...] = ("backbone.*",)
    roles: tuple[str, ...] = (ALL, "image", "language")

    def __post_init__(self) -> None:
        from probe_kit.intervene.directions import check_direction

        super().__post_init__()
        if not self.sites or not self.roles:
            raise UsageError("an interchange needs at least one site and one role")
        if set(self.roles) & set(TILES) and self.direction != NONE:
            raise UsageError(
                "tiles have no mean in the run from which a direction could be found; patch them in full: leave "
                "--direction out"
            )
        if self.direction != NONE:
            check_direction(self.direction, self.vector)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or no --controls")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return it with five controls where a direction is given and their number is not."""
        options.setdefault("controls", 5 if "direction" in options else 0)
        return super().from_options(run, **options)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, images swapped, and every place at every role. Raises UnknownSiteError, NoProbesError."""
        from probe_kit.intervene.directions import fit_token_directions

        cells = cells_at(session, resolve_all(self.sites, session.policy).values(), self.roles)
        source_sites = sites_of_cells(cells)
        conditions: list[Condition] = [CleanRun(), SourceRun()]
        if self.direction == NONE:
            return conditions + [patch_of(cell, source_sites) for cell in cells]
        bases = fit_token_directions(session, self, cells, self.sites)
        for cell, basis in bases.items():
            conditions += patches_within(self.direction, basis, cell, source_sites)
        return conditions

    @staticmethod
    def effects(measurement: Measurement) -> list[PatchEffect]:
        """Return one row per category and edit."""
        target_side = str(measurement.settings.get("target_side", IMAGE_SWAP))
        return patch_effects(measurement.outcomes, measurement.seed_text, target_side, measurement.key)

    @staticmethod
    def table(rows: Sequence[PatchEffect], context: TableContext) -> "Table":
        """Return one line per category and edit; controls are columns of what is compared with them."""
        unread = context.measurement.certificate.get("unread", ())
        edits = [row for row in rows if not row.is_control]
        return effect_table(
            f"Where is it used? {context.subject}, {context.measurement.settings['kind']}",
            context.in_words(_LEGEND),
            ("category", "edit"),
            lines_of(edits, lambda row: f"{row.name}{' (unread)' * (row.place in unread)}"),
            {"What the action does": _WITHOUT_SIDES if context.lacks_sides else _COLUMNS},
            lambda row: row.is_localised and not row.is_by_construction,
        )

    @staticmethod
    def sentence(rows: Sequence[PatchEffect]) -> str:
        """Return which edits carry half of the swap, or move the action at all."""
        edits, localised, apart = _carriers(rows)
        if all(row.effect is None for row in edits):
            names = [f"{row.name} {100 * row.mean_displacement:+.1f} cm" for row in _moving(edits)]
            return (
                f"edits that move the action at least {100 * SMALLEST_REACH:g} cm to the target side, beyond "
                f"their controls: {count_edits(names, len(edits))}"
            )
        names = [f"{row.name} {row.effect:.2f}" for row in localised]
        verb = "have" if any(row.is_dose for row in edits) else "carry"
        by_construction = f"; {apart} more {verb} it by construction and locate nothing (*)" * (apart > 0)
        count = count_edits(names, len(edits) - apart)
        return f"edits that {verb} half of the image swap's effect: {count}{by_construction}"

    @staticmethod
    def finding(rows: Sequence[PatchEffect], context: TableContext) -> str:
        """Return where half of the swap's effect was found, or that no edit has it."""
        del context
        edits, localised, apart = _carriers(rows)
        tried, steered = len(edits) - apart, any(row.is_dose for row in edits)
        if all(row.effect is None for row in edits):
            moving = _moving(edits)
            nothing = "not moved: neither the image swap nor any edit moves the action beyond chance"
            return f"moved: to the target side by {share_of_edits(moving, tried)}" if moving else nothing
        if localised:
            what = "steered: half of the image swap's effect by" if steered else "located: half of it passes in"
            return f"{what} {share_of_edits(localised, tried)}"
        if not tried:
            return "not located: all edits carry the effect by construction, which locates nothing"
        verdict = "not steered" if steered else "not located"
        return f"{verdict}: no edit of {tried} has half of the image swap's effect"

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the stored ones of which any number is in a map, a direction or a steering."""
        return keys_in_use(run)


KIND = Interchange
_COLUMNS: Mapping[str, Any] = {
    "effect": lambda row: text_of(row.effect, missing="n/a") + "*" * (row.is_localised and row.is_by_construction),
    "net flip rate [95 %]": lambda row: interval_text(row.net, row.net_ci, "+.2f"),
    "left / right": lambda row: f"{row.net_left:+.2f} / {row.net_right:+.2f}",
    "displacement cm": lambda row: f"{100 * row.mean_displacement:+.2f}",
    "controls cm": lambda row: text_of(_cm(row.control_displacement), "+.2f"),
    "p": lambda row: text_of(row.p_fwe, ".2g"),
    "relative change": lambda row: f"{row.relative_change:.2f}",
}


_WITHOUT_SIDES: Mapping[str, Any] = {
    "effect": _COLUMNS["effect"],
    "nearer to the source [95 %]": _COLUMNS["net flip rate [95 %]"],
    "displacement": lambda row: f"{row.mean_displacement:+.2f}",
    "controls": lambda row: text_of(row.control_displacement, "+.2f"),
    "p": _COLUMNS["p"],
    "relative change": _COLUMNS["relative change"],
}
"""Displacements are in spreads of clean actions, toward the source's action."""


def _cm(metres: float | None) -> float | None:
    return None if metres is None else 100 * metres


def _carriers(rows: Sequence[PatchEffect]) -> tuple[list[PatchEffect], list[PatchEffect], int]:
    """Return edits, those with half of the effect, the largest first, and how many have it by construction.

    What carries the swap in every policy locates nothing (`*` in the table), so that it counts apart.
    """
    edits = [row for row in rows if row.coefficient != "0"]
    by_construction = [row for row in edits if row.is_localised and row.is_by_construction]
    localised = [row for row in edits if row.is_localised and not row.is_by_construction]
    return edits, sorted(localised, key=lambda row: -(row.effect or 0.0)), len(by_construction)


def _moving(edits: Sequence[PatchEffect]) -> list[PatchEffect]:
    """Return the edits that move the action beyond chance, the farthest first."""
    return sorted((row for row in edits if row.moves_action), key=lambda row: -row.mean_displacement)
