"""Attribution patching: gradients order cells, exact patches check the order and anchor it. Enters no verdict."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import ALL, resolve_all, roles_of
from probe_kit.intervene.kinds.attribution.effects import (
    ESTIMATE,
    EXACT,
    Anchored,
    kind_of_place,
)
from probe_kit.intervene.kinds.attribution.screen import (
    ENDS,
    Ends,
    EpisodeEstimates,
    Estimated,
    complete_cuts,
    estimate_patches,
    shares_by_category,
)
from probe_kit.intervene.kinds.interchange.intervention import capabilities_for
from probe_kit.intervene.kinds.joint.cells import Cell, CellsPatched
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ImagesSwapped,
    Intervention,
    ReplayBatch,
)
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.store.settings import FIRST_CHUNK, items_of
from probe_kit.runs.run import Run

SITES, ROLES = (f"{KV_STREAM}.*", "backbone.*"), ("image", "language", "state")
TOP = 20
"""Cells of each kind and category with the largest estimates, that are patched exactly; as many are drawn."""


@dataclass(frozen=True)
class DrawnCells(CleanRun):
    """The clean condition, with which cells were drawn. names: of their conditions."""

    names: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AttributionPatching(Intervention):
    """An estimate for every cell, from one backward pass per episode, and exact patches of some of them.

    sites, roles: of the cells. ends: where gradients are taken, see `Ends`. top: cells of each kind with the
    largest estimates that are patched exactly; controls: so many more, drawn from the rest with `seed`. The
    anchors are patched exactly too: all of `kv`, and all tokens of each layer of the backbone with a cell.
    """

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ROLES
    ends: Ends = "clean"
    top: int = TOP
    controls: int = TOP
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sites or not self.roles or ALL in self.roles:
            raise UsageError("attribution needs at least one site, and roles that share no token (not all)")
        if self.ends not in ENDS or self.top < 1:
            raise UsageError(
                f"ends is {self.ends!r} and top {self.top}; expected {' or '.join(ENDS)}, and 1 or more"
            )
        if self.readout != FIRST_CHUNK:
            raise UsageError("gradients are of the first inference; leave --readout out")

    @property
    def kind(self) -> str:
        """`attribution`."""
        return "attribution"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """As of an interchange, and gradients."""
        return (*capabilities_for(self.sites, self.roles), "gradients")

    @property
    def fits_first(self) -> bool:
        """The estimates come first."""
        return True

    def parameters(self) -> dict[str, Any]:
        """Which cells, and how many are patched."""
        return {
            "sites": list(self.sites), "roles": list(self.roles), "ends": self.ends, "top": self.top,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, images swapped, exact patches of anchors and chosen cells, and the estimates of all."""
        places = resolve_all(self.sites, session.policy)
        cells = [
            Cell(place, role)
            for place in places.values()
            for role in roles_of(session.policy, place.stream, self.roles)
        ]
        anchors = complete_cuts(session.policy, list(places.values()))
        every = [*anchors, *cells]
        rows, found = self._estimates(session, every)
        top, drawn = self._chosen(cells, shares_by_category(found), len(anchors))
        sites = tuple(dict.fromkeys(site for cell in every for site in cell.place.sites))
        exact = [
            CellsPatched(name_of(EXACT, cell), {"": (cell,)}, sites)
            for cell in every
            if cell in anchors or cell in top or cell in drawn
        ]
        estimated = [
            Estimated(
                name_of(ESTIMATE, cell),
                {row: float(one.by_cell[at]) for row, one in zip(rows, found, strict=True)},
            )
            for at, cell in enumerate(every)
        ]
        names = tuple(name_of(EXACT, cell) for cell in drawn)
        return [DrawnCells(names=names), ImagesSwapped(), *exact, *estimated]

    def certificate_entries(self, conditions: Sequence[Condition], found: ReplayBatch) -> dict[str, Any]:
        """The cells that were drawn."""
        del found
        (clean,) = (one for one in conditions if isinstance(one, DrawnCells))
        return {Anchored.ENTRY: {"drawn": list(clean.names)}}

    def _estimates(
        self, session: ReplaySession, cells: Sequence[Cell]
    ) -> tuple[list[int], list[EpisodeEstimates]]:
        """Rows of the run's episodes, and the estimates of each."""
        rows: list[int] = []
        found: list[EpisodeEstimates] = []
        items = items_of(session.run, self)
        for number, item in enumerate(items):
            for one in session.replay_inputs(item):
                rows.append(one.row)
                found.append(estimate_patches(session, one, cells, self.ends))
            if session.on_fit_progress is not None:
                session.on_fit_progress(number + 1, len(items), item)
        return rows, found

    def _chosen(
        self, cells: Sequence[Cell], shares: dict[str, NDArray[np.float64]], skipped: int
    ) -> tuple[list[Cell], list[Cell]]:
        """Those with the largest estimates of any category, by kind, and those that are drawn from the rest."""
        top: list[Cell] = []
        drawn: list[Cell] = []
        kinds = [kind_of_place(cell.place.name) for cell in cells]
        for kind in dict.fromkeys(kinds):
            own = [at for at, other in enumerate(kinds) if other == kind]
            best = {
                at
                for values in shares.values()
                for at in sorted(own, key=lambda at: -abs(values[skipped + at]))[: self.top]
            }
            rest = [at for at in own if at not in best]
            draw = np.random.default_rng(derive_seed("attribution", self.seed, kind))
            top += [cells[at] for at in sorted(best)]
            drawn += [cells[at] for at in sorted(draw.permutation(rest)[: self.controls].tolist())]
        return top, drawn

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Without `kv` where the family has none and no sites are named."""
        from probe_kit.hooks.registry import get_family

        family = get_family(run.model)
        if "sites" not in options and family is not None and not family.interventions.prompt_kv:
            options["sites"] = SITES[1:]
        return super().from_options(run, **options)


def name_of(part: str, cell: Cell) -> str:
    """Of the condition: `exact|kv.02|image`."""
    return f"{part}|{cell.place.name}|{cell.role}"
