"""Joint places: which cells carry the effect together, which of them alone, and which are needed.

A cell is the tokens of one role at one place. Sets of cells are patched in one inference, as an interchange
patches a single cell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from probe_kit._tables.content import Cell as TableCell
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edited_cells import ALONE, WITHOUT, EditedCell
from probe_kit.intervene.exchange import CARRIES, NOTHING, SwapShare, carries_nothing, pooled_share, share_fields
from probe_kit.intervene.kinds.base import (
    EffectColumn,
    Intervention,
    effect_table,
    interval_cell,
    is_resolved,
    lines_of,
    p_of,
)
from probe_kit.intervene.kinds.interchange import cells_at, check_roles_apart
from probe_kit.intervene.outcomes import CLEAN, ConditionOutcomes, Effect
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.patching.patch import Cell, all_but, sites_of_cells
from probe_kit.intervene.patching.sweep import KEEP, choosing_half, find_minimal_set
from probe_kit.intervene.places import list_places, resolve_all
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, patched_run
from probe_kit.intervene.stored import Measurement, StoredResult, stored_results
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.paired_tests import paired_greater_p, smallest_flip_p
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.sessions import ReplaySession

NAME = "joint"
SITES, ROLES = ("kv.*",), ("image", "language", "state")
"""Default places and roles of a search: all that the acting stream reads."""
EVERY, MINIMAL, SECOND = "every-cell", "minimal", "second"
"""Names of conditions: all cells; one of them, all but it; the smallest set, and one found without it."""
WITHOUT_MINIMAL = f"{WITHOUT}|{MINIMAL}"
WORTH_SEARCHING = 0.5
"""Effect of all cells together from which on a smallest set is searched: of less, hardly any carries half."""
MOST_PLACES = 3
"""Number of places that a short sentence names."""
_PARTS = {EVERY: "all cells of", MINIMAL: "smallest set:", SECOND: "without it:"}


# -- the kind ------------------------------------------------------------------------------------------------


class SearchedSets(NamedTuple):
    """The result of the search in one category; the sets may be empty.

    Attributes:
        choosing: Groups in which the sets were searched.
        cells: Cells of the smallest set.
        second: Cells of the smallest set of the other cells that carries the effect as well.
        effect: Effect of `cells` in these groups.
        tried: Number of sets that were tried.
    """

    choosing: tuple[str, ...]
    cells: tuple[Cell, ...] = ()
    second: tuple[Cell, ...] = ()
    effect: float = 0.0
    tried: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        sets = {"cells": list(map(str, self.cells)), "second": list(map(str, self.second))}
        return {"choosing": list(self.choosing), **sets, "effect": self.effect, "tried": self.tried}


@dataclass(frozen=True, kw_only=True)
class JointPlaces(Intervention):
    """Conditions with every cell alone, all but it, all of them, and the smallest set that carries the effect.

    A cell is the tokens of a role at a place. The smallest set is searched in one half of each category's groups,
    drawn with `seed`, and scored in the other.

    Attributes:
        sites: Patterns of places that are read in parallel: the blocks of `kv`, one layer, or the heads of one
            block. Of several layers, the first would decide.
        roles: Roles of the cells' tokens.
        seed: Seed of the halves of the groups.
    """

    kind: ClassVar[str] = NAME
    summary: ClassVar[str] = "Patch sets of places: each alone, all but it, smallest set."
    position: ClassVar[int] = 4
    fits_always: ClassVar[bool] = True
    asks_where: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "of cells that run in parallel: several blocks of kv, or one layer; default kv.*",
        "roles": "of the cells' tokens; default image,language,state",
        "seed": "of the halves of the groups; default 0",
    }

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ROLES
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_roles_apart(self.roles, self.kind)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, images swapped, and the sets of cells.

        Raises:
            UsageError: For cells that are not parallel, or fewer than two.
        """
        cells = self._cells(session)
        pairs: dict[str, list[Pair]] = {}
        for item in self.items_in(session.run):
            for pair in session.pairs(item):
                pairs.setdefault(pair.category, []).append(pair)
        searched = {name: self._search(session, cells, part) for name, part in pairs.items()}
        session.certificate[NAME] = {name: search.to_json() for name, search in searched.items()}
        sets: dict[str | EditedCell, dict[str, tuple[Cell, ...]]] = {EVERY: {"": cells}}
        for cell in cells:
            alone = EditedCell(cell.site_group.name, cell.role, part=ALONE)
            sets |= {alone: {"": (cell,)}, replace(alone, part=WITHOUT): {"": all_but(cells, (cell,))}}
        sets[WITHOUT_MINIMAL] = {
            name: all_but(cells, search.cells) if search.cells else () for name, search in searched.items()
        }
        sets[SECOND] = {name: search.second for name, search in searched.items()}
        sets[MINIMAL] = {name: search.cells for name, search in searched.items()}
        # One capture of the source at all sites serves every set.
        sites = sites_of_cells(cells)
        return [CLEAN_RUN, SOURCE_RUN, *(patched_run(name, by_name, sites) for name, by_name in sets.items())]

    def _cells(self, session: "ReplaySession") -> tuple[Cell, ...]:
        places = resolve_all(self.sites, session.policy)
        layers = {
            KV_STREAM if site_group.stream == KV_STREAM else site_group.layer for site_group in places.values()
        }
        if len(layers) > 1:
            raise UsageError(
                f"{', '.join(places)} come one after the other, so that the first decides for all; name blocks of "
                "kv, such as kv.*, or one layer, such as backbone.02 or backbone.02.heads.*"
            )
        cells = tuple(cells_at(session, places.values(), self.roles))
        if len(cells) < 2:
            raise UsageError(
                f"joint places need two cells or more; {', '.join(map(str, cells)) or 'none'} is there"
            )
        return cells

    def _search(self, session: "ReplaySession", cells: tuple[Cell, ...], pairs: Sequence[Pair]) -> SearchedSets:
        """Search the smallest sets of one category, in the choosing half of its groups."""
        choosing = choosing_half([pair.group for pair in pairs], self.seed)
        searched_pairs = [pair for pair in pairs if pair.group in choosing]
        sites = sites_of_cells(cells)

        def effects(sets: Sequence[tuple[Cell, ...]]) -> list[float]:
            """Return the share of the image swap's displacement that each set carries."""
            patches = [patched_run(str(number), {"": part}, sites) for number, part in enumerate(sets)]
            played = self.play(session, searched_pairs, [CLEAN_RUN, SOURCE_RUN, *patches])
            clean, swapped, *moved = played.displacement
            return [pooled_share(values - clean, swapped - clean) for values in moved]

        if not searched_pairs or effects([cells])[0] < WORTH_SEARCHING:
            return SearchedSets(choosing)
        first, effect, tried = find_minimal_set(cells, effects)
        remaining = all_but(cells, first)
        if not remaining or effects([remaining])[0] < KEEP * effect:
            return SearchedSets(choosing, first, (), effect, tried)
        second, _, more = find_minimal_set(remaining, effects)
        return SearchedSets(choosing, first, second, effect, tried + more)

    @staticmethod
    def effects(measurement: Measurement) -> "list[JointEffect]":
        """Return by category the cells, all of them, and the smallest sets."""
        searched: Mapping[str, Any] = measurement.certificate.get(NAME, {})
        return measurement.rows(lambda part: _rows(part, measurement.settings, searched))

    @staticmethod
    def table(rows: "Sequence[JointEffect]", context: Measurement) -> "Table":
        """Return one line per category and set."""
        return effect_table(
            f"Where is it read, alone and jointly? {context.subject}, joint places",
            ("category", "cells"),
            lines_of(rows, lambda row: f"{_PARTS.get(row.part, '')} {row.cells}".lstrip()),
            {f"Share of the {context.exchange}": _columns(context.exchange)},
            lambda row: row.finding.startswith("read"),
        )

    @staticmethod
    def sentence(rows: "Sequence[JointEffect]", context: Measurement) -> str:
        """Return which cells carry the answer, alone or together."""
        del context
        places = describe_joint_places(rows) or "where the answer is read remains open"
        return "; ".join(filter(None, (places, *describe_remainders(rows))))

    @staticmethod
    def finding(rows: "Sequence[JointEffect]", context: Measurement) -> str:
        """Return where the answer is read, alone or jointly, in few words."""
        del context
        joint = joint_places(rows)
        if joint.is_past:
            return f"{joint.verb} {joint.cells[0]}: the answer reaches the action without passing there"
        if not joint.cells:
            return "open: no place was found at which the answer is read"
        return f"{joint.verb}: at {joint.list_cells(MOST_PLACES)}"

    @staticmethod
    def notes(rows: "Sequence[JointEffect]") -> list[str]:
        """Return notes on categories whose scoring half of the groups is too small to confirm any smallest set."""
        counts = {row.category: row.n_groups for row in rows if row.part == MINIMAL}
        return [
            f"{name}: the smallest set is scored in {count} groups, in which no p can be below "
            f"{smallest_flip_p(count):.2g}, so that none is confirmed. Play more (--items)."
            for name, count in counts.items()
            if smallest_flip_p(count) >= SIGNIFICANCE
        ]

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the stored searches that verdicts and tables read.

        Raises:
            RunDamagedError: If a stored intervention was changed.
        """
        return {result.stored.key for result in _preferred_searches(run).values()}


KIND = JointPlaces


def _columns(exchange: str) -> "tuple[EffectColumn[JointEffect], ...]":
    """Return the columns of a search; `exchange` is the change of inputs of which effects are shares."""
    return (
        EffectColumn(
            "alone [95 %]",
            lambda row: interval_cell(row.alone, row.alone_ci),
            f"alone: share of the {exchange} that patching only these cells gives",
        ),
        EffectColumn(
            "needed [95 %]",
            lambda row: interval_cell(row.needed, row.needed_ci),
            "needed: share of the effect of all cells that is lost when these are left out",
        ),
        EffectColumn(
            "p",
            lambda row: p_of(
                row.p if row.p_fwe is None else row.p_fwe, row.alone is None or is_resolved(row.alone)
            ),
            "p: one-sided, of a move toward the target side; of single cells family-wise over all of them",
        ),
        EffectColumn("groups", lambda row: TableCell(row.n_groups)),
        EffectColumn("finding", lambda row: row.finding, _FINDINGS),
    )


_FINDINGS = (
    "read here: both at least 0.5; enough alone: another copy is read as well; needed, not enough: one part of "
    "several; nothing alone: neither, which leaves a part of a set; opposes it: both below -0.1; smallest set: "
    "searched in one half of the groups, scored in the other"
)


# -- effects -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class JointEffect(Effect):
    """The effect of one set of cells in one category.

    The smallest sets are scored on the groups in which they were not searched. Shares and their intervals are None
    where the swap itself is not significant.

    Attributes:
        part: Kind of the set: `cell`, `every-cell`, `minimal` or `second`.
        cells: Cells of the set, joined by `+`; of all cells their places and roles, `kv` if nothing of it is
            missing.
        alone: Share of the swap with only these cells patched.
        alone_ci: The 95 % interval of `alone`, by groups.
        needed: Share of the swap that all cells lose without them.
        needed_ci: The 95 % interval of `needed`, by groups.
        p: The p-value that the set alone moves the action toward the target side. For cells it is by sign flips of
            whole groups, for the smallest sets it is exact.
        p_fwe: Family-wise p-value against all cells; None for sets of several.
        finding: Finding in words.
        key: Key of the intervention.
    """

    part: str
    cells: str
    n_episodes: int
    n_groups: int
    alone: float | None
    alone_ci: tuple[float, float] | None
    needed: float | None
    needed_ci: tuple[float, float] | None
    p: float
    p_fwe: float | None
    finding: str
    key: str = ""


def stored_joint_places(run: RunReader) -> dict[str, list[JointEffect]]:
    """Return by category the rows of the preferred stored search.

    All of `kv` is preferred to a part, and a part to the backbone.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    rows = {}
    for category, result in _preferred_searches(run).items():
        measured = result.stored
        of_category = _rows(result.outcomes, measured.settings, measured.certificate.get(NAME, {}))
        rows[category] = [replace(row, key=measured.key) for row in of_category]
    return rows


def _preferred_searches(run: RunReader) -> dict[str, StoredResult]:
    """Return by category the search whose result a verdict reads."""
    preferred: dict[str, StoredResult] = {}
    for result in stored_results(run, NAME):
        before = preferred.get(result.category)
        if before is None or _breadth(result.stored.settings) >= _breadth(before.stored.settings):
            preferred[result.category] = result
    return preferred


def _breadth(settings: Mapping[str, Any]) -> int:
    """Return 2 for all of `kv`, 1 for a part of it, 0 for other places."""
    is_kv = all(str(site).partition(".")[0] == KV_STREAM for site in settings.get("sites", SITES))
    return is_kv + (is_kv and is_of_all_kv(settings))


def is_of_all_kv(settings: Mapping[str, Any]) -> bool:
    """Whether a search with these settings patched all that the acting stream reads."""
    return set(SITES) <= set(settings.get("sites", SITES)) and set(ROLES) <= set(settings.get("roles", ROLES))


def is_read_jointly(rows: Sequence[JointEffect]) -> bool:
    """Whether a smallest set of several cells was confirmed."""
    return any(row.part == MINIMAL and row.finding == "read jointly" for row in rows)


@dataclass(frozen=True)
class JointReading:
    """The cells at which the answer is read, or passes in the backbone, and how.

    Attributes:
        verb: Words for how, such as `read` or `passes jointly`.
        cells: Names of the cells; empty where they remain open.
        alone: Shares that single cells carry, by cell.
        is_jointly: Whether it is a smallest set, whose cells are one text joined by `+`.
        is_past: Whether the answer reaches the action past all cells.
    """

    verb: str
    cells: tuple[str, ...]
    alone: Mapping[str, float]
    is_jointly: bool = False
    is_past: bool = False

    def list_cells(self, most: int | None = None) -> str:
        """Return the cells in words, at most so many places by name; None for all."""
        return self.cells[0] if self.is_jointly else list_places(self.cells, most)


def joint_places(rows: Sequence[JointEffect]) -> JointReading:
    """Return the cells at which the answer is read, or passes in the backbone.

    A smallest set is named if no cell alone comes near what all cells carry.
    """
    (every,) = (row for row in rows if row.part == EVERY)
    cells = [row for row in rows if row.part == "cell"]
    single = {row.cells: row.alone or 0.0 for row in cells if row.finding in ("read here", "enough alone")}
    if every.finding == "past it" and not single:
        return JointReading("past", (every.cells,), single, is_past=True)
    verb = "read" if all(row.cells.startswith(f"{KV_STREAM}.") for row in cells) else "passes"
    if is_read_jointly(rows) and max(single.values(), default=0.0) < KEEP * (every.alone or 0.0):
        (minimal,) = (row for row in rows if row.part == MINIMAL)
        return JointReading(f"{verb} jointly", (minimal.cells,), single, is_jointly=True)
    return JointReading(verb, tuple(single), single)


def describe_joint_places(rows: Sequence[JointEffect]) -> str:
    """Return `joint_places` in words for a verdict; empty where they remain open."""
    joint = joint_places(rows)
    if joint.is_past:
        return f"{joint.verb} {joint.cells[0]}"
    text = f"{joint.verb} at {joint.list_cells()}" if joint.cells else ""
    if not joint.is_jointly:
        return text
    alone = ", ".join(f"{name} {share:z.2f}" for name, share in joint.alone.items())
    return f"{text} (alone: {alone})" if alone else f"no single place: {text}"


def describe_remainders(rows: Sequence[JointEffect]) -> tuple[str, ...]:
    """Return the parts that places leave out: cells that oppose it, and what passes outside of all cells."""
    (every,) = (row for row in rows if row.part == EVERY)
    opposing = [row.cells for row in rows if row.part == "cell" and row.finding == "opposes it"]
    parts = [f"opposed at {list_places(opposing)}"] if opposing else []
    if not joint_places(rows).is_past and every.alone_ci is not None and every.alone_ci[1] < KEEP:
        parts.append(f"all cells of {every.cells} carry {every.alone:z.2f} of it")
    return tuple(parts)


def _rows(
    outcomes: ConditionOutcomes, settings: Mapping[str, Any], searches: Mapping[str, Any]
) -> list[JointEffect]:
    """Return the rows of one category.

    Args:
        outcomes: Outcomes of one category.
        settings: Settings of the intervention.
        searches: Searched sets by category, as the certificate has them.
    """
    clean, exchange = outcomes.of(CLEAN), outcomes.exchange()
    assert exchange is not None
    moved = {name: outcomes.of(name) - clean for name in outcomes.conditions}
    cells = [cell for cell in outcomes.cells if cell.part == ALONE]
    alone = np.array([moved[str(cell)] for cell in cells])
    lost = np.array([moved[EVERY] - moved[str(replace(cell, part=WITHOUT))] for cell in cells])
    rows = [
        _row("cell", f"{cell.site} {cell.role}", outcomes, *reading)
        for cell, reading in zip(cells, exchange.readings(moved[EVERY], alone, lost), strict=True)
    ]
    every = exchange.share(moved[EVERY])
    exact = paired_greater_p(exchange.leads * moved[EVERY], outcomes.items, outcomes.groups)
    rows.append(
        _row(EVERY, _all_cells(cells, settings), outcomes, every, None, exact, None, _finding_on_all_cells(every))
    )
    # The smallest sets, on the groups in which they were not searched.
    searched = searches.get(str(outcomes.categories[0]), {})
    scoring = ~np.isin(outcomes.groups, searched.get("choosing", []))
    scored = outcomes.of_episodes(scoring)
    for part, name in ((MINIMAL, "cells"), (SECOND, "second")):
        together = " + ".join(searched.get(name, []))
        if not together:
            continue
        unit = scored.exchange()
        assert unit is not None
        share, needed = unit.share(moved[part][scoring]), None
        if part == MINIMAL:
            needed = unit.share((moved[EVERY] - moved[WITHOUT_MINIMAL])[scoring])
        exact = paired_greater_p((exchange.leads * moved[part])[scoring], scored.items, scored.groups)
        confirmed = share is not None and share.value >= CARRIES and share.low > NOTHING and exact < SIGNIFICANCE
        word = "read jointly" if len(searched[name]) > 1 else "read here"
        finding = word if confirmed else "not confirmed"
        rows.append(_row(part, together, scored, share, needed, exact, None, finding))
    return rows


def _row(
    part: str,
    cells: str,
    outcomes: ConditionOutcomes,
    alone: SwapShare | None,
    needed: SwapShare | None,
    p: float,
    p_fwe: float | None,
    finding: str,
) -> JointEffect:
    """Return one row; see `JointEffect`."""
    counts = {name: value for name, value in outcomes.counts.items() if name != "n_items"}
    fields: dict[str, Any] = {**share_fields("alone", alone), **share_fields("needed", needed)}
    return JointEffect(**counts, part=part, cells=cells, **fields, p=p, p_fwe=p_fwe, finding=finding)


def _all_cells(cells: Sequence[EditedCell], settings: Mapping[str, Any]) -> str:
    """Return all cells together: `kv` if nothing of it is missing, else their places and roles."""
    if is_of_all_kv(settings):
        return KV_STREAM
    places, roles = dict.fromkeys(cell.site for cell in cells), dict.fromkeys(cell.role for cell in cells)
    every_block = {*SITES} <= {*settings.get("sites", SITES)}
    return f"{KV_STREAM if every_block else list_places(list(places))} {', '.join(roles)}"


def _finding_on_all_cells(every: SwapShare | None) -> str:
    """Return the finding on all cells together."""
    if every is None:
        return "n/a"
    if carries_nothing(every.low, every.high):
        return "past it"
    if every.high < -NOTHING:
        return "opposes it"
    return "carries" if every.value >= CARRIES else "in part"
