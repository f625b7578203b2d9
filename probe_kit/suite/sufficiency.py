"""The uses for which a suite has enough items: success rate, probes, retention, verdicts, interventions.

A plan states it before any work. The later commands that refuse too few items use the same numbers, see
`statistics.sufficiency`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from probe_kit._system.counting import plural
from probe_kit.statistics.label_permutations import ENUMERATED_BELOW
from probe_kit.statistics.significance import SIGNIFICANCE, chance_margin, items_for_width
from probe_kit.statistics.sufficiency import (
    GROUPS_FOR_PROBES,
    GROUPS_FOR_RETENTION,
    groups_for_absence,
    groups_for_interventions,
    groups_for_not_used,
    groups_for_signal,
    least_probe_p,
    probe_command,
)
from probe_kit.suite.items import LAYOUTS
from probe_kit.suite.suite import Suite

__all__ = [
    "GROUPS_FOR_PROBES",
    "MARGIN",
    "Smallest",
    "Sufficiency",
    "probe_command",
    "sufficiencies",
]


MARGIN = 0.1
"""Margin of a success rate for which the plan gives a number of items."""


@dataclass(frozen=True)
class Sufficiency:
    """One use for which there must be enough items.

    Attributes:
        enough: Whether there are enough items; None where it is a matter of degree.
        words: The reason, and how many items are enough.
    """

    name: str
    enough: bool | None
    words: str


@dataclass(frozen=True)
class Smallest:
    """The category with the fewest independent groups.

    Attributes:
        items: Number of its items.
        groups: Number of its independent groups.
        suite: The suite that the items were selected from.
    """

    category: str
    items: int
    groups: int
    suite: Suite

    @classmethod
    def of(cls, suite: Suite) -> "Smallest":
        """Return the category with the fewest groups; of equal ones that with fewer items, then the first."""
        of_category = {name: [item for item in suite.items if item.category == name] for name in suite.categories}
        counts = {
            name: (len({item.group_id for item in items}), len(items)) for name, items in of_category.items()
        }
        name = min(counts, key=lambda category: counts[category])
        return cls(name, counts[name][1], counts[name][0], suite.complete)

    @property
    def words(self) -> str:
        """The category in a few words."""
        return f"{self.category}: {plural(self.items, 'item')} in {plural(self.groups, 'independent group')}"

    def items_for(self, groups: int) -> int | None:
        """Return the fewest items that `--items` can select with so many groups; None if the suite lacks them."""
        items = [item for item in self.suite.items if item.category == self.category]
        for number in range(1, len(items) + 1):
            apart = {member.pair_id for member in items[:number]} & {member.pair_id for member in items[number:]}
            if not apart and len({member.group_id for member in items[:number]}) >= groups:
                return number
        return None

    def has(self, groups: int, otherwise: str, at_best: bool = False) -> tuple[bool, str]:
        """Tell whether there are so many groups, and what follows.

        Args:
            groups: Number of groups that are needed.
            otherwise: Consequence of fewer groups, in words.
            at_best: Whether so many groups only make the use possible.
        """
        need = f"{self.groups} groups of {groups} needed"
        if self.groups >= groups:
            return True, f"{'possible' if at_best else 'yes'}, {need}"
        items = self.items_for(groups)
        of_category = {item.group_id for item in self.suite.items if item.category == self.category}
        more = (
            f"take {items}{' or more' if at_best else ' items'}" if items else f"the suite has {len(of_category)}"
        )
        return False, f"no, {need}: {otherwise}; {more}"


def sufficiencies(suite: Suite, scored: bool, probed: bool) -> Iterator[Sufficiency]:
    """Yield the uses for which the smallest category of `suite` has enough items, or too few.

    Args:
        suite: Suite whose items are used.
        scored: Whether there will be success rates.
        probed: Whether there will be activations.
    """
    smallest = Smallest.of(suite)
    if scored:
        margin, items = 100 * chance_margin(smallest.items), items_for_width(2 * MARGIN)
        more = "" if smallest.items >= items else f"; ± {100 * MARGIN:g} takes {items} items"
        informative = margin < 50  # else not even 100 % is beyond guessing
        yield Sufficiency("success rate", None if informative else False, f"Δ = ± {margin:.1f} points{more}")
    if not probed:
        return
    yield Sufficiency("probes", *smallest.has(GROUPS_FOR_PROBES, "`train` refuses it"))
    yield Sufficiency("retention", *smallest.has(GROUPS_FOR_RETENTION, "no score"))
    reachable, words = smallest.has(groups_for_signal(), f"no p below {SIGNIFICANCE}")
    yield Sufficiency("shown", reachable, words + (_chances(smallest.groups) if reachable else ""))
    absent = groups_for_absence(round(len(LAYOUTS) * smallest.items / smallest.groups))
    yield Sufficiency("absent", *smallest.has(absent, "limits too wide", at_best=True))
    yield Sufficiency("interventions", *smallest.has(groups_for_interventions(), f"no p below {SIGNIFICANCE}"))
    yield Sufficiency("not used", *smallest.has(groups_for_not_used(), "limits too wide", at_best=True))


def _chances(groups: int) -> str:
    """Return the smallest p where the groups decide it; for more groups the command that simulates the power."""
    return f", p from {least_probe_p(groups):.2g}" if groups < ENUMERATED_BELOW else "; power: `probe-kit power`"
