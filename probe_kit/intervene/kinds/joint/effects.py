"""What sets of cells carry, alone and left out. Reads stored outcomes; needs no model."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.kinds.image_swap.effects import swap_sign
from probe_kit.intervene.kinds.swap_shares import SwapShare, share_of_swap
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.intervene.store.selection import preferred_by_category
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader

NAME = "joint"
EVERY, ALONE, WITHOUT, MINIMAL, SECOND = "every-cell", "alone", "without", "minimal", "second"
"""Conditions: all cells; one of them, and all but it; the smallest set, and one that is found without it."""
WITHOUT_MINIMAL = f"{WITHOUT}|{MINIMAL}"
CARRIES, NOTHING = 0.5, 0.1
"""Shares of the swap from which a set carries it, and below which it carries nothing."""


@dataclass(frozen=True, kw_only=True)
class JointEffect:
    """What one set of cells does in one category.

    cells: its cells, joined by `+`. part: `cell`, `every-cell`, `minimal` or `second`. alone: share of the swap
    with only these cells patched; needed: what all cells lose without them, of the swap; both with 95 % intervals
    by groups, None where the swap itself is not significant. p, p_fwe: that the set alone moves the action toward
    the target side. Of cells by sign flips of whole groups, p_fwe against all cells; of the smallest sets exact.
    The smallest sets are scored on the groups in which they were not searched.
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
        for row in _Category(own, category, measurement.suite, measurement.key).rows(searched.get(category, {}))
    ]


def stored_joint_places(run: RunReader) -> dict[str, list[JointEffect]]:
    """By category, of the preferred stored search. Raises RunDamagedError."""
    return {
        category: _Category(result.outcomes, category, run.suite, result.stored.key).rows(
            result.stored.certificate().get("joint", {}).get(category, {})
        )
        for category, result in preferred_by_category(run, NAME).items()
    }


def joint_keys_in_use(run: RunReader) -> set[str]:
    """Keys of the stored searches that verdicts and tables read. Raises RunDamagedError."""
    return {result.stored.key for result in preferred_by_category(run, NAME).values()}


def is_read_jointly(rows: "Sequence[JointEffect]") -> bool:
    """Whether a smallest set of several cells was confirmed."""
    return any(row.part == MINIMAL and row.finding == "read jointly" for row in rows)


def describe_joint_places(rows: "list[JointEffect]") -> str:
    """Where it is read, in words for a verdict; empty where that remains open."""
    single = [row.cells for row in rows if row.part == "cell" and row.finding in ("read here", "enough alone")]
    if single:
        return f"read at {', '.join(single)}"
    if is_read_jointly(rows):
        (minimal,) = (row for row in rows if row.part == MINIMAL)
        return f"no single place: read jointly at {minimal.cells}"
    (every,) = (row for row in rows if row.part == EVERY)
    return f"past {every.cells}" if every.finding == "past it" else ""


@dataclass(frozen=True)
class _Category:
    outcomes: ConditionOutcomes
    category: str
    suite: str
    key: str

    def rows(self, searched: Mapping[str, Any]) -> list[JointEffect]:
        names = [name.partition("|")[2] for name in self.outcomes.conditions if name.startswith(f"{ALONE}|")]
        toward = np.array([self._toward(f"{ALONE}|{name}") for name in names])
        seed = derive_seed("sign flips", self.suite, self.category)
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
        place = " and ".join(dict.fromkeys(name.partition(".")[0] for name in names))
        finding = (
            "n/a"
            if every is None
            else "past it"
            if every.high < NOTHING
            else "carries"
            if every.value >= CARRIES
            else "in part"
        )
        exact = paired_greater_p(self._toward(EVERY), self.outcomes.items, self.outcomes.groups)
        rows.append(self._row(EVERY, place, self.outcomes, every, None, exact, None, finding))
        return rows + self._searched(searched)

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
        return share_of_swap(outcomes, moved, self.suite)


def finding_of_cell(alone: SwapShare | None, needed: SwapShare | None, every: SwapShare | None, p: float) -> str:
    """What a cell is, from its shares alone and needed, that of all cells, and p of it alone; "n/a" if open."""
    if alone is None or needed is None or every is None:
        return "n/a"
    carries = alone.value >= CARRIES and p < SIGNIFICANCE
    if carries and needed.value >= CARRIES:
        return "read here"
    if carries and needed.high < NOTHING:
        return "enough alone"
    if alone.high < NOTHING and needed.value >= CARRIES:
        return "needed, not enough"
    return "nothing alone" if alone.high < NOTHING and needed.high < NOTHING else "in part"
