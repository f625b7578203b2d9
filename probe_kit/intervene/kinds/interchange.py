"""Interchange (activation patching) at places, and what a run's stored edits show inside the network.

Tokens are replaced by those of the same inference with swapped images. This policy computes such tokens itself in
this state, so a patch stays on its own distribution and has no strength to choose. A patch can do no more than the
image swap: if all that differs is patched, the effect is 1.

Effects have a sign. The *target side* is the side on which the correct picture lies after the swap; of a steering,
it is the side that is steered to. How often actions flip is no evidence alone, because some flip away from that
side. So flips away are subtracted. Full patches, patches along directions and steering have rows of their own.
Family-wise p-values are against everything that was tried in the same stream on the same episodes, in one
intervention or in several.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from probe_kit._system.types import Matrix
from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.numbers import number, with_sign
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import KV_STREAM, Site
from probe_kit.intervene.edited_cells import SEPARATOR, EditedCell
from probe_kit.intervene.exchange import share_fields, share_of_whole
from probe_kit.intervene.kinds.base import (
    NONE,
    UNRESOLVED,
    AlongDirection,
    EffectColumn,
    EffectRow,
    centimetres,
    common_columns,
    compare_with_controls,
    count_edits,
    effect_table,
    is_resolved,
    lines_of,
    mean_of,
    p_of,
    share_of_edits,
    signed_interval,
)
from probe_kit.intervene.kinds.image_swap import SMALLEST_REACH
from probe_kit.intervene.outcomes import CLEAN, IMAGE_SWAP, UNCHANGED, ConditionOutcomes
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.patching.patch import Cell, sites_of_cells
from probe_kit.intervene.places import ALL, RESIDUAL, TILES, PlaceName, SiteGroup, resolve_all, roles_of
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, patched_run
from probe_kit.intervene.stored import Measurement, PooledConditions, Rank, pool_conditions, stored_results
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run import Run
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.directions import Directions
    from probe_kit.intervene.sessions import ReplaySession


# -- effects of edits at places ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PatchEffect(EffectRow):
    """The effect of an edit at one place, in one category; see `EffectRow`.

    Here `net` is the share of episodes whose action flips to the target side, minus those that flip away from it.
    The test is one-sided, by sign flips of whole groups; for an interchange it is in the direction of the swap
    itself.

    Attributes:
        coefficient: Coefficient of steering, as text; empty for other edits.
        effect: Share of what the whole image swap does to where the action goes, toward the target side. None if
            the swap does nothing, so that a share would be a ratio of noise.
        effect_ci: The 95 % interval of `effect`, by groups; None likewise.
        net_left: The same as `net`, of episodes with the target side left.
        net_right: The same as `net`, of episodes with the target side right.
        mean_displacement: Metres toward the target side.
        control_displacement: Metres toward the target side of its matched controls, on average; None without any.
        t: Statistic of the displacement beyond the controls'.
        p: The p-value of the same; None for rows that are not tested.
        p_fwe: Family-wise p-value, against the largest t of all edits of the category; None likewise.
        action_share: Displacement toward the source's action as a share of the whole image swap's; None where that
            changes nothing.
        action_share_ci: The 95 % interval of `action_share`, by groups; None likewise.
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
    def is_resolved(self) -> bool:
        """Whether it turns any episode, or its effect is as large as the resolution of the measure."""
        centimetres = 100 * self.mean_displacement if self.effect is None else None
        return is_resolved(self.net, self.net_left, self.net_right, self.effect, centimetres)

    @property
    def is_significant(self) -> bool:
        """Whether it has an effect beyond chance among all that was tried, and one that the measure resolves."""
        return self.is_resolved and self.p_fwe is not None and self.p_fwe < SIGNIFICANCE

    @property
    def is_localised(self) -> bool:
        """Whether it carries half of the effect, beyond chance among all that was tried."""
        return self.is_significant and self.effect is not None and self.effect >= LOCALISATION_SHARE

    @property
    def moves_action(self) -> bool:
        """Whether it moves the action to the target side beyond chance, and by the smallest reach of a policy."""
        return self.is_significant and self.mean_displacement >= SMALLEST_REACH

    @property
    def is_dose(self) -> bool:
        """Whether it is a steering by more than nothing."""
        return self.coefficient not in ("", "0")

    @property
    def is_by_construction(self) -> bool:
        """Whether its place carries the effect in every policy that acts on the images, and so locates nothing.

        The first layer of the backbone contains the swapped images themselves, and the acting stream the action.
        """
        parsed = PlaceName.parse(self.sites)
        is_first = parsed.stream == BACKBONE and parsed.layer == 0 and parsed.quantity in ("", RESIDUAL)
        return parsed.stream not in (BACKBONE, KV_STREAM) or is_first

    @property
    def name(self) -> str:
        """The edit in a few words."""
        return " ".join(filter(None, (super().name, self.coefficient and f"coefficient {self.coefficient}")))


def target_sign(outcomes: ConditionOutcomes, target_side: str) -> Matrix:
    """Return (E,) the target side of every episode, +1 for left."""
    correct = outcomes.correct_sign
    sides = {"left": np.ones_like(correct), "right": -np.ones_like(correct), "correct": correct}
    # `wrong`, and the image swap, after which the correct picture lies on the other side.
    return sides.get(target_side, -correct)


def patch_effects(outcomes: ConditionOutcomes, target_side: str = IMAGE_SWAP) -> list[PatchEffect]:
    """Return one row per edit, of one category.

    Args:
        outcomes: Outcomes of one category.
        target_side: Name of the target: `image_swap`, or the side that is steered to.
    """
    rows = [row for row, name in enumerate(outcomes.conditions) if name not in UNCHANGED]
    if not rows:
        return []
    push, clean, has_swap = (
        target_sign(outcomes, target_side),
        outcomes.of(CLEAN),
        IMAGE_SWAP in outcomes.conditions,
    )
    # Above zero on the left; without sides, where the action is nearer to the source's.
    middle = 0.0 if outcomes.is_scene or not has_swap else outcomes.of(IMAGE_SWAP) / 2
    toward = None if outcomes.toward is None or not has_swap else outcomes.toward
    cells = [outcomes.cells[row] for row in rows]
    displacements = push * (outcomes.displacement[rows] - clean)
    exchange = outcomes.exchange()
    sign = 1.0 if exchange is None or target_side != IMAGE_SWAP else exchange.sign
    tests = compare_with_controls(sign * displacements, cells, outcomes)
    effects = []
    for row, cell, test, moved in zip(rows, cells, tests, displacements, strict=True):
        # 1 where the action flips to the target side, −1 where it flips away from it.
        is_over = push * (outcomes.displacement[row] - middle) > 0
        flips = is_over.astype(float) - (push * (clean - middle) > 0)
        # The swap moves actions to the wrong side; steering to another side is compared with its size.
        share = None if exchange is None else exchange.share(-outcomes.correct_sign * moved)
        exchanged = None
        if toward is not None:
            full = toward[outcomes.conditions.index(IMAGE_SWAP)]
            exchanged = share_of_whole(toward[row], full, outcomes.groups, outcomes.seed_text)
        effects.append(
            PatchEffect(
                **common_columns(outcomes, row, cell, flips),
                coefficient=cell.coefficient,
                **share_fields("effect", share),
                net_left=mean_of(flips[push > 0]) or 0.0,
                net_right=mean_of(flips[push < 0]) or 0.0,
                mean_displacement=float(moved.mean()),
                control_displacement=mean_of(displacements[test.controls]),
                t=test.t or 0.0,
                p=test.p,
                p_fwe=test.p_fwe,
                **share_fields("action_share", exchanged),
            )
        )
    return effects


# -- what is stored ------------------------------------------------------------------------------------------


BACKBONE = "backbone"
USUAL, WRONG = "mean-difference", "wrong"
"""Default settings of steering: the direction of the class means, and the side."""
FOUND_DIRECTIONS = (USUAL, "probe")
"""The directions that are found in a run, which may be followed by `:K`; all others are of files."""


def stored_site_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return the maps by category: the effects of tokens patched in full, a row for every place and role.

    The backbone comes first and `kv` last, shallow before deep.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    return _by_category(_maps(run))


def stored_subspace_effects(run: RunReader) -> dict[str, list[PatchEffect]]:
    """Return by category the effects of patches along single directions, and along their random controls."""
    return _by_category(_along(run))


def stored_steering(run: RunReader) -> dict[str, dict[str, list[PatchEffect]]]:
    """Return by category and place (`backbone.02 image`) the effects of steering, all coefficients and controls.

    Steering along another direction than that of the class means, or to another side than the wrong one, has a key
    of its own (`backbone.02 image, probe, toward left`).
    """
    steering: dict[str, dict[str, list[PatchEffect]]] = {}
    for selection, rows in _rows_of(_steering(run)):
        cell, settings = selection.first, selection.group.like.stored.settings
        direction, side = str(settings.get("direction", USUAL)), str(settings.get("target_side", WRONG))
        along = "" if direction == USUAL else direction
        toward = "" if side == WRONG else f"toward {side}"
        subject = ", ".join(filter(None, (f"{cell.site} {cell.role}", along, toward)))
        steering.setdefault(selection.group.like.category, {})[subject] = rows
    return steering


def localised_sites(rows: Sequence[PatchEffect]) -> tuple[str, ...]:
    """Return the places, each once, that carry half of the effect or more when their tokens are patched in full.

    Places of `kv` have the role of the tokens (`kv.01 language`), unless only all of a block together carry it.
    Places that carry it by construction are left out.
    """
    localised = [row for row in rows if row.is_localised and not row.direction and not row.is_by_construction]
    read = KV_STREAM + "."
    by_role = {row.sites for row in localised if row.role != ALL and row.sites.startswith(read)}
    names = [
        row.name if row.sites in by_role else row.sites
        for row in localised
        if row.sites not in by_role or row.role != ALL
    ]
    return tuple(dict.fromkeys(names))


def is_backbone_layer(row: PatchEffect) -> bool:
    """Whether the backbone's stream itself was patched, not a part of a block such as one head."""
    name = PlaceName.parse(row.sites)
    return name.stream == BACKBONE and name.is_whole_layer


def localised_by_category(maps: Mapping[str, Sequence[PatchEffect]]) -> dict[str, tuple[str, ...]]:
    """Return by category `localised_sites` of `stored_site_effects`; without categories that were not searched.

    A category counts as searched if all tokens of some layer of the backbone were patched, or if a place was
    found. A null result for one role, iteration or block does not rule out the others.
    """
    localised = {category: localised_sites(rows) for category, rows in maps.items()}
    return {
        category: places
        for category, places in localised.items()
        if places or any(row.role == ALL and is_backbone_layer(row) for row in maps[category])
    }


def carrying_directions(along: Mapping[str, Sequence[PatchEffect]]) -> dict[str, tuple[tuple[str, str], ...]]:
    """Return by category the directions that carry half of the effect, beyond random ones, each with its place.

    A place is spelt `backbone.02 image`.

    Args:
        along: Effects by category, as `stored_subspace_effects` gives them.
    """
    return {
        category: tuple(
            (row.direction, f"{row.sites} {row.role}")
            for row in rows
            if row.is_localised and row.control_displacement is not None
        )
        for category, rows in along.items()
    }


class _Selection(NamedTuple):
    """The conditions that stand for a subject.

    Attributes:
        merit: Key by which one of several selections is chosen, the largest one.
    """

    group: PooledConditions
    conditions: tuple[str, ...]
    merit: tuple[Rank, int, tuple[str, str]]

    @property
    def first(self) -> EditedCell:
        """The cell of its first condition; all are of one place and role."""
        return self.group.cells[self.conditions[0]]


def _maps(run: RunReader) -> list[_Selection]:
    results = stored_results(run, Interchange.kind)
    in_full = [result for result in results if result.stored.settings.get("direction", NONE) == NONE]
    return _selections(pool_conditions(in_full), ())


def _along(run: RunReader) -> list[_Selection]:
    results = stored_results(run, Interchange.kind)
    along = [result for result in results if result.stored.settings.get("direction", NONE) != NONE]
    return _selections(pool_conditions(along, ("direction", "seed")), ("direction",))


def _steering(run: RunReader) -> list[_Selection]:
    pooled = pool_conditions(stored_results(run, "steer"), ("direction", "seed", "target_side"))
    return _selections(pooled, ("direction", "target_side"))


def _selections(groups: Sequence[PooledConditions], setting: Sequence[str]) -> list[_Selection]:
    """Return one selection per category, place, role and values of these settings, by depth within a category."""
    selected: dict[str, dict[tuple[str, ...], _Selection]] = {}
    for group in groups:
        values = [str(group.like.stored.settings.get(name)) for name in setting]
        by_subject = selected.setdefault(group.like.category, {})
        by_place: dict[tuple[str, str], list[str]] = {}
        for condition in sorted(group.sources):  # controls and coefficients among them
            cell = group.cells[condition]
            by_place.setdefault((cell.site, cell.role), []).append(condition)
        for subject, conditions in by_place.items():
            newest = max(group.sources[name].stored.newest for name in conditions)
            candidate = _Selection(group, tuple(conditions), (group.like.rank, len(conditions), newest))
            before = by_subject.setdefault((*subject, *values), candidate)
            if before.merit < candidate.merit:
                by_subject[*subject, *values] = candidate
    return [by_subject[subject] for by_subject in selected.values() for subject in sorted(by_subject, key=_depth)]


def _rows_of(selections: Sequence[_Selection]) -> Iterator[tuple[_Selection, list[PatchEffect]]]:
    """Yield each selection with its effects, tested against all that its group tried in the same stream."""
    tested: dict[tuple[int, str], dict[str, PatchEffect]] = {}
    for selection in selections:
        group, stream = selection.group, PlaceName.parse(selection.first.site).stream
        at = id(group), stream
        if at not in tested:
            conditions = sorted(
                name for name in group.sources if PlaceName.parse(group.cells[name].site).stream == stream
            )
            target_side = str(group.like.stored.settings.get("target_side", IMAGE_SWAP))
            rows = patch_effects(group.outcomes(conditions), target_side)
            keys = [group.sources[name].stored.key for name in conditions]
            tested[at] = {
                name: replace(row, key=key) for name, row, key in zip(conditions, rows, keys, strict=True)
            }
        yield selection, [tested[at][name] for name in selection.conditions]


def _by_category(selections: Sequence[_Selection]) -> dict[str, list[PatchEffect]]:
    effects: dict[str, list[PatchEffect]] = {}
    for selection, rows in _rows_of(selections):
        effects.setdefault(selection.group.like.category, []).extend(rows)
    return effects


def _depth(subject: tuple[str, ...]) -> tuple[object, ...]:
    """Return a sort key: backbone, acting stream, then `kv`; shallow before deep, all tokens before roles."""
    site, role, *values = subject
    name = PlaceName.parse(site)
    part = {BACKBONE: 0, KV_STREAM: 2}.get(name.stream, 1)
    return part, name.stream, *name.depth, role != ALL, role, *values


def best_patch_targets(run: RunReader, categories: Sequence[str]) -> tuple[str, ...]:
    """Return `PLACE|ROLE` by category: the last located place of the backbone, in the role of the largest effect.

    The last place lies behind all other places through which the answer passes. Where none of the backbone was
    located, it is the last of the acting stream or of `kv`. Of its roles it has the one with the largest effect,
    and all tokens only where no single role carries half of it.

    Raises:
        UsageError: If none was located.
    """
    stored = stored_site_effects(run)
    best = [best_cell(stored.get(category, [])) for category in categories]
    cells = tuple(dict.fromkeys(f"{cell.sites}{SEPARATOR}{cell.role}" for cell in best if cell is not None))
    if not cells:
        raise UsageError(
            f"no stored interchange of {run.location} located a place of {', '.join(categories)}: run "
            "`probe-kit intervene RUN --kind interchange` first, or name --sites and --roles"
        )
    return cells


def best_cell(rows: Sequence[PatchEffect]) -> PatchEffect | None:
    """Return the patch behind which nothing of the answer passes, of one category; see `best_patch_targets`."""
    located = [row for row in rows if row.is_localised and not row.direction]
    if not located:
        return None
    deepest = ([row for row in located if is_backbone_layer(row)] or located)[-1]
    last = [row for row in located if row.sites == deepest.sites]
    return max(last, key=lambda row: (row.role != ALL, row.effect or 0.0))


# -- the kind ------------------------------------------------------------------------------------------------


def cells_at(session: "ReplaySession", places: Iterable[SiteGroup], roles: Sequence[str]) -> list[Cell]:
    """Return the cells of these roles at places, for the roles that tokens there have."""
    return [
        Cell(site_group, role)
        for site_group in places
        for role in roles_of(session.policy, site_group.stream, roles)
    ]


def patch_of(cell: Cell, source_sites: tuple[Site, ...], part: str = "") -> Condition:
    """Return the patch of one cell in full.

    Args:
        cell: Cell that is patched.
        source_sites: Sites at which the source is captured.
        part: What the kind does with it, see `EditedCell`.
    """
    return patched_run(EditedCell(cell.site_group.name, cell.role, part=part), {"": (cell,)}, source_sites)


def patches_within(
    direction: str, bases: "Directions", cell: Cell, source_sites: tuple[Site, ...]
) -> list[Condition]:
    """Return the patch along a direction, and along each of its controls."""
    return [
        patched_run(EditedCell(cell.site_group.name, cell.role, name), {"": (cell,)}, source_sites, name, bases)
        for name in (direction, *bases.control_names)
    ]


def check_roles_apart(roles: Sequence[str], kind: str) -> None:
    """Refuse roles that share tokens: sets of such cells would patch tokens twice.

    Raises:
        UsageError: If the role `all` is among others.
    """
    if ALL in roles:
        raise UsageError(f"--kind {kind} needs roles that share no token; leave all out")


class PatchKind(AlongDirection):
    """A kind whose rows are `PatchEffect`: interchange or steering."""

    asks_where: ClassVar[bool] = True

    @staticmethod
    def effects(measurement: Measurement) -> list[PatchEffect]:
        """Return one row per category and edit."""
        target_side = str(measurement.settings.get("target_side", IMAGE_SWAP))
        return measurement.rows(lambda part: patch_effects(part, target_side))

    @staticmethod
    def table(rows: Sequence[PatchEffect], context: Measurement) -> "Table":
        """Return one line per category and edit; controls are columns of the edits that are compared with them."""
        unread = context.certificate.get("unread", ())
        edits = [row for row in rows if not row.is_control]
        return effect_table(
            f"Where is it used? {context.subject}, {context.kind}",
            ("category", "edit"),
            lines_of(edits, lambda row: f"{row.name}{' (unread)' if row.sites in unread else ''}"),
            {"What the action does": _columns(context.exchange, context.is_scene)},
            lambda row: row.is_localised and not row.is_by_construction,
            marks={BY_CONSTRUCTION: "carries the effect by construction and locates nothing"},
            after=["unread: nothing that acts reads this place", legend_of_doses(edits), legend_of_p(edits)],
        )

    @staticmethod
    def sentence(rows: Sequence[PatchEffect], context: Measurement) -> str:
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
        by_construction = f"; {apart} more {verb} it by construction and locate nothing (*)" if apart else ""
        count = count_edits(names, len(edits) - apart)
        return f"edits that {verb} half of the {context.exchange}'s effect: {count}{by_construction}"

    @staticmethod
    def finding(rows: Sequence[PatchEffect], context: Measurement) -> str:
        """Return where half of the swap's effect was found, or that no edit has it."""
        edits, localised, apart = _carriers(rows)
        tried, steered = len(edits) - apart, any(row.is_dose for row in edits)
        if all(row.effect is None for row in edits):
            moving = _moving(edits)
            nothing = f"not moved: neither the {context.exchange} nor any edit moves the action beyond chance"
            return f"moved: to the target side by {share_of_edits(moving, tried)}" if moving else nothing
        if localised:
            what = (
                f"steered: at least half of the {context.exchange}'s effect by"
                if steered
                else "located: at least half of the effect passes in"
            )
            return f"{what} {share_of_edits(localised, tried)}"
        if not tried:
            return "not located: all edits lie where the whole effect must pass, so that no place is shown"
        verdict = "not steered" if steered else "not located"
        return f"{verdict}: none of {tried} edits has half of the {context.exchange}'s effect"

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the stored interventions with any number in a map, a direction or a steering."""
        every = [*_maps(run), *_along(run), *_steering(run)]
        return {selection.group.sources[name].stored.key for selection in every for name in selection.conditions}


@dataclass(frozen=True, kw_only=True)
class Interchange(PatchKind):
    """An interchange that tries every place at every role, alone.

    Attributes:
        sites: Patterns of places, see `resolve_sites`.
        roles: Roles of the patched tokens; a stream is tried at those that it has.
        direction: Name of the direction within which alone tokens are patched, see `AlongDirection`; `none` to
            patch in full.
        controls: Number of random subspaces of the same rank, per place and role.
    """

    kind: ClassVar[str] = "interchange"
    summary: ClassVar[str] = "Activation patching: where does the swapped image pass?"
    position: ClassVar[int] = 3
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
        super().__post_init__()
        if set(self.roles) & set(TILES) and self.direction != NONE:
            raise UsageError(
                "tiles have no mean in the run from which a direction could be found; patch them in full: leave "
                "--direction out"
            )

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind with five controls where a direction is given and their number is not."""
        options.setdefault("controls", 5 if "direction" in options else 0)
        return super().from_options(run, **options)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, images swapped, and every place at every role.

        Raises:
            NoProbesError: For a direction of probes in a run without them.
            UnknownSiteError: For a place that does not exist.
            NoDirectionError: For a named place without a direction.
        """
        cells = cells_at(session, resolve_all(self.sites, session.policy).values(), self.roles)
        source_sites = sites_of_cells(cells)
        conditions = [CLEAN_RUN, SOURCE_RUN]
        if self.direction == NONE:
            return conditions + [patch_of(cell, source_sites) for cell in cells]
        bases = self.fit_directions(session, cells, self.sites)
        for cell, basis in bases.items():
            conditions += patches_within(self.direction, basis, cell, source_sites)
        return conditions


KIND = Interchange
BY_CONSTRUCTION = "*"
"""The mark of an effect that an edit has by construction."""


def _share(effect: float | None) -> str:
    """Return a share of the exchange's effect; n/a where that is not beyond chance."""
    return "n/a" if effect is None else number(effect)


def _columns(exchange: str, is_scene: bool) -> list[EffectColumn[PatchEffect]]:
    """Return the columns of edits.

    Args:
        exchange: The change of inputs of which effects are shares.
        is_scene: Whether displacements are in cm toward a side. Else they are in spreads of clean actions, toward
            the source's action.
    """
    effect = EffectColumn[PatchEffect](
        "effect",
        lambda row: TableCell(
            row.effect, _share, after=BY_CONSTRUCTION if row.is_localised and row.is_by_construction else ""
        ),
        f"effect: share of what the whole {exchange} does, n/a where that is not beyond chance",
    )
    p = EffectColumn[PatchEffect](
        "p",
        lambda row: p_of(row.p_fwe, row.is_resolved),
        "p: family-wise over all edits of the category, one-sided",
    )
    change = EffectColumn[PatchEffect](
        "relative change",
        lambda row: TableCell(row.relative_change, number),
        "relative change: how far tokens were moved, as a share of their norm",
    )
    if not is_scene:
        return [
            effect,
            EffectColumn(
                "nearer to the source [95 %]",
                _net,
                "nearer to the source: share of episodes whose action is nearer to the source's than to the clean "
                "one",
            ),
            EffectColumn(
                "displacement",
                lambda row: TableCell(row.mean_displacement, with_sign),
                "displacement: toward the source's action, in spreads (standard deviations) of the clean actions",
            ),
            EffectColumn(
                "controls",
                lambda row: TableCell(row.control_displacement, with_sign),
                "controls: the mean displacement of random directions",
            ),
            p,
            change,
        ]
    return [
        effect,
        EffectColumn(
            "net flip rate [95 %]",
            _net,
            "net flip rate: share of episodes that flip to the target side, minus those that flip away from it",
        ),
        EffectColumn(
            "left / right", lambda row: TableCell(row.net_left, with_sign, after=f" / {with_sign(row.net_right)}")
        ),
        EffectColumn("displacement cm", lambda row: centimetres(row.mean_displacement, with_sign)),
        EffectColumn("controls cm", lambda row: centimetres(row.control_displacement, with_sign)),
        p,
        change,
    ]


def _net(row: PatchEffect) -> TableCell:
    return signed_interval(row.net, row.net_ci)


HALF_DIFFERENCE, VECTOR = "half class-mean differences", "lengths of the file's vector"
"""Units of coefficients of steering: of a direction that was found in the run, and of one of a file."""


def unit_of_doses(direction: str) -> str:
    """Return the unit of the coefficients along a direction, by its name in conditions."""
    return HALF_DIFFERENCE if direction.partition(":")[0] in FOUND_DIRECTIONS else VECTOR


def legend_of_doses(rows: Sequence[PatchEffect]) -> str:
    """Return the entry of a legend on the unit of the coefficients; empty for edits without any."""
    units = dict.fromkeys(unit_of_doses(row.direction) for row in rows if row.is_dose and not row.is_control)
    return f"coefficient: in {' or '.join(units)}" if units else ""


def legend_of_p(rows: Sequence[PatchEffect]) -> str:
    """Return the entry of a legend on p-values that are not shown; empty if all are."""
    hidden = any(row.p_fwe is not None and not row.is_resolved for row in rows)
    return UNRESOLVED if hidden else ""


def _carriers(rows: Sequence[PatchEffect]) -> tuple[list[PatchEffect], list[PatchEffect], int]:
    """Return edits, those with half of the effect, the largest first, and how many have it by construction.

    A place that carries the swap in every policy locates nothing (`*` in the table), so that it counts separately.
    """
    edits = [row for row in rows if row.coefficient != "0"]
    by_construction = [row for row in edits if row.is_localised and row.is_by_construction]
    localised = [row for row in edits if row.is_localised and not row.is_by_construction]
    return edits, sorted(localised, key=lambda row: -(row.effect or 0.0)), len(by_construction)


def _moving(edits: Sequence[PatchEffect]) -> list[PatchEffect]:
    """Return the edits that move the action beyond chance, the farthest first."""
    return sorted((row for row in edits if row.moves_action), key=lambda row: -row.mean_displacement)
