"""Joint places: sets of cells are patched in one inference, as an interchange patches a single one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import ALL, resolve_all, roles_of
from probe_kit.intervene.kinds.interchange.intervention import capabilities_for
from probe_kit.intervene.kinds.joint.cells import Cell, CellsPatched, all_but
from probe_kit.intervene.kinds.joint.effects import (
    ALONE,
    EVERY,
    MINIMAL,
    ROLES,
    SECOND,
    SITES,
    WITHOUT,
    WITHOUT_MINIMAL,
)
from probe_kit.intervene.kinds.joint.search import Found, Search
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ImagesSwapped,
    Intervention,
    ReplayBatch,
)
from probe_kit.intervene.replay.session import ReplayInput, ReplaySession
from probe_kit.intervene.store.settings import items_of


@dataclass(frozen=True)
class MinimalPatched(CellsPatched):
    """The smallest set of each category. found: how it was found."""

    found: Mapping[str, Found]


@dataclass(frozen=True, kw_only=True)
class JointPlaces(Intervention):
    """Every cell alone, all cells but it, all of them, and the smallest set that carries the effect.

    A cell is the tokens of a role at a place. sites: patterns of places that are read in parallel, the blocks of
    `kv`, one layer, or the heads of one block; of several layers the first decides. roles: of the cells' tokens.
    The smallest set is searched in one half of each category's groups, drawn with `seed`, and scored in the other.
    """

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ROLES
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sites or not self.roles or ALL in self.roles:
            raise UsageError("joint places need at least one site, and roles that share no token (not all)")

    @property
    def kind(self) -> str:
        """`joint`."""
        return "joint"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """As of an interchange."""
        return capabilities_for(self.sites, self.roles)

    @property
    def fits_first(self) -> bool:
        """The smallest set is searched beforehand."""
        return True

    def parameters(self) -> dict[str, Any]:
        """Where and which tokens."""
        return {"sites": list(self.sites), "roles": list(self.roles), "seed": self.seed}

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, images swapped, the sets of cells. Raises UsageError for cells that are not parallel."""
        cells = self._cells(session)
        sites = tuple(dict.fromkeys(site for cell in cells for site in cell.place.sites))
        inputs: dict[str, list[ReplayInput]] = {}
        for item in items_of(session.run, self):
            for one in session.replay_inputs(item):
                inputs.setdefault(one.category, []).append(one)
        found = Search(session, cells, sites, self.readout, self.seed).run(inputs)
        sets: dict[str, dict[str, tuple[Cell, ...]]] = {EVERY: {"": cells}}
        for cell in cells:
            at = f"{cell.place.name}|{cell.role}"
            sets |= {f"{ALONE}|{at}": {"": (cell,)}, f"{WITHOUT}|{at}": {"": all_but(cells, (cell,))}}
        rest = {name: all_but(cells, one.cells) if one.cells else () for name, one in found.items()}
        sets |= {WITHOUT_MINIMAL: rest, SECOND: {name: one.second for name, one in found.items()}}
        patched = [CellsPatched(name, own, sites) for name, own in sets.items()]
        minimal = MinimalPatched(MINIMAL, {name: one.cells for name, one in found.items()}, sites, found)
        return [CleanRun(), ImagesSwapped(), *patched, minimal]

    def certificate_entries(self, conditions: Sequence[Condition], found: ReplayBatch) -> dict[str, Any]:
        """By category the smallest sets, and the groups in which they were searched."""
        del found
        (minimal,) = (one for one in conditions if isinstance(one, MinimalPatched))
        return {"joint": {name: one.to_json() for name, one in minimal.found.items()}}

    def _cells(self, session: ReplaySession) -> tuple[Cell, ...]:
        places = resolve_all(self.sites, session.policy)
        layers = {KV_STREAM if place.stream == KV_STREAM else place.layer for place in places.values()}
        if len(layers) > 1:
            raise UsageError(
                f"{', '.join(places)} come one after the other, so that the first decides for all; name blocks of "
                "kv, such as kv.*, or one layer, such as backbone.02 or backbone.02.heads.*"
            )
        cells = tuple(
            Cell(place, role)
            for place in places.values()
            for role in roles_of(session.policy, place.stream, self.roles)
        )
        if len(cells) < 2:
            raise UsageError(
                f"joint places need two cells or more; {', '.join(map(str, cells)) or 'none'} is there"
            )
        return cells
