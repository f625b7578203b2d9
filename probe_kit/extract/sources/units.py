"""Other units or another robot? The numbers of a source are compared with the statistics of a checkpoint.

A number is compared by all statistics that both sides have, see `FeatureStatistics.distance`. Where it does not
fit, explanations are tried: the one that makes it fit is reported. `docs/own-data.md` states the rule.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.feature_statistics import FeatureStatistics, Numbers

MOST_OUTSIDE = 0.2
"""The share of values of a number beyond the checkpoint's support, above which states are refused."""
DEGREES = 180 / np.pi
PERCENT = 100.0
CLEARLY = 1.7
"""The part by which percent has to fit better than degrees, whose factors are close to each other."""
FACTORS = {DEGREES: ("degrees", "radians"), PERCENT: ("centimetres or percent", "metres or shares"),
           1000.0: ("millimetres", "metres")}  # fmt: skip
"""The factors between units that people mix up, with the names of the smaller and of the larger unit."""
FAR = 4.0
"""The distance from which a factor is looked for; a factor of 57 at the same place makes it 6 or more."""
UNLIKE = 0.8
"""The distance from which another explanation than a factor is looked for; less where the others are closer."""
TWIN = 0.05
"""The median distance of all numbers, once explained, up to which a data set is the training data, changed."""
LEAST_UNLIKE = 0.15
CLEAR = 0.25
"""The distance from which a number of such a twin is certain to be changed."""
LIKE = 0.3
"""The distance up to which a number fits under an explanation that is not a factor."""
BETTER = 4.0
"""An explanation divides the distance by this at least."""
ALIKE = 0.5
"""The median distance of all numbers, once explained, up to which a data set is like the training data."""
COMPARABLE = 2.0
"""The median distance of all numbers, once explained, up to which one or two of them are suspicious."""
MOST_NUMBERS = 0.8
"""With so many of its numbers under one factor, a data set is in other units whatever its distance is."""
LEAST_NUMBERS = 3
NARROW = 1 / 20
"""The spread in shares of the checkpoint's, below which a number hardly moves."""
SAME = 1e-3
"""The distance up to which two statistics are equal."""
_LISTED = 4

Kind = Literal["factor", "sign", "inverted", "exchange", "outside", "offset", "narrow"]


@dataclass(frozen=True)
class Misfit:
    """Numbers that do not fit the statistics of a checkpoint, for one reason.

    Attributes:
        kind: The explanation; `outside` for none, `narrow` for numbers that hardly move.
        numbers: The indices of the numbers.
        is_sure: Whether other units or another robot are certain enough to refuse.
        factor: How many times as large the numbers are as in training, where a factor explains them.
        partners: The indices of the numbers that stand in their place, of an exchange.
        words: The explanation in words.
    """

    kind: Kind
    numbers: tuple[int, ...]
    is_sure: bool
    words: str
    factor: float = 1.0
    partners: tuple[int, ...] = ()


@dataclass(frozen=True)
class Units:
    """The comparison of one feature of a source with the statistics of a checkpoint.

    Attributes:
        misfits: The numbers that do not fit, by reason; the certain ones first.
        shares: (D,) the share of the values beyond the support of the statistics; empty where none was compared.
    """

    misfits: tuple[Misfit, ...] = ()
    shares: Numbers = field(default_factory=lambda: np.zeros(0))

    @property
    def are_other(self) -> bool:
        """Whether other units or another robot are certain enough to refuse."""
        return any(misfit.is_sure for misfit in self.misfits)

    @property
    def refused(self) -> str:
        """The certain misfits in words."""
        return "; ".join(misfit.words for misfit in self.misfits if misfit.is_sure)

    def note(self, accepted: bool) -> "UnitsNote | None":
        """Return what a run stores and a plan prints of it; None where all numbers fit."""
        words = "; ".join(misfit.words for misfit in self.misfits)
        return UnitsNote(words, self.are_other, accepted and self.are_other) if words else None


@dataclass(frozen=True)
class UnitsNote:
    """The numbers that do not fit the statistics of a checkpoint, as a run stores them.

    Attributes:
        misfits: The numbers and their explanation, in words.
        are_other: Whether other units or another robot are certain; else they are suspicious only.
        are_accepted: Whether they were accepted.
    """

    misfits: str
    are_other: bool
    are_accepted: bool

    @property
    def words(self) -> str:
        """The misfits with their weight."""
        weight = "accepted, " * self.are_accepted + (
            "other units or another robot" if self.are_other else "suspicious"
        )
        return f"{weight}: {self.misfits}"


def compare_units(
    expected: FeatureStatistics,
    episodes: Sequence[NDArray[Any]],
    names: Sequence[str],
    recorded: FeatureStatistics | None = None,
    begins: bool = False,
) -> Units:
    """Compare numbers of a source with the statistics of a checkpoint.

    Args:
        expected: The statistics of the checkpoint.
        episodes: Values (T, D) of every episode.
        names: The names of the numbers.
        recorded: The statistics of the complete data set, if it stores them; these of `episodes` otherwise.
        begins: Whether only the beginnings of episodes are known, whose spread shows nothing.
    """
    frames = np.concatenate([np.asarray(episode, np.float64) for episode in episodes])
    episodes = [episode[np.isfinite(episode).all(axis=1)] for episode in episodes]
    observed = FeatureStatistics.of_episodes(
        [episode for episode in episodes if len(episode)] or [np.zeros_like(frames)]
    )
    if recorded is not None and not _describes(recorded, observed):
        recorded = None
    if recorded is not None and _same(recorded, expected):
        return Units(shares=np.zeros(len(names)))
    comparison = _Comparison(expected, frames, observed, recorded or observed, names, begins)
    misfits = sorted(comparison.misfits(), key=lambda misfit: not misfit.is_sure)
    return Units(tuple(misfits), comparison.shares)


def _describes(recorded: FeatureStatistics, observed: FeatureStatistics) -> bool:
    """Whether stored statistics can be those of a data set with these values: they contain all, and their mean."""
    low, high = recorded.level("min"), recorded.level("max")
    slack = 1e-3 * (high - low) + 1e-5 * np.maximum(np.abs(low), np.abs(high)) + 1e-6
    levels = [observed.level("min"), observed.level("max"), recorded.level("mean")]
    return all(((level >= low - slack) & (level <= high + slack)).all() for level in levels)


def _same(recorded: FeatureStatistics, expected: FeatureStatistics) -> bool:
    """Whether the statistics of a data set are those of the checkpoint: it was trained on these very frames."""
    names = [name for name in expected.values if name in recorded.values]
    slack = SAME * np.nan_to_num(expected.level("std")) + 1e-5 * np.abs(np.nan_to_num(expected.center)) + 1e-7
    return bool(names) and all(
        (np.abs(recorded.level(name) - expected.level(name))[expected.compared] <= slack[expected.compared]).all()
        for name in names
    )


@dataclass(frozen=True)
class _Comparison:
    """One comparison, and the explanations that are tried."""

    expected: FeatureStatistics
    frames: Numbers
    observed: FeatureStatistics
    recorded: FeatureStatistics
    names: Sequence[str]
    begins: bool

    @cached_property
    def shares(self) -> Numbers:
        """The share (D,) of values beyond the support."""
        return np.asarray(self.expected.outside(self.frames).mean(axis=0), np.float64)

    @cached_property
    def is_outside(self) -> NDArray[np.bool_]:
        """A mask (D,) of the numbers that lie beyond the support."""
        return np.asarray(self.shares > MOST_OUTSIDE)

    @cached_property
    def beyond_extremes(self) -> Numbers:
        """The share (D,) of values beyond the stored extremes, 0 where there are none."""
        low, high = self.expected.level("min"), self.expected.level("max")
        slack = 1e-2 * (high - low) + 1e-5 * np.maximum(np.abs(low), np.abs(high)) + 1e-6
        beyond = (self.frames < low - slack) | (self.frames > high + slack)
        return np.asarray((beyond & self.expected.compared).mean(axis=0))

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """A mask (D,) of the numbers that change on both sides, whose spreads can be compared."""
        expected, recorded = self.expected.scales(self.recorded)
        least = 1e-6 * np.abs(np.nan_to_num(self.recorded.center))
        turning = np.resize(self.expected.periodic, self.expected.width) if self.expected.periodic.size else False
        return np.asarray(
            ~self.expected.is_still
            & (expected > 0)
            & (recorded > least)
            & self.expected.compared
            & ~np.asarray(turning)
        )

    @cached_property
    def before(self) -> Numbers:
        """The distance (D,) of every number as it is."""
        return self.expected.distance(self.recorded)

    @cached_property
    def unlike(self) -> float:
        """The distance from which a number differs from its training more than the others do."""
        typical = float(np.median(self.before[self.moves])) if self.moves.any() else UNLIKE
        return min(UNLIKE, max(LEAST_UNLIKE, BETTER * typical))

    def misfits(self) -> Iterator[Misfit]:
        """Yield the numbers that do not fit, each under one explanation."""
        explained = [] if self.begins else list(self._match())
        explained_numbers = {number for misfit in explained for number in misfit.numbers}
        explained += self._locate(explained_numbers)
        explained_numbers |= {number for misfit in explained for number in misfit.numbers}
        yield from explained
        for number in np.flatnonzero(self.is_outside).tolist():
            if number not in explained_numbers:
                yield Misfit("outside", (number,), True, self._outside_words(number))
                explained_numbers.add(number)
        far = [
            number
            for number in np.flatnonzero(self.beyond_extremes > MOST_OUTSIDE).tolist()
            if number not in explained_numbers
        ]
        if far:
            worst = f"{self._list_names(far)} beyond the least and largest value of training in up to "
            yield Misfit(
                "outside", tuple(far), False, f"{worst}{self.beyond_extremes[far].max():.0%} of the frames"
            )
        if not self.begins:
            yield from self._narrow(explained_numbers)

    # -- explanations by all statistics ------------------------------------------------------------------

    def _match(self) -> Iterator[Misfit]:
        """Yield numbers that fit once they are exchanged, mirrored or multiplied."""
        after, groups = self.before.copy(), list[Misfit]()
        free = self.moves.copy()

        def note(misfit: Misfit, distances: Numbers) -> None:
            groups.append(misfit)
            for number in misfit.numbers:
                after[number], free[number] = distances[number], False

        for misfit, distances in list(self._exchanges(free)):
            note(misfit, distances)
        for kind, slope, offset in self._mirrors():
            distances = self.expected.distance(self.recorded.mapped(slope, offset))
            fits = free & (self.before >= self.unlike) & (distances <= np.minimum(LIKE, self.before / BETTER))
            for number in np.flatnonzero(fits).tolist():
                words = self._mirror_words(kind, number, offset)
                note(Misfit(kind, (number,), False, words), distances)
        for factor, numbers, distances in self._factors(free):
            note(Misfit("factor", numbers, False, self._factor_words(factor, numbers), factor), distances)
        offsets = np.nan_to_num(self.expected.center - self.recorded.center)
        distances = self.expected.distance(self.recorded.mapped(1.0, offsets))
        fits = free & (self.before >= self.unlike) & (distances <= np.minimum(LIKE, self.before / BETTER))
        for number in np.flatnonzero(fits).tolist():
            note(Misfit("offset", (number,), False, self._offset_words(number, -offsets[number])), distances)
        typical = float(np.median(after[self.moves])) if self.moves.any() else np.inf
        for misfit in groups:
            is_sure = self._is_sure(misfit, after, typical)
            # Where most numbers are unlike the training, one or two that hardly move show no factor.
            if is_sure or typical <= COMPARABLE or len(misfit.numbers) >= LEAST_NUMBERS:
                yield replace(misfit, is_sure=is_sure)

    def _is_sure(self, misfit: Misfit, after: Numbers, typical: float) -> bool:
        """Whether an explanation is certain: values lie outside, or the other numbers are as in training."""
        numbers = list(misfit.numbers)
        if self.is_outside[numbers].any() or (typical <= TWIN and (self.before[numbers] >= CLEAR).all()):
            return True
        alike = typical <= ALIKE
        match misfit.kind:
            case "factor":
                many = len(numbers) >= max(LEAST_NUMBERS, MOST_NUMBERS * self.moves.sum())
                return many or (alike and float(np.median(after[numbers])) <= ALIKE)
            case "exchange" | "inverted":
                return alike and bool((self.before[numbers] >= 1).all())
            case "sign":
                return alike and bool((self.beyond_extremes[numbers] > MOST_OUTSIDE).all())
        return False  # another place on the table looks like an offset

    def _exchanges(self, free: NDArray[np.bool_]) -> Iterator[tuple[Misfit, Numbers]]:
        """Yield cycles of numbers that fit in each other's place."""
        from scipy.optimize import linear_sum_assignment  # type: ignore[import-untyped]

        unlike = np.flatnonzero(free & (self.before >= self.unlike))
        if len(unlike) < 2:
            return
        costs = np.stack([self._of_partner(unlike, partner) for partner in unlike], axis=1)
        rows, columns = linear_sum_assignment(np.nan_to_num(costs, nan=1e9))
        partner_of = dict(zip(unlike[rows].tolist(), unlike[columns].tolist(), strict=True))
        cost_of = dict(zip(unlike[rows].tolist(), costs[rows, columns].tolist(), strict=True))
        left = set(partner_of)
        while left:
            cycle, number = list[int](), min(left)
            while number in left:
                left.remove(number)
                cycle.append(number)
                number = partner_of[number]
            limits = [min(LIKE, self.before[number] / BETTER) for number in cycle]
            if len(cycle) > 1 and all(cost_of[n] <= limit for n, limit in zip(cycle, limits, strict=True)):
                distances = self.before.copy()
                distances[cycle] = [cost_of[number] for number in cycle]
                partners = tuple(partner_of[number] for number in cycle)
                yield (
                    Misfit(
                        "exchange", tuple(cycle), False, self._exchange_words(cycle, partners), partners=partners
                    ),
                    distances,
                )

    def _of_partner(self, numbers: NDArray[np.intp], partner: int) -> Numbers:
        """Return the distance of every one of some numbers, if the partner's values stood in its place."""
        order = np.full(len(numbers), partner)
        return self.expected.reordered(numbers).distance(self.recorded.reordered(order))

    def _mirrors(self) -> list[tuple[Kind, float, Numbers]]:
        """Return the sign, and the gripper turned round: x becomes least plus largest value minus x."""
        low, high = self.expected.bounds
        ends = np.where(np.abs(low) <= 0.1 * (high - low), low + high, np.nan)
        return [("sign", -1.0, np.zeros(self.expected.width)), ("inverted", -1.0, ends)]

    def _factors(self, free: NDArray[np.bool_]) -> list[tuple[float, tuple[int, ...], Numbers]]:
        """Return every factor with the numbers that it explains, and their distances under it."""
        factors = [value for factor in FACTORS for value in (factor, 1 / factor)]
        distances = np.stack([self.expected.distance(self.recorded.mapped(1 / factor)) for factor in factors])
        fits = free & (self.before >= FAR) & (distances <= self.before / BETTER)
        # Degrees are the more frequent cause: percent has to fit clearly better.
        percent = [max(factor, 1 / factor) == PERCENT for factor in factors]
        distances = np.where(np.array(percent)[:, None], CLEARLY, 1) * distances
        best = [int(np.nanargmin(np.where(fits[:, n], distances[:, n], np.inf))) if fits[:, n].any() else -1
                for n in range(self.expected.width)]  # fmt: skip
        counts = Counter(index for index in best if index >= 0)
        low, high = self.expected.support
        least, most = self.recorded.bounds
        inside = np.stack([(least / factor >= low) & (most / factor <= high) for factor in factors])
        # Numbers of one cause get the factor of most of them, where that is as plausible: degrees and percent are
        # less than twice apart, and a number that moves less than in training fits several factors.
        for number, index in enumerate(best):
            near = [
                other
                for other in counts
                if index >= 0
                and fits[other, number]
                and (factors[other] > 1) == (factors[index] > 1)
                and (inside[other, number] or 0.5 < factors[other] / factors[index] < 2)
            ]
            if near:
                best[number] = max(near, key=lambda other: (counts[other], -distances[other, number]))
        groups = {index: tuple(n for n, other in enumerate(best) if other == index) for index in counts}
        return [
            (factors[index], numbers, distances[index] / (CLEARLY if percent[index] else 1))
            for index, numbers in groups.items()
            if numbers
        ]

    # -- explanations by the place alone -----------------------------------------------------------------

    def _locate(self, explained_numbers: set[int]) -> list[Misfit]:
        """Return the factor that explains the place of numbers whose spread shows nothing.

        These are the beginnings of episodes, and numbers that never move and lie outside.
        """
        factors = [value for factor in FACTORS for value in (factor, 1 / factor)]
        scale = np.where(self.moves_in_training, self.expected.scales(self.expected)[0], np.nan)
        center = self.expected.center

        def off(values: Numbers) -> Numbers:
            return np.asarray(np.abs(values - center) / scale)

        before = off(self.observed.center)
        after = np.stack([off(self.observed.center / factor) for factor in factors])
        low, high = self.expected.bounds
        inside = np.stack([
            (np.abs(self.frames / factor - (low + high) / 2) <= high - low).all(axis=0)
            for factor in factors
        ])  # fmt: skip
        # A number that is zero in every unit, or zero in training, shows no factor.
        informative = (np.abs(center) > scale / 2) & self.begins
        # The spread of what moves was compared already, and no factor explained it.
        free = ~np.isin(np.arange(self.expected.width), list(explained_numbers)) & (self.begins | ~self.moves)
        fits = free & inside & (after <= before / 2) & (informative | self.is_outside)
        counts = fits.sum(axis=1)
        totals = np.where(fits, np.log1p(before) - np.log1p(after), 0).sum(axis=1)
        if not counts.any():
            return []
        index = int(np.argmax(totals))
        numbers = tuple(np.flatnonzero(fits[index]).tolist())
        sure = bool(self.is_outside[list(numbers)].any())
        if sure or len(numbers) >= max(LEAST_NUMBERS, MOST_NUMBERS * np.nansum(informative)):
            return [Misfit("factor", numbers, sure, self._factor_words(factors[index], numbers), factors[index])]
        return []

    @property
    def moves_in_training(self) -> NDArray[np.bool_]:
        """A mask (D,) of the compared numbers that the checkpoint saw move."""
        return np.asarray(self.expected.compared & ~self.expected.is_still)

    # -- what is only suspicious -------------------------------------------------------------------------

    def _narrow(self, explained_numbers: set[int]) -> Iterator[Misfit]:
        """Yield the numbers that hardly move, where these are half of those that moved in training or more."""
        expected, recorded = self.expected.scales(self.recorded)
        ratio = np.where(self.moves, recorded / np.where(expected > 0, expected, 1), np.nan)
        numbers = [n for n in np.flatnonzero(ratio < NARROW).tolist() if n not in explained_numbers]
        if numbers and 2 * len(numbers) >= self.moves.sum():
            times = float(1 / np.nanmedian(ratio[numbers]))
            words = (
                f"{self._list_names(numbers)} vary {times:.0f} times less than in training: a narrow part of its "
                "workspace, or other units"
            )
            yield Misfit("narrow", tuple(numbers), False, words)

    # -- words -------------------------------------------------------------------------------------------

    def _name(self, number: int) -> str:
        name = self.names[number]
        return f"number {name}" if name.isdecimal() else f"{name} (number {number})"

    def _list_names(self, numbers: Sequence[int]) -> str:
        names = [self._name(number) for number in numbers[:_LISTED]]
        more = [f"{len(numbers) - _LISTED} more"] if len(numbers) > _LISTED else []
        *first, last = [*names, *more]
        return f"{', '.join(first)} and {last}" if first else last

    def _ranges(self, number: int) -> str:
        low, high = self.expected.bounds
        values = self.frames[:, number]
        return (
            f"{self.names[number]} from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}, "
            f"expected {low[number]:.3g} to {high[number]:.3g}"
        )

    def _factor_words(self, factor: float, numbers: Sequence[int]) -> str:
        times = max(factor, 1 / factor)
        small, large = next(units for value, units in FACTORS.items() if np.isclose(value, times))
        size, had, due = ("larger", small, large) if factor > 1 else ("smaller", large, small)
        return (
            f"{self._list_names(numbers)} about {_figures(times)} times {size} than in training, as {had} for "
            f"{due} ({self._ranges(numbers[0])})"
        )

    def _mirror_words(self, kind: Kind, number: int, offset: Numbers) -> str:
        if kind == "sign":
            return f"{self._name(number)} has the other sign ({self._ranges(number)})"
        return f"{self._name(number)} is turned round, x for {offset[number]:.3g} − x ({self._ranges(number)})"

    def _exchange_words(self, numbers: Sequence[int], partners: Sequence[int]) -> str:
        pairs = zip(numbers, partners, strict=True)
        stand = [f"{self._name(partner)} looks like {self._name(number)}" for number, partner in pairs]
        return f"numbers are exchanged: {', '.join(stand)} of the training data"

    def _offset_words(self, number: int, offset: float) -> str:
        return f"{self._name(number)} is shifted by {offset:.3g} ({self._ranges(number)})"

    def _outside_words(self, number: int) -> str:
        return (
            f"{self._name(number)} lies outside the statistics in {self.shares[number]:.0%} of the frames "
            f"({self._ranges(number)})"
        )


def _figures(times: float) -> str:
    """Return a factor in figures, such as 57.3 and 1,000."""
    return f"{times:,.1f}".removesuffix(".0")
