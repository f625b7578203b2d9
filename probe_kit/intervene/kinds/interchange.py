"""Interchange intervention (activation patching): tokens are patched from the same inference with swapped images.

What is patched in is what this policy computes there in this state, so it is on the policy's own distribution, has
no strength to choose, and can do no more than the image swap: with all that differs patched, the effect is 1.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.kinds.base import (
    NONE,
    AlongDirection,
    ConditionName,
    Measurement,
    TableContext,
    count_edits,
    effect_table,
    interval_text,
    lines_of,
    share_of_edits,
    text_of,
)
from probe_kit.intervene.kinds.image_swap import SMALLEST_REACH
from probe_kit.intervene.kinds.site_maps import PatchEffect, keys_in_use, patch_effects
from probe_kit.intervene.outcomes import IMAGE_SWAP
from probe_kit.intervene.patching.patch import Cell, sites_of_cells
from probe_kit.intervene.places import ALL, SiteGroup, resolve_all, roles_of
from probe_kit.intervene.replay import CleanRun, Condition, Patched, SourceRun
from probe_kit.intervene.tokens import TILES
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.directions import DirectionBasis
    from probe_kit.intervene.sessions.session import ReplaySession


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
