"""The effect of a source's input on the output: the unit in which patches are measured, and their tests."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit._tables.numbers import whole_percent
from probe_kit.statistics.bootstrap import draw_groups, units_seed
from probe_kit.statistics.paired_tests import max_t, paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE

CARRIES, NOTHING = 0.5, 0.1
"""Shares of the swap from which a set carries it, and within which, on both sides of 0, it carries nothing.

Both are choices. The second is `SMALLEST_SHARE_OF_INTEREST` of the image swap.
"""
INPUTS_DECIDE = 0.25
"""Share of the variance of the actions below which the seed decides and no input does.

It applies to the change by all inputs together. A choice: half of the spread, which is a quarter of the variance.
"""
TRACE = 0.01
"""Share of the variance below which an effect does not matter: a tenth of the actions' spread, squared."""


def share_of_variance(size: Matrix) -> Matrix:
    """Return the share of the actions' variance of changes (E,) in root mean squares of spreads.

    It is half the mean squared change, by Jansen's estimator (Computer Physics Communications 117, 1999): two
    actions that have nothing in common differ by twice the variance.
    """
    return np.asarray(size, np.float64) ** 2 / 2


def does_seed_decide(every: float, seed: float = np.nan) -> bool:
    """Return whether all inputs together change so small a share of the variance that none of them decides.

    Donors that are near their frames change little in a policy without noise as well, where no seed decides.

    Args:
        every: Share of the variance that all inputs together change.
        seed: Share of the variance that another seed changes; NaN where that was not measured.
    """
    return every < INPUTS_DECIDE and not seed < every


def describe_seed(every: float) -> str:
    """Return a sentence, without its stop, on actions that all inputs together hardly change."""
    return f"all inputs together change {whole_percent(every)} % of the action: the seed decides it"


def describe_trace(exchange: str, share: float) -> str:
    """Return a sentence, without its stop, on an exchange of inputs that changes less than `TRACE`."""
    return (
        f"the {exchange} changes {100 * share:.1g} % of the action's variance, less than "
        f"{whole_percent(TRACE)} %: shares of it are shares of next to nothing"
    )


class SwapShare(NamedTuple):
    """A ratio of sums over episodes, with its 95 % interval by groups; 1 is the whole swap."""

    value: float
    low: float
    high: float


def share_of_whole(
    moved: NDArray[np.float64], full: NDArray[np.float64], groups: NDArray[np.str_], seed_text: str
) -> SwapShare | None:
    """Return Σ moved · whole / Σ whole² over episodes (E,), with its interval by groups (E,).

    None where the whole is zero in every episode.
    """
    if not full.any():
        return None
    # Items of a group share a picture and are not independent of each other, so that whole groups are drawn.
    names, group_of = np.unique(groups, return_inverse=True)
    above, below = np.bincount(group_of, moved * full), np.bincount(group_of, full**2)
    times = draw_groups(names.size, units_seed(groups, seed_text))
    # A draw may hold only groups in which the source moves nothing.
    drawn = (times @ above) / np.maximum(times @ below, np.finfo(float).tiny)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return SwapShare(float(above.sum() / below.sum()), float(low), float(high))


def share_fields(name: str, share: SwapShare | None) -> dict[str, Any]:
    """Return a share and its interval as fields of a row of effects."""
    if share is None:
        return {name: None, f"{name}_ci": None}
    return {name: share.value, f"{name}_ci": (share.low, share.high)}


def share_columns(name: str, share: SwapShare | None) -> dict[str, float]:
    """Return a share and its interval as columns of a data frame."""
    value, low, high = (np.nan,) * 3 if share is None else share
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def pooled_share(moved: NDArray[np.float64], full: NDArray[np.float64]) -> float:
    """Return Σ moved · whole / Σ whole² over pairs (E,); 0 where the whole moves nothing."""
    total = float((full**2).sum())
    return float((moved * full).sum()) / total if total else 0.0


def carries_nothing(low: float, high: float) -> bool:
    """Whether an interval of a share of the swap excludes, on both sides of 0, effects that would matter."""
    return low > -NOTHING and high < NOTHING


def finding_of_cell(alone: SwapShare | None, needed: SwapShare | None, every: SwapShare | None, p: float) -> str:
    """Return a cell's finding.

    Args:
        alone: Share of the swap with this cell alone patched; None where the swap is not significant.
        needed: Share of the swap that all cells lose without it; None likewise.
        every: Share of the swap with all cells patched; None likewise.
        p: The p-value of the cell alone.
    """
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


class CellReading(NamedTuple):
    """One of several cells that are read in parallel.

    Attributes:
        alone: Share with this cell alone patched; None where the source is not significant.
        needed: Share that all cells lose without it; None likewise.
        p: The p-value that it moves the output alone.
        p_fwe: Family-wise p-value of the same, against all cells.
        finding: Finding in words, see `finding_of_cell`.
    """

    alone: SwapShare | None
    needed: SwapShare | None
    p: float
    p_fwe: float
    finding: str


@dataclass(frozen=True)
class Exchange:
    """The outputs of E clean inferences and of their sources.

    Attributes:
        clean: (E,) outputs of the clean inferences, as numbers such as metres to the left.
        source: (E,) outputs of the sources' inferences, likewise.
        toward: (E,) ±1, the direction in which the source should move the output.
        groups: (E,) group of items of every inference.
        items: (E,) item of every inference.
        seed_text: Text from which the seed of resampled groups is made.
        flips_seed: Seed of sign flips.
    """

    clean: Matrix
    source: Matrix
    toward: Matrix
    groups: NDArray[np.str_]
    items: NDArray[np.str_]
    seed_text: str
    flips_seed: int

    @property
    def full(self) -> Matrix:
        """The difference (E,) of the source's output from the clean one."""
        return self.source - self.clean

    @cached_property
    def p_values(self) -> tuple[float, float]:
        """The p-values that the source moves the output where it should, and that it moves it away.

        They are of exact sign tests.
        """
        moved = self.toward * self.full
        toward, away = (paired_greater_p(sign * moved, self.items, self.groups) for sign in (1.0, -1.0))
        return toward, away

    @property
    def sign(self) -> float:
        """The sign of the source's effect: −1 where it is shown to move the output away, else 1.

        Patches that carry the effect of the source move the output where the source does: their p are of that
        direction.
        """
        return -1.0 if self.p_values[1] < SIGNIFICANCE else 1.0

    @property
    def leads(self) -> Matrix:
        """The direction (E,), ±1, in which the source moves the output."""
        return self.sign * self.toward

    def share(self, moved: Matrix) -> SwapShare | None:
        """Return `moved` (E,) as a share of the source's effect; groups are drawn for both sums together.

        None if the source moves the output by no more than chance: a share would be a ratio of noise.
        """
        if min(self.p_values) >= SIGNIFICANCE:
            return None
        return share_of_whole(moved, self.full, self.groups, self.seed_text)

    def test(self, moved: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        """Return t, p and p_fwe (K,) that each of `moved` (K, E) is where the source leads.

        The tests are one-sided, by sign flips of whole groups; p_fwe is against the largest t of all K.
        """
        return max_t(self.leads * moved, self.items, self.groups, self.flips_seed)

    def readings(self, every: Matrix, alone: Matrix, lost: Matrix) -> Iterator[CellReading]:
        """Yield the readings of C cells.

        Args:
            every: (E,) how far all cells together move the output.
            alone: (C, E) how far each cell moves it alone.
            lost: (C, E) how much of the movement all cells lose without each.
        """
        share_of_every = self.share(every)
        _, p, p_fwe = self.test(alone)
        for at in range(len(alone)):
            single, needed = self.share(alone[at]), self.share(lost[at])
            finding = finding_of_cell(single, needed, share_of_every, float(p_fwe[at]))
            yield CellReading(single, needed, float(p[at]), float(p_fwe[at]), finding)
