"""What sets of cells carry, alone and left out. Reads stored outcomes; needs no model."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import list_places
from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.kinds.image_swap.effects import swap_sign
from probe_kit.intervene.kinds.joint.minimal_set import KEEP
from probe_kit.intervene.kinds.swap_shares import SwapShare, share_of_swap
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.intervene.store.selection import StoredResult, stored_results
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader, seed_text_of

NAME = "joint"
SITES, ROLES = ("kv.*",), ("image", "language", "state")
"""Searched if nothing is said: all that the acting stream reads."""
EVERY, ALONE, WITHOUT, MINIMAL, SECOND = "every-cell", "alone", "without", "minimal", "second"
"""Conditions: all cells; one of them, and all but it; the smallest set, and one that is found without it."""
WITHOUT_MINIMAL = f"{WITHOUT}|{MINIMAL}"
CARRIES, NOTHING = 0.5, 0.1
"""Shares of the swap from which a set carries it, and below which, on both sides of 0, it carries nothing."""


@dataclass(frozen=True, kw_only=True)
class JointEffect:
    """What one set of cells does in one category.

    cells: its cells, joined by `+`; of all cells their places and roles, `kv` if nothing of it is missing. part:
    `cell`, `every-cell`, `minimal` or `second`. alone: share of the swap with only these cells patched; needed:
    what all cells lose without them, of the swap; both with 95 % intervals by groups, None where the swap itself
    is not significant. p, p_fwe: that the set alone moves the action toward the target side. Of cells by sign
    flips of whole groups, p_fwe against all cells; of the smallest sets exact. The smallest sets are scored on the
    groups in which they were not searched.
    """

    category: str
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

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def measured_joint_places(measurement: Measurement) -> list[JointEffect]:
    """By category the cells, all of them, and the smallest sets."""
    searched: Mapping[str, Any] = measurement.certificate.get("joint", {})
    return [
        row
        for category, own in measurement.outcomes.by_category()
        for row in _Category(own, category, measurement.seed_text, measurement.settings, measurement.key).rows(
            searched.get(category, {})
        )
    ]


def stored_joint_places(run: RunReader) -> dict[str, list[JointEffect]]:
    """By category, of the preferred stored search: all of `kv` before a part of it, that before the backbone.

    Raises RunDamagedError.
    """
    return {
        category: _Category(
            result.outcomes, category, seed_text_of(run), result.stored.settings, result.stored.key
        ).rows(result.stored.certificate().get("joint", {}).get(category, {}))
        for category, result in _preferred(run).items()
    }


def joint_keys_in_use(run: RunReader) -> set[str]:
    """Keys of the stored searches that verdicts and tables read. Raises RunDamagedError."""
    return {result.stored.key for result in _preferred(run).values()}


def _preferred(run: RunReader) -> dict[str, StoredResult]:
    """By category the search whose result a verdict reads."""
    found: dict[str, StoredResult] = {}
    for own in stored_results(run, NAME):
        before = found.get(own.category)
        if before is None or _breadth(own.stored.settings) >= _breadth(before.stored.settings):
            found[own.category] = own
    return found


def _breadth(settings: Mapping[str, Any]) -> int:
    """2 for all of `kv`, 1 for a part of it, 0 for other places."""
    is_kv = all(str(site).partition(".")[0] == KV_STREAM for site in settings.get("sites", SITES))
    return is_kv + (is_kv and is_of_all_kv(settings))


def is_of_all_kv(settings: Mapping[str, Any]) -> bool:
    """Whether a search with these settings patched all that the acting stream reads."""
    return set(SITES) <= set(settings.get("sites", SITES)) and set(ROLES) <= set(settings.get("roles", ROLES))


def is_read_jointly(rows: "Sequence[JointEffect]") -> bool:
    """Whether a smallest set of several cells was confirmed."""
    return any(row.part == MINIMAL and row.finding == "read jointly" for row in rows)


def describe_joint_places(rows: Sequence[JointEffect]) -> str:
    """Where it is read, or passes in the backbone, in words for a verdict; empty where that remains open.

    A smallest set is named if no cell alone comes near what all cells carry.
    """
    (every,) = (row for row in rows if row.part == EVERY)
    cells = [row for row in rows if row.part == "cell"]
    single = {row.cells: row.alone or 0.0 for row in cells if row.finding in ("read here", "enough alone")}
    if every.finding == "past it" and not single:
        return f"past {every.cells}"
    verb = "read" if all(row.cells.startswith(f"{KV_STREAM}.") for row in cells) else "passes"
    if is_read_jointly(rows) and max(single.values(), default=0.0) < KEEP * (every.alone or 0.0):
        (minimal,) = (row for row in rows if row.part == MINIMAL)
        alone = [f"{name} {share:.2f}" for name, share in single.items()]
        return (
            f"{verb} jointly at {minimal.cells} (alone: {', '.join(alone)})"
            if alone
            else f"no single place: {verb} jointly at {minimal.cells}"
        )
    return f"{verb} at {list_places(list(single))}" if single else ""


def describe_remainder(rows: Sequence[JointEffect]) -> str:
    """What the places that carry it leave out: cells that oppose it, and a part that is past all cells."""
    (every,) = (row for row in rows if row.part == EVERY)
    opposing = [row.cells for row in rows if row.part == "cell" and row.finding == "opposes it"]
    found = [f"opposed at {list_places(opposing)}"] * bool(opposing)
    is_said = describe_joint_places(rows).startswith("past")
    if not is_said and every.alone_ci is not None and every.alone_ci[1] < KEEP:
        found.append(f"all cells of {every.cells} carry {every.alone:.2f} of it")
    return "; ".join(found)


@dataclass(frozen=True)
class _Category:
    outcomes: ConditionOutcomes
    category: str
    seed_text: str
    settings: Mapping[str, Any]
    key: str

    def rows(self, searched: Mapping[str, Any]) -> list[JointEffect]:
        names = [name.partition("|")[2] for name in self.outcomes.conditions if name.startswith(f"{ALONE}|")]
        toward = np.array([self._toward(f"{ALONE}|{name}") for name in names])
        seed = derive_seed("sign flips", self.seed_text, self.category)
        _, p, p_fwe = max_t(toward, self.outcomes.items, self.outcomes.groups, seed)
        every = self._share(self.outcomes, self._moved(EVERY))
        rows = []
        for at, name in enumerate(names):
            alone = self._share(self.outcomes, self._moved(f"{ALONE}|{name}"))
            needed = self._share(self.outcomes, self._moved(EVERY) - self._moved(f"{WITHOUT}|{name}"))
            finding = finding_of_cell(alone, needed, every, float(p_fwe[at]))
            rows.append(
                self._row("cell", name, self.outcomes, alone, needed, float(p[at]), float(p_fwe[at]), finding)
            )
        exact = paired_greater_p(self._toward(EVERY), self.outcomes.items, self.outcomes.groups)
        all_cells, finding = self._all_cells(names), _finding_of_all(every)
        rows.append(self._row(EVERY, all_cells, self.outcomes, every, None, exact, None, finding))
        return rows + self._searched(searched)

    def _all_cells(self, names: Sequence[str]) -> str:
        """All cells together: `kv` if nothing of it is missing, else their places and roles."""
        if is_of_all_kv(self.settings):
            return KV_STREAM
        places, roles = (list(dict.fromkeys(name.split("|")[at] for name in names)) for at in (0, 1))
        every_block = {*SITES} <= {*self.settings.get("sites", SITES)}
        return f"{KV_STREAM if every_block else list_places(places)} {', '.join(roles)}"

    def _searched(self, searched: Mapping[str, Any]) -> list[JointEffect]:
        """The smallest sets, on the groups in which they were not searched."""
        scoring = ~np.isin(self.outcomes.groups, searched.get("choosing", []))
        own = self.outcomes.of_episodes(scoring)
        rows = []
        for part, name in ((MINIMAL, "cells"), (SECOND, "second")):
            cells = " + ".join(searched.get(name, []))
            if not cells:
                continue
            moved = self._moved(part)[scoring]
            alone = self._share(own, moved)
            needed = None
            if part == MINIMAL:
                needed = self._share(own, (self._moved(EVERY) - self._moved(WITHOUT_MINIMAL))[scoring])
            p = paired_greater_p(self._toward(part)[scoring], own.items, own.groups)
            confirmed = alone is not None and alone.value >= CARRIES and alone.low > NOTHING and p < SIGNIFICANCE
            word = "read jointly" if "+" in cells else "read here"
            rows.append(
                self._row(part, cells, own, alone, needed, p, None, word if confirmed else "not confirmed")
            )
        return rows

    def _row(
        self, part: str, cells: str, outcomes: ConditionOutcomes, alone: SwapShare | None,
        needed: SwapShare | None, p: float, p_fwe: float | None, finding: str,
    ) -> JointEffect:  # fmt: skip
        return JointEffect(
            category=self.category, part=part, cells=cells.replace("|", " "), n_episodes=outcomes.items.size,
            n_groups=np.unique(outcomes.groups).size, alone=None if alone is None else alone.value,
            alone_ci=None if alone is None else (alone.low, alone.high),
            needed=None if needed is None else needed.value,
            needed_ci=None if needed is None else (needed.low, needed.high), p=p, p_fwe=p_fwe, finding=finding,
            key=self.key,
        )  # fmt: skip

    def _moved(self, condition: str) -> NDArray[np.float64]:
        return self.outcomes.of(condition) - self.outcomes.of(CLEAN)

    def _toward(self, condition: str) -> NDArray[np.float64]:
        """Metres toward the side that the image swap leads to."""
        return -swap_sign(self.outcomes) * self.outcomes.correct_sign * self._moved(condition)

    def _share(self, outcomes: ConditionOutcomes, moved: NDArray[np.float64]) -> SwapShare | None:
        return share_of_swap(outcomes, moved, self.seed_text)


def carries_nothing(low: float, high: float) -> bool:
    """Whether an interval of a share of the swap excludes, on both sides of 0, what would matter."""
    return low > -NOTHING and high < NOTHING


def _finding_of_all(every: SwapShare | None) -> str:
    """What all cells together are."""
    if every is None:
        return "n/a"
    if carries_nothing(every.low, every.high):
        return "past it"
    if every.high < -NOTHING:
        return "opposes it"
    return "carries" if every.value >= CARRIES else "in part"


def finding_of_cell(alone: SwapShare | None, needed: SwapShare | None, every: SwapShare | None, p: float) -> str:
    """What a cell is, from its shares alone and needed, that of all cells, and p of it alone; "n/a" if open."""
    if alone is None or needed is None or every is None:
        return "n/a"
    carries = alone.value >= CARRIES and p < SIGNIFICANCE
    if carries and needed.value >= CARRIES:
        return "read here"
    if carries and carries_nothing(needed.low, needed.high):
        return "enough alone"
    if carries_nothing(alone.low, alone.high) and needed.value >= CARRIES:
        return "needed, not enough"
    if max(alone.high, needed.high) < -NOTHING:
        return "opposes it"
    return (
        "nothing alone"
        if carries_nothing(alone.low, alone.high) and carries_nothing(needed.low, needed.high)
        else "in part"
    )
