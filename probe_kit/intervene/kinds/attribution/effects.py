"""Estimates of a screen beside exact patches, and whether the screen is void. Needs no model."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import ALL, RESIDUAL, PlaceName
from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.kinds.image_swap.effects import swap_sign
from probe_kit.intervene.kinds.site_effects import LOCALISATION_SHARE
from probe_kit.intervene.kinds.swap_shares import SwapShare, share_of_swap
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.statistics.sign_flips import max_t

EXACT, ESTIMATE = "exact", "estimate"
"""How the names of conditions begin: `exact|kv.02|image`."""
EVERY_BLOCK = f"{KV_STREAM}.*"
"""The anchor that is all of `kv`."""
AGREEMENT = 3.0
"""Factor within which an anchor's estimate must lie of its exact effect."""


@dataclass(frozen=True, kw_only=True)
class AttributionEffect:
    """One cell in one category.

    place, role: of its tokens. is_anchor: a complete cut, patched exactly to test the screen. is_drawn: patched
    exactly although its estimate was not among the largest. estimate, exact: shares of the image swap with 95 %
    intervals by groups, None where the swap itself is not significant or no exact patch was made. p_fwe: of the
    exact patch, one-sided, max-T over those of the category. rank: by estimate among the cells of its kind, 1 for
    the largest; None in a void screen. finding: of the category's screen: `anchored`, `void`, or `n/a` where no
    anchor carries the effect.
    """

    category: str
    place: str
    role: str
    is_anchor: bool
    is_drawn: bool
    n_episodes: int
    n_groups: int
    estimate: float | None
    estimate_ci: tuple[float, float] | None
    exact: float | None
    exact_ci: tuple[float, float] | None
    p_fwe: float | None
    rank: int | None
    finding: str
    key: str = ""

    @property
    def name(self) -> str:
        """Place and role."""
        return f"{self.place} {self.role}"

    @property
    def kind(self) -> str:
        """Of cells that are ordered among themselves."""
        return "" if self.is_anchor else kind_of_place(self.place)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def measured_attribution(measurement: Measurement) -> list[AttributionEffect]:
    """By category the anchors, then the cells of each kind: by rank, or as they lie in a void screen."""
    drawn = measurement.certificate.get(Anchored.ENTRY, {}).get("drawn", [])
    return [
        row
        for category, own in measurement.outcomes.by_category()
        for row in Anchored(own, category, measurement.seed_text, frozenset(drawn), measurement.key).rows()
    ]


@dataclass(frozen=True)
class Anchored:
    """The screen of one category. drawn: names of conditions."""

    ENTRY: ClassVar[str] = "attribution"

    outcomes: ConditionOutcomes
    category: str
    seed_text: str
    drawn: frozenset[str]
    key: str

    def rows(self) -> list[AttributionEffect]:
        """See `measured_attribution`."""
        names = [name.partition("|")[2] for name in self.outcomes.conditions if name.startswith(f"{ESTIMATE}|")]
        exact = [name for name in self.outcomes.conditions if name.startswith(f"{EXACT}|")]
        leads = -swap_sign(self.outcomes) * self.outcomes.correct_sign
        toward = np.array([leads * self._moved(name) for name in exact])
        seed = derive_seed("sign flips", self.seed_text, self.category)
        p_fwe = dict(zip(exact, max_t(toward, self.outcomes.items, self.outcomes.groups, seed)[2], strict=True))
        return order_cells([self._row(name, p_fwe) for name in names])

    def _row(self, name: str, p_fwe: Mapping[str, float]) -> AttributionEffect:
        place, _, role = name.partition("|")
        condition = f"{EXACT}|{name}"
        estimate = self._share(f"{ESTIMATE}|{name}")
        exact = self._share(condition) if condition in p_fwe else None
        return AttributionEffect(
            category=self.category,
            place=place,
            role=role,
            is_anchor=role == ALL,
            is_drawn=condition in self.drawn,
            n_episodes=self.outcomes.items.size,
            n_groups=np.unique(self.outcomes.groups).size,
            **share_fields("estimate", estimate),
            **share_fields("exact", exact),
            p_fwe=float(p_fwe[condition]) if condition in p_fwe else None,
            rank=None,
            finding="n/a",
            key=self.key,
        )

    def _moved(self, condition: str) -> NDArray[np.float64]:
        return self.outcomes.of(condition) - self.outcomes.of(CLEAN)

    def _share(self, condition: str) -> SwapShare | None:
        return share_of_swap(self.outcomes, self._moved(condition), self.seed_text)


def share_fields(name: str, share: SwapShare | None) -> dict[str, Any]:
    """A share and its interval, as fields of an `AttributionEffect`."""
    if share is None:
        return {name: None, f"{name}_ci": None}
    return {name: share.value, f"{name}_ci": (share.low, share.high)}


def worst_anchor(rows: Sequence[AttributionEffect]) -> AttributionEffect | None:
    """Of the anchors that carry half of the effect, the one that its estimate misses most; None without one."""
    carrying = [row for row in rows if row.is_anchor and (row.exact or 0.0) >= LOCALISATION_SHARE]
    return min(carrying, key=_agreement, default=None)


def _agreement(row: AttributionEffect) -> float:
    """1 for an estimate that is exact, towards 0 for one that is too small, too large or of the other sign."""
    ratio = (row.estimate or 0.0) / (row.exact or 1.0)
    return 0.0 if ratio <= 0 else min(ratio, 1 / ratio)


def order_cells(rows: Sequence[AttributionEffect]) -> list[AttributionEffect]:
    """Rows of one category with rank and finding: the anchors, then the cells of each kind, see `Anchored`."""
    worst = worst_anchor(rows)
    finding = "n/a" if worst is None else "anchored" if _agreement(worst) * AGREEMENT >= 1 else "void"
    rows = [replace(row, finding=finding) for row in rows]
    found = [row for row in rows if row.is_anchor]
    for kind in dict.fromkeys(row.kind for row in rows if not row.is_anchor):
        cells = [row for row in rows if row.kind == kind]
        if finding == "anchored":
            cells = sorted(cells, key=lambda row: -abs(row.estimate or 0.0))
            cells = [replace(row, rank=at + 1) for at, row in enumerate(cells)]
        found += cells
    return found


def kind_of_place(name: str) -> str:
    """What a place can be compared with: `kv`, `backbone`, `backbone heads`, `expert iterations`."""
    place = PlaceName.parse(name)
    further = [place.quantity * (place.quantity != RESIDUAL), "iterations" * (place.iterations is not None)]
    return " ".join(filter(None, (place.stream, *further)))
