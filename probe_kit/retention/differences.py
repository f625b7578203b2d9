"""Groups of runs against each other: what co-training, fine-tuning or RL changed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from probe_kit.retention.estimates import Estimate, Estimates, Limits, average
from probe_kit.retention.mean_row import average_estimates
from probe_kit.retention.rows import MEAN
from probe_kit.retention.run_rows import Drawn


@dataclass(frozen=True)
class Difference:
    """`group` minus `minus` in one category and view, each group the mean of its runs; 95 % intervals.

    paired: whether both ran the same items, which are then drawn together; otherwise each group's on its own.
    `retention` is the debiased one, `retention_bounded` the one that tables lead with; None unless defined in both
    groups. call: the captured inference that both were probed at, None without probes or where they differ. In a
    row of category `mean`, numbers are averages over the categories that both groups have.
    """

    group: str
    minus: str
    category: str
    view: str | None
    paired: bool
    sr: float | None = None
    sr_ci: Limits | None = None
    prefix_accuracy: float | None = None
    prefix_ci: Limits | None = None
    action_accuracy: float | None = None
    action_ci: Limits | None = None
    retention: float | None = None
    retention_ci: Limits | None = None
    retention_bounded: float | None = None
    retention_bounded_ci: Limits | None = None
    retention_area: float | None = None
    retention_area_ci: Limits | None = None
    call: int | None = None


def group_differences(groups: Mapping[str, Sequence[Drawn]]) -> list[Difference]:
    """Every group minus every later one, per view and category and over all of them."""
    found = []
    for name, other in combinations(groups, 2):
        here, there = (_by_view(groups[one]) for one in (name, other))
        calls = {one.row.call for one in (*groups[name], *groups[other])}
        call = calls.pop() if len(calls) == 1 else None
        for view in here:
            if view in there:
                found += [replace(row, call=call) for row in _compare(name, other, view, here[view], there[view])]
    return found


def _by_view(drawn: Sequence[Drawn]) -> dict[str | None, dict[str, Estimates]]:
    """Estimates per view and category, averaged over runs; a quantity that a run lacks is left out."""
    views: dict[str | None, dict[str, list[Estimates]]] = {}
    for one in drawn:
        views.setdefault(one.row.view, {}).setdefault(one.row.category, []).append(one.estimates)
    return {
        view: {category: _average_common(found) for category, found in categories.items()}
        for view, categories in views.items()
    }


def _average_common(found: Sequence[Estimates]) -> Estimates:
    return {name: average([one[name] for one in found]) for name in found[0] if all(name in one for one in found)}


def _compare(
    group: str, minus: str, view: str | None, here: Mapping[str, Estimates], there: Mapping[str, Estimates]
) -> list[Difference]:
    common = [category for category in here if set(here[category]) & set(there.get(category, {}))]
    gaps = {
        category: {
            name: estimate - there[category][name]
            for name, estimate in here[category].items()
            if name in there[category]
        }
        for category in common
    }
    paired = {category: _drawn_alike(here[category], there[category]) for category in common}
    rows = [_row(group, minus, category, view, paired[category], gap) for category, gap in gaps.items()]
    if rows:
        rows.append(_row(group, minus, MEAN, view, all(paired.values()), average_estimates(list(gaps.values()))))
    return rows


def _drawn_alike(here: Estimates, there: Estimates) -> bool:
    """Whether both drew the same items: seen at the first quantity that both have, SR where both acted."""
    name = next(name for name in here if name in there)
    return here[name].units == there[name].units


def _row(group: str, minus: str, category: str, view: str | None, paired: bool, gap: Estimates) -> Difference:
    sr = _value(gap.get("sr"))
    prefix, action = (_value(gap.get(f"{part}_accuracy")) for part in ("prefix", "action"))
    debiased, bounded, area = (_value(gap.get(f"retention_{part}")) for part in ("debiased", "bounded", "area"))
    return Difference(group, minus, category, view, paired, *sr, *prefix, *action, *debiased, *bounded, *area)


def _value(estimate: Estimate | None) -> tuple[float | None, Limits | None]:
    return (None, None) if estimate is None else (estimate.value, estimate.ci)
