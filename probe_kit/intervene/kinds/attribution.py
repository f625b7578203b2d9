"""Attribution patching: gradients estimate which patches matter, and exact patches check the estimates.

The estimates order the cells. Some cells with a sure effect, the anchors, are patched exactly: if gradients miss
one of them, the order is void. The result enters no verdict.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._tables.content import Cell as TableCell
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.declared import InterventionKind
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edited_cells import ESTIMATE, EXACT, EditedCell
from probe_kit.intervene.exchange import pooled_share
from probe_kit.intervene.kinds.base import (
    EffectColumn,
    Intervention,
    edits_by_category,
    effect_table,
    interval_cell,
    is_resolved,
    lines_of,
    p_of,
)
from probe_kit.intervene.kinds.interchange import cells_at, check_roles_apart, patch_of
from probe_kit.intervene.outcomes import CLEAN, ConditionOutcomes
from probe_kit.intervene.patching.attribution import (
    AGREEMENT,
    AttributionEffect,
    CellName,
    Ends,
    complete_cuts,
    describe_screen,
    describe_void,
    estimate_patches,
    kind_of_place,
    screen_rows,
    worst_anchor,
)
from probe_kit.intervene.patching.patch import Cell, sites_of_cells
from probe_kit.intervene.places import ALL, resolve_all
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.settings import FIRST_CHUNK
from probe_kit.intervene.stored import Measurement
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.sessions import ReplaySession

NAME = "attribution"
SITES = (f"{KV_STREAM}.*", "backbone.*")
"""Beginnings of the names of conditions, such as `exact|kv.02|image`."""
TOP = 20
"""Number of cells of each kind and category with the largest estimates, which are patched exactly.

As many are drawn from the others.
"""


def _estimate_condition(cell: Cell, by_row: Mapping[tuple[int, int], float]) -> Condition:
    """Return a condition without an inference: the clean action, and the displacement estimated for a cell.

    Args:
        cell: Cell whose patch is estimated.
        by_row: Displacement by row and step of the run.
    """

    def play(context: ConditionContext) -> ConditionResult:
        return ConditionResult(context.clean, estimated=by_row[context.pair.row, context.pair.step])

    return Condition.of_cell(EditedCell(cell.site_group.name, cell.role, part=ESTIMATE), play)


@dataclass(frozen=True, kw_only=True)
class AttributionPatching(Intervention):
    """An estimate for every cell, from one backward pass per episode, and exact patches of some of them.

    The anchors are patched exactly too: all of `kv`, and all tokens of each layer of the backbone with a cell.

    Attributes:
        sites: Patterns of the cells' places.
        roles: Roles of the cells' tokens.
        ends: Inputs at which gradients are taken, see `Ends`.
        top: Number of cells of each kind with the largest estimates that are patched exactly.
        controls: Number of further cells of each kind that are patched exactly, drawn from the others with `seed`.
        seed: Seed of the drawn cells.
    """

    kind: ClassVar[str] = NAME
    summary: ClassVar[str] = "Screen by gradients: which places to patch exactly?"
    position: ClassVar[int] = 5
    needs: ClassVar[tuple[InterventionKind, ...]] = ("edit", "gradients")
    fits_always: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "of the screened cells; default kv.*,backbone.*",
        "roles": "of the cells' tokens; default image,language,state",
        "controls": "cells drawn from the rest that are patched exactly as well; default 20",
        "seed": "of the drawn cells; default 0",
    }

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ("image", "language", "state")
    ends: Ends = "clean"
    top: int = TOP
    controls: int = TOP
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_roles_apart(self.roles, self.kind)
        if self.ends not in get_args(Ends) or self.top < 1:
            raise UsageError(
                f"ends is {self.ends!r} and top {self.top}; expected {' or '.join(get_args(Ends))}, and 1 or more"
            )
        if self.readout != FIRST_CHUNK:
            raise UsageError("gradients are of the first inference; leave --readout out")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind with its options, without `kv` where the family has none and no sites are named."""
        from probe_kit.hooks.registry import get_family

        family = get_family(run.model)
        if "sites" not in options and family is not None and not family.abilities.interventions.prompt_kv:
            options["sites"] = SITES[1:]
        return super().from_options(run, **options)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, images swapped, exact patches of anchors and chosen cells, and the estimates of all."""
        places = list(resolve_all(self.sites, session.policy).values())
        cells = cells_at(session, places, self.roles)
        anchors = complete_cuts(session.policy, places)
        every = [*anchors, *cells]
        rows, shares = self._estimates(session, every)
        top, drawn = self._select(cells, [values[len(anchors) :] for values in shares])
        patched, sites = {*anchors, *top, *drawn}, sites_of_cells(every)
        exact = [patch_of(cell, sites, EXACT) for cell in every if cell in patched]
        estimated = [
            _estimate_condition(cell, {at_row: float(by_cell[at]) for at_row, by_cell in rows.items()})
            for at, cell in enumerate(every)
        ]
        names = [str(EditedCell(cell.site_group.name, cell.role, part=EXACT)) for cell in every if cell in drawn]
        session.certificate[NAME] = {"drawn": names}
        return [CLEAN_RUN, SOURCE_RUN, *exact, *estimated]

    def _estimates(
        self, session: "ReplaySession", cells: Sequence[Cell]
    ) -> tuple[dict[tuple[int, int], NDArray[np.float64]], list[NDArray[np.float64]]]:
        """Return (C,) estimates by row and step of the run, and by category (C,) shares of the image swap."""
        rows: dict[tuple[int, int], NDArray[np.float64]] = {}
        swaps: dict[str, list[tuple[float, tuple[int, int]]]] = {}
        items = self.items_in(session.run)
        for number, item in enumerate(items):
            for pair in session.pairs(item):
                clean, moved, by_cell = estimate_patches(
                    session.policy, pair, cells, session.slope(pair), self.ends, session.act
                )
                before, after = (session.displacement(chunk, pair) for chunk in (clean, moved))
                rows[pair.row, pair.step] = by_cell
                swaps.setdefault(pair.category, []).append((after - before, (pair.row, pair.step)))
            if session.on_fit_progress is not None:
                session.on_fit_progress(number + 1, len(items), item)
        shares = []
        for part in swaps.values():
            swap = np.array([moved for moved, _ in part])
            estimates = np.array([rows[row] for _, row in part])
            shares.append(np.array([pooled_share(moved, swap) for moved in estimates.T]))
        return rows, shares

    def _select(self, cells: Sequence[Cell], shares: Sequence[NDArray[np.float64]]) -> tuple[set[Cell], set[Cell]]:
        """Return the cells with the largest estimates of any category, by kind, and those drawn from the rest."""
        top: set[Cell] = set()
        drawn: set[Cell] = set()
        kinds = [kind_of_place(cell.site_group.name) for cell in cells]
        for kind in dict.fromkeys(kinds):
            members = [at for at, other in enumerate(kinds) if other == kind]
            best = {at for values in shares for at in sorted(members, key=lambda at: -abs(values[at]))[: self.top]}
            remaining = [at for at in members if at not in best]
            # A seed per kind: what is drawn of one does not depend on which others are screened.
            draw = np.random.default_rng(derive_seed("attribution", self.seed, kind))
            top |= {cells[at] for at in best}
            drawn |= {cells[at] for at in draw.permutation(remaining)[: self.controls].tolist()}
        return top, drawn

    @staticmethod
    def effects(measurement: Measurement) -> list[AttributionEffect]:
        """Return by category the anchors, then the cells of each kind: by rank, or in their order."""
        drawn = frozenset(measurement.certificate.get(NAME, {}).get("drawn", []))
        return measurement.rows(lambda part: _rows(part, drawn))

    @staticmethod
    def table(rows: Sequence[AttributionEffect], context: Measurement) -> "Table":
        """Return one line per category and cell."""
        void = [
            f"{name}: {describe_void(part)}"
            for name, part in edits_by_category(rows).items()
            if part[0].finding == "void"
        ]
        return effect_table(
            "; ".join([f"Which places to patch? {context.subject}, gradients", *void]),
            ("category", "cell"),
            lines_of(rows, lambda row: row.name),
            {f"Share of the {context.exchange}": _columns(context.exchange)},
            lambda row: row.is_anchor,
            after=["a screen enters no verdict"],
        )

    @staticmethod
    def sentence(rows: Sequence[AttributionEffect], context: Measurement) -> str:
        """Return what the screen ranks first, and whether it holds."""
        del context
        return describe_screen(rows)

    @staticmethod
    def finding(rows: Sequence[AttributionEffect], context: Measurement) -> str:
        """Return whether the screen holds, and which cell it ranks first."""
        del context
        worst = worst_anchor(rows)
        if worst is None:
            return "no order: no anchor carries the effect, so that nothing tests the estimates"
        if worst.finding == "void":
            return f"void: gradients miss the effect at {worst.name} by more than a factor of 3; patch instead"
        first = max((row for row in rows if row.rank == 1), key=lambda row: abs(row.estimate or 0.0))
        share = f"{first.estimate or 0.0:z.2f} of the effect"
        return f"ordered: gradients agree with patches; {first.name} comes first with {share}"


KIND = AttributionPatching


def _columns(exchange: str) -> tuple[EffectColumn[AttributionEffect], ...]:
    """Return the columns of a screen; `exchange` is the change of inputs of which effects are shares."""
    return (
        EffectColumn("rank", lambda row: TableCell(row.rank)),
        EffectColumn(
            "estimate [95 %]",
            lambda row: interval_cell(row.estimate, row.estimate_ci),
            f"estimate: share of the {exchange} that gradients predict for a patch of these tokens",
        ),
        EffectColumn(
            "exact [95 %]",
            lambda row: interval_cell(row.exact, row.exact_ci),
            "exact: the same share with these tokens patched for real",
        ),
        EffectColumn(
            "p",
            lambda row: p_of(row.p_fwe, is_resolved(row.exact)),
            "p: of the exact patch, family-wise over those of the category",
        ),
        EffectColumn(
            "chosen",
            lambda row: (
                "anchor" if row.is_anchor else "drawn" if row.is_drawn else "top" if row.p_fwe is not None else ""
            ),
            "anchor: a complete cut, patched exactly; a screen that misses an anchor by more than a factor of "
            f"{AGREEMENT:.0f} is void and shows no order; drawn: chosen at random from the rest",
        ),
    )


def _rows(outcomes: ConditionOutcomes, drawn: Collection[str]) -> list[AttributionEffect]:
    """Return the rows of one category; `drawn` has the names of conditions with drawn cells."""
    clean, exchange = outcomes.of(CLEAN), outcomes.exchange()
    assert exchange is not None
    moved: dict[str, dict[CellName, NDArray[np.float64]]] = {ESTIMATE: {}, EXACT: {}}
    for name, cell in zip(outcomes.conditions, outcomes.cells, strict=True):
        if cell.part:
            moved[cell.part][cell.site, cell.role] = outcomes.of(name) - clean
    anchors = [cell for cell in moved[ESTIMATE] if cell[1] == ALL]
    at_random = [cell for cell in moved[EXACT] if str(EditedCell(*cell, part=EXACT)) in drawn]
    return screen_rows(exchange, moved[ESTIMATE], moved[EXACT], anchors, at_random, str(outcomes.categories[0]))
