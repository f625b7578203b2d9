"""What the items of a suite are enough for: success rate, probes, retention, verdicts, interventions.

A plan says it before any work; what refuses later goes by the same numbers, see `statistics.sufficiency`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from probe_kit._system.counting import counted
from probe_kit.statistics.label_permutations import ENUMERATED_BELOW
from probe_kit.statistics.significance import SIGNIFICANCE, chance_margin, items_for_width
from probe_kit.statistics.sufficiency import (
    GROUPS_FOR_PROBES,
    GROUPS_FOR_RETENTION,
    groups_for_absence,
    groups_for_interventions,
    groups_for_signal,
    least_probe_p,
)
from probe_kit.suite.items import LAYOUTS
from probe_kit.suite.suite import Suite

__all__ = ["GROUPS_FOR_PROBES", "MARGIN", "Smallest", "Sufficiency", "sufficiencies"]

MARGIN = 0.1
"""Margin of a success rate that the plan gives a number of items for."""


@dataclass(frozen=True)
class Sufficiency:
    """One thing that items are to be enough for.

    enough: whether it is, None where it is a matter of degree. words: why, and how many items are enough.
    """

    name: str
    enough: bool | None
    words: str


@dataclass(frozen=True)
class Smallest:
    """The category with the fewest independent groups. whole: the suite that the items were selected from."""

    category: str
    items: int
    groups: int
    whole: Suite

    @classmethod
    def of(cls, suite: Suite) -> "Smallest":
        """Of categories with equally many groups the one with fewer items, then the first."""
        of_category = {name: [one for one in suite.items if one.category == name] for name in suite.categories}
        counts = {name: (len({one.group_id for one in own}), len(own)) for name, own in of_category.items()}
        name = min(counts, key=lambda category: counts[category])
        return cls(name, counts[name][1], counts[name][0], suite.whole)

    @property
    def words(self) -> str:
        """In a few words."""
        return f"{self.category}: {counted(self.items, 'item')} in {counted(self.groups, 'independent group')}"

    def items_for(self, groups: int) -> int | None:
        """The fewest items that `--items` can select with so many groups; None if the whole suite lacks them."""
        own = [item for item in self.whole.items if item.category == self.category]
        for number in range(1, len(own) + 1):
            apart = {one.pair_id for one in own[:number]} & {one.pair_id for one in own[number:]}
            if not apart and len({one.group_id for one in own[:number]}) >= groups:
                return number
        return None

    def has(self, groups: int, otherwise: str, at_best: bool = False) -> tuple[bool, str]:
        """Whether there are so many groups, and what follows. otherwise: what happens with fewer."""
        there = f"{self.groups} groups of {groups} needed"
        if self.groups >= groups:
            return True, f"{'possible' if at_best else 'yes'}, {there}"
        items = self.items_for(groups)
        more = (
            f"take {items}{' or more' if at_best else ' items'}" if items else f"the suite has {self._all_groups}"
        )
        return False, f"no, {there}: {otherwise}; {more}"

    @property
    def _all_groups(self) -> int:
        return len({item.group_id for item in self.whole.items if item.category == self.category})


def sufficiencies(suite: Suite, scored: bool, probed: bool) -> Iterator[Sufficiency]:
    """What the items of `suite` are enough for, in the smallest category.

    scored: whether there will be success rates. probed: whether there will be activations.
    """
    smallest = Smallest.of(suite)
    if scored:
        margin, items = 100 * chance_margin(smallest.items), items_for_width(2 * MARGIN)
        more = "" if smallest.items >= items else f"; ± {100 * MARGIN:g} takes {items} items"
        told = margin < 50  # else not even 100 % is beyond guessing
        yield Sufficiency("success rate", None if told else False, f"Δ = ± {margin:.1f} points{more}")
    if not probed:
        return
    yield Sufficiency("probes", *smallest.has(GROUPS_FOR_PROBES, "`train` refuses it"))
    yield Sufficiency("retention", *smallest.has(GROUPS_FOR_RETENTION, "no score"))
    shown, words = smallest.has(groups_for_signal(), f"no p below {SIGNIFICANCE}")
    yield Sufficiency("verdict shown", shown, words + (_chances(smallest.groups) if shown else ""))
    absent = groups_for_absence(round(len(LAYOUTS) * smallest.items / smallest.groups))
    yield Sufficiency("verdict absent", *smallest.has(absent, "limits too wide", at_best=True))
    yield Sufficiency("interventions", *smallest.has(groups_for_interventions(), f"no p below {SIGNIFICANCE}"))


def _chances(groups: int) -> str:
    """The smallest p where the groups decide it; of more groups the command that simulates the power."""
    return f", p from {least_probe_p(groups):.2g}" if groups < ENUMERATED_BELOW else "; power: `probe-kit power`"
