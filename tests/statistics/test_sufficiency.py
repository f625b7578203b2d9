"""What the plan calls enough is what the methods do with so many groups."""

import re
import warnings
from math import ceil, inf
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats  # type: ignore[import-untyped]

from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap
from probe_kit.statistics.label_permutations import ENUMERATED_BELOW, flip_groups, possible_flips, smallest_p
from probe_kit.statistics.paired_tests import EXACT, max_t, smallest_flip_p
from probe_kit.statistics.significance import SIGNIFICANCE, chance_margin, items_for_width
from probe_kit.statistics.sufficiency import (
    ABSENT_BELOW,
    GROUPS_FOR_PROBES,
    GROUPS_FOR_RETENTION,
    groups_for_absence,
    groups_for_interventions,
    groups_for_not_used,
    groups_for_signal,
    groups_to_decide,
    items_for_absence,
    least_probe_p,
)
from tests.train.conftest import problem_of


def episodes(groups: int) -> pd.DataFrame:
    """Two items of two layouts per group."""
    rows = [
        {
            "episode_id": f"{group}-{item}:{layout[0]}", "item_id": f"{group}-{item}", "group_id": f"g{group}",
            "category": "color", "layout": layout, "side_correct": side, "side_placed": side, "outcome": "correct",
            "target_concept": f"a{group}", "distractor_concept": f"b{group}",
        }
        for group in range(groups)
        for item in range(2)
        for layout, side in (("original", "left"), ("swapped", "right"))
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize("groups", range(2, ENUMERATED_BELOW))
def test_possible_flips_are_those_that_are_made(groups: int) -> None:
    table = episodes(groups)
    labels = (table["side_correct"] == "left").to_numpy()
    assert flip_groups(labels, table["group_id"], 5000, 0).shape[1] == possible_flips(groups)
    assert least_probe_p(groups) == smallest_p(possible_flips(groups))


@pytest.mark.parametrize("groups", range(3, 9))
def test_train_refuses_and_warns_where_the_plan_says_so(groups: int) -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        if groups < GROUPS_FOR_PROBES:
            with pytest.raises(
                TooFewGroupsError, match=f"{groups} independent groups .* {GROUPS_FOR_PROBES} folds"
            ):
                problem_of(episodes(groups), permutations=1000)
            return
        problem_of(episodes(groups), permutations=1000)
    assert any("the smallest possible p" in str(caught.message) for caught in warned) == (
        groups < groups_for_signal()
    )


@pytest.mark.parametrize("groups", range(2, EXACT + 2))
def test_no_sign_flip_gives_a_smaller_p(groups: int) -> None:
    effects = np.repeat(np.linspace(1, 2, groups), 2)[None, :]
    names = np.repeat(np.arange(groups), 2)
    _, p, _ = max_t(effects, np.arange(2 * groups), names, 0)
    assert p[0] >= smallest_flip_p(groups)
    if groups <= EXACT:
        assert p[0] == smallest_flip_p(groups)
    assert (smallest_flip_p(groups) < SIGNIFICANCE) == (groups >= groups_for_interventions())


@pytest.mark.parametrize("size", [2, 4, 8])
def test_absence_can_be_said_where_the_limit_at_one_half_is_below_the_bound_and_the_bound_is_found(
    size: int,
) -> None:
    def limit(groups: int) -> float:
        """Korn and Graubard's, of groups that vary as single episodes do, with a variance of G − 1 degrees."""
        count = groups * size
        lost = stats.t.ppf(1 - SIGNIFICANCE, count - 1) / stats.t.ppf(1 - SIGNIFICANCE, groups - 1)
        trials = count * (groups - 1) / groups * lost**2  # the variance is that of a sample, over G − 1
        return float(stats.beta.ppf(1 - SIGNIFICANCE, trials / 2 + 1, trials / 2))

    def is_found(groups: int) -> bool:
        """Whether a site at the bound exceeds the 95 % point of guessing in four of five experiments."""
        count = groups * size
        threshold = stats.norm.ppf(1 - SIGNIFICANCE, 0.5, np.sqrt(0.25 / count))
        trials = count * (groups - 1) / groups
        return bool(
            stats.norm.sf(threshold, ABSENT_BELOW, np.sqrt(ABSENT_BELOW * (1 - ABSENT_BELOW) / trials)) >= 0.8
        )

    groups_needed = groups_for_absence(size)
    even = [groups for groups in range(4, 60, 2) if limit(groups) < ABSENT_BELOW and is_found(groups)]
    assert even[0] - 1 <= groups_needed <= even[0]
    assert groups_needed >= GROUPS_FOR_RETENTION


def test_the_fewest_groups_are_those_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs/statistics.md").read_text(encoding="utf-8")
    lines = dict(re.findall(r"^\| ([a-z ]+) \| .* \| (\d+)[^|]*\|$", page, re.MULTILINE))
    computed = {
        "probes": GROUPS_FOR_PROBES, "retention": GROUPS_FOR_RETENTION, "shown": groups_for_signal(),
        "absent": groups_for_absence(4), "interventions": groups_for_interventions(),
        "not used": groups_for_not_used(),
    }  # fmt: skip
    assert {name: int(lines[name]) for name in computed} == computed
    assert f"± 10 points take {items_for_width(0.2)} items" in page


def test_the_margin_of_so_many_items_is_the_one_that_was_asked_for() -> None:
    for margin in (0.05, 0.1, 0.2):
        items = items_for_width(2 * margin)
        assert chance_margin(items) <= margin < chance_margin(items - 1)


def test_groups_that_would_decide_an_effect_grow_with_its_interval_and_its_nearness_to_the_bound() -> None:
    follow, share = (0.04, 0.8, 0.25), (0.03, 0.16, 0.1)
    assert groups_to_decide(6, (follow, share)) == pytest.approx(6 * (0.4 / 0.21) ** 2), "both are to be small"
    assert groups_to_decide(6, (follow, (0.3, 0.4, 0.1))) == pytest.approx(7), "use is all but shown"
    assert groups_to_decide(6, (follow, (0.1, 0.16, 0.1))) == inf, "it lies at its bound"
    for groups in (2, 40):
        needed = groups_to_decide(groups, ((0.0, inf, 0.25), (0.0, inf, 0.1)))
        assert needed == max(groups + 1, groups_for_not_used()), "there is no interval"


def test_as_many_groups_as_are_said_decide_an_effect_that_stays() -> None:
    """The bootstrap of many more groups of the same kind has the interval that the number was computed from."""
    effects = 0.1 + 0.4 * np.resize([-1.0, 1.0], (24, 1))
    (low,), (high,) = group_bootstrap(effects, np.arange(24), 0, bounds=GAINS)
    needed = ceil(groups_to_decide(24, [(0.1, float(high - low), 0.25)]))
    assert needed > 24
    larger = np.resize(effects, (needed, 1))
    assert group_bootstrap(larger, np.arange(needed), 0, bounds=GAINS)[1][0] == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize("size", [1, 2, 4])
def test_items_for_absence_are_those_of_groups_of_the_same_size(size: int) -> None:
    needed = groups_for_absence(2 * size)
    assert items_for_absence(10 * size, 10, 20 * size) == needed * size
