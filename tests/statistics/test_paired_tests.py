"""Exact tests of paired differences, and their corrections."""

from collections.abc import Sequence
from itertools import product
from math import comb
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, norm

from probe_kit.retention import retention_table
from probe_kit.retention.compare.known_used import OVERALL, join_runs
from probe_kit.retention.rows.row import MEAN
from probe_kit.statistics.paired_tests import (
    EXCHANGES,
    SHARED_DECISIONS,
    better_than_best,
    better_than_reference,
    clopper_pearson,
    fisher_p,
    flip_p,
    greater_p,
    holm,
    least_column_p,
    max_t,
    mcnemar_p,
    overlap_p,
    paired_greater_p,
    sign_p,
    unit_means,
)
from tests.retention.asked_runs import SaidRun, acted, answer_run


@pytest.mark.parametrize(("more", "less"), [(0, 0), (5, 5), (1, 0), (9, 1), (2, 11), (40, 20)])
def test_the_sign_test_is_the_exact_binomial_one(more, less):
    expected = binomtest(more, more + less).pvalue if more + less else 1.0
    assert sign_p(more, less) == pytest.approx(expected)
    assert sign_p(less, more) == sign_p(more, less)


def test_all_positive_is_as_likely_as_that_many_heads() -> None:
    assert greater_p(np.full(24, 0.1)) == 2.0**-24
    assert greater_p(np.full(24, -0.1)) == 1.0


def test_differences_of_zero_take_no_part_in_the_sign_flips() -> None:
    assert greater_p(np.array([0.1] * 5 + [0.0] * 100)) == 2.0**-5
    assert greater_p(np.array([0.1] * 5 + [1e-12, -1e-12])) == 2.0**-5
    assert greater_p(np.zeros(4)) == 1.0


def test_it_is_the_binomial_tail() -> None:
    effects = np.array([1.0] * 9 + [-1.0] * 4)
    assert greater_p(effects) == pytest.approx(sum(comb(13, k) for k in range(9, 14)) / 2**13)


def test_layouts_of_an_item_are_one_effect() -> None:
    """A habit of one side moves both layouts alike, against the correct side in one of them."""
    values = np.array([0.3, -0.1, 0.2, -0.4])
    np.testing.assert_allclose(unit_means(values, ["a", "a", "b", "b"]), [0.1, -0.1])


def test_items_that_share_pictures_count_once() -> None:
    values, items = np.full(12, 0.1), [f"item-{number}" for number in range(12)]
    groups = ["one"] * 10 + ["two", "three"]
    assert paired_greater_p(values, items, items) == 2.0**-12
    assert paired_greater_p(values, items, groups) == 2.0**-3


def test_under_the_null_small_p_values_are_as_rare_as_they_say() -> None:
    """One-sided binomial test at 5 % over 400 worlds in which nothing follows anything."""
    draw = np.random.default_rng(0)
    rejections = sum(greater_p(draw.normal(size=24)) < 0.05 for _ in range(400))
    assert rejections <= 27  # P(more | 400, 0.05) < 0.05


def bools(text: str) -> np.ndarray:
    return np.array([mark == "1" for mark in text])


def test_mcnemar_counts_only_items_on_which_the_two_differ() -> None:
    assert mcnemar_p(bools("1111100000"), bools("1111100000")) == 1
    assert mcnemar_p(bools("111111"), bools("000000")) == pytest.approx(2 / 2**6)
    assert mcnemar_p(bools("1111110"), bools("0000001")) == pytest.approx(2 * (1 + 7) / 2**7)


@pytest.mark.parametrize("seed", range(4))
def test_flips_of_whole_groups_are_those_of_an_enumeration(seed: int) -> None:
    draw = np.random.default_rng(seed)
    first, second = draw.random(21) < 0.7, draw.random(21) < 0.4
    groups = draw.integers(0, 8, 21)
    gains = np.array([(first[groups == g].astype(int) - second[groups == g]).sum() for g in range(8)])
    totals = [abs(np.dot(signs, gains)) for signs in product((1, -1), repeat=8)]
    expected = np.mean([total >= abs(gains.sum()) for total in totals])
    assert flip_p(first, second, groups) == pytest.approx(expected)


def test_groups_that_answer_alike_are_one_toss() -> None:
    first, second, groups = np.ones(20, bool), np.zeros(20, bool), np.repeat([0, 1], 10)
    assert flip_p(first, second, groups) == 0.5
    assert flip_p(first, second, np.arange(20)) == pytest.approx(mcnemar_p(first, second))
    assert flip_p(first, first, groups) == 1


def test_shares_have_exact_intervals() -> None:
    assert clopper_pearson(0, 10) == (0, pytest.approx(1 - 0.025 ** (1 / 10)))
    assert clopper_pearson(10, 10) == (pytest.approx(0.025 ** (1 / 10)), 1)
    assert clopper_pearson(0, 0) == (0, 1)
    low, high = clopper_pearson(4, 20)
    assert (low, high) == (pytest.approx(0.0573, abs=1e-4), pytest.approx(0.4366, abs=1e-4))


def test_links_of_two_properties_are_found_and_none_is_not() -> None:
    tea = bools("11110000"), bools("11101000")  # Fisher's lady
    assert fisher_p(*tea) == pytest.approx(34 / 70)
    same = bools("1010101010" * 4)
    strata = np.repeat([0, 1], 20)
    assert overlap_p(same, same, strata, 0) < 0.001
    assert overlap_p(same, bools("1100110011" * 4), strata, 0) > 0.2


def test_two_strata_that_only_differ_in_level_show_no_link() -> None:
    """Both are right in one category and wrong in the other: within each nothing goes together."""
    both, strata = np.repeat([True, False], 20), np.repeat([0, 1], 20)
    assert overlap_p(both, both, strata, 0) == 1
    assert fisher_p(both, both) < 0.001


def test_holm_is_holms() -> None:
    assert holm([0.01, None, 0.04, 0.03]) == [pytest.approx(0.03), None, pytest.approx(0.06), pytest.approx(0.06)]
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.9, 0.8]) == [1, 1]
    assert holm([]) == []


def test_a_site_that_nothing_reads_stays_finite_and_says_nothing() -> None:
    items = np.repeat(np.arange(10), 2)
    t, p, p_fwe = max_t(np.stack([np.zeros(20), np.full(20, 0.1)]), items, items, 0)
    assert np.isfinite(t).all()
    assert t[0] == 0
    assert p[0] == 1.0
    assert p[1] == p_fwe[1] == pytest.approx(2.0**-10)


def test_the_sign_counts() -> None:
    items = np.arange(8)
    _, p, _ = max_t(np.stack([np.full(8, 0.1), np.full(8, -0.1)]), items, items, 0)
    assert p.tolist() == [2.0**-8, 1.0]


def test_items_of_a_group_turn_together() -> None:
    values, items = np.full((1, 12), 0.1), np.arange(12)
    _, p, _ = max_t(values, items, items % 3, 0)
    assert p[0] == 2.0**-3


def test_looking_at_more_sites_costs() -> None:
    draw = np.random.default_rng(0)
    items, values = np.arange(10), draw.normal(size=(1, 10)) + 0.6
    _, _, alone = max_t(values, items, items, 0)
    _, _, among = max_t(np.vstack([values, draw.normal(size=(20, 10))]), items, items, 0)
    assert among[0] > alone[0]


def test_no_world_without_effects_is_called_significant_too_often() -> None:
    """One-sided binomial test at 5 % over 200 worlds of 16 sites whose items share noise."""
    draw, items, rejections = np.random.default_rng(1), np.repeat(np.arange(14), 2), 0
    for world in range(200):
        values = draw.normal(size=(16, 28)) + draw.normal(size=(1, 28))
        rejections += bool((max_t(values, items, items, world)[2] < 0.05).any())
    assert rejections <= 15  # P(more | 200, 0.05) < 0.05


def test_a_first_column_below_all_others_is_as_likely_as_that_place_in_every_group() -> None:
    values = np.column_stack([np.zeros(6), np.ones((6, 3))])
    assert least_column_p(values, list("abcdef"), 0) == pytest.approx(4.0**-6, abs=1e-3)
    assert least_column_p(values, list("aabbcc"), 0) == pytest.approx(4.0**-3, abs=1e-2), (
        "rows of a group move as one"
    )
    assert least_column_p(np.ones((6, 3)), list("abcdef"), 0) == 1.0


@pytest.mark.parametrize("seed", range(4))
def test_two_columns_are_the_test_by_signs(seed: int) -> None:
    values = np.random.default_rng(seed).lognormal(0.0, 1.5, (10, 2)) / [2, 1]
    _, (p,), _ = max_t((values[:, 1] - values[:, 0])[None], range(10), range(10), 0)
    assert least_column_p(values, range(10), 0) == pytest.approx(p, abs=0.04)


@pytest.mark.parametrize("columns", [2, 4])
def test_columns_that_do_not_differ_are_told_apart_in_five_of_a_hundred_draws(columns: int) -> None:
    rng = np.random.default_rng(columns)
    groups = np.repeat(np.arange(8), 2)
    alarms = 0
    for seed in range(400):
        of_group = rng.lognormal(0.0, 2.0, (8, columns))[groups]
        alarms += least_column_p(of_group * rng.lognormal(0.0, 0.5, (16, columns)), groups, seed) < 0.05
    assert alarms <= 0.05 * 400 + 3 * np.sqrt(0.05 * 0.95 * 400)


GROUPS = np.repeat(np.arange(40), 4)


def right(share: float, sites: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((sites, GROUPS.size)) < share


def test_a_site_that_is_much_better_than_the_reference_gets_the_smallest_p() -> None:
    sites = np.concatenate([right(0.95, 1, 0), right(0.6, 3, 1)])
    p = better_than_reference(sites, right(0.6, 1, 2)[0].astype(float), GROUPS, seed=0)
    assert p[0] == 1 / (1 + EXCHANGES)
    assert (p[1:] > 0.05).all()


def test_the_best_of_many_equal_sites_is_rarely_better_than_the_reference() -> None:
    alarms = [
        better_than_reference(right(0.6, 20, seed), np.full(GROUPS.size, 0.6), GROUPS, seed).min() < 0.05
        for seed in range(100)
    ]
    assert np.mean(alarms) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def test_the_best_of_many_sites_is_rarely_better_than_the_best_of_as_many_others() -> None:
    alarms = [
        better_than_best(right(0.6, 20, 2 * seed), right(0.6, 20, 2 * seed + 1), GROUPS, seed).min() < 0.05
        for seed in range(100)
    ]
    assert np.mean(alarms) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def similarity_decisions(above: float, groups: int, draws: int, seed: int) -> np.ndarray:
    """(draws, G) whether each group is right that is decided by its similarity to all others: no fit is needed.

    The similarity of two groups is one number, which takes part in the decisions of both.
    """
    generator = np.random.default_rng(seed)
    similarity = np.triu(generator.standard_normal((draws, groups, groups)), 1)
    values = (similarity + similarity.transpose(0, 2, 1)).sum(axis=2) / np.sqrt(groups - 1)
    right: np.ndarray = values + norm.ppf(0.5 + above) > 0
    return right


@pytest.mark.parametrize("above", [0.0, 0.1, 0.25, 0.4])
def test_groups_that_train_each_others_probes_widen_the_spread_of_an_accuracy(above: float) -> None:
    accuracy, share = similarity_decisions(above, 40, 3000, 0).mean(axis=1), 0.5 + above
    independent = np.sqrt(share * (1 - share) / 40)
    excess = norm.pdf(norm.ppf(share)) ** 2 / (share * (1 - share))
    assert accuracy.std() / independent == pytest.approx(np.sqrt(1 + excess), rel=0.04)
    assert np.sqrt(1 + excess) <= SHARED_DECISIONS + 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("above", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("sites", [1, 4])
def test_sites_of_shared_probes_rarely_exceed_a_control_that_is_as_good(above: float, sites: int) -> None:
    """Sites and layers are trained on the same groups, by features of their own."""
    decisions = similarity_decisions(above, 30, 200 * (sites + 5), sites).reshape(200, sites + 5, 30)
    groups = np.arange(30)
    alarms = [
        better_than_reference(each[:sites], each[sites:].mean(axis=0), groups, seed).min() < 0.05
        for seed, each in enumerate(decisions)
    ]
    assert np.mean(alarms) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 200)


def test_a_signal_in_one_site_is_better_than_the_best_of_the_twin() -> None:
    site_hits = np.concatenate([right(0.6, 4, 0), right(0.9, 1, 1)])
    p = better_than_best(site_hits, right(0.6, 7, 2), GROUPS, seed=0)
    assert p[4] < 0.01
    assert (p[:4] > 0.05).all()


def test_a_model_is_not_better_than_itself() -> None:
    sites = right(0.7, 5, 0)
    assert (better_than_best(sites, sites, GROUPS, seed=0) > 0.3).all()


SHARES = {"color": (20, 0.9), "shape": (16, 0.7)}


def by_chance(seed: int, less: float = 0.0) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {category: draw.random((count, 2)) < share - less for category, (count, share) in SHARES.items()}


def stepped(values: Sequence[float]) -> list[float]:
    """Holm's steps, one by one."""
    adjusted = [0.0] * len(values)
    highest = 0.0
    for rank, position in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        highest = max(highest, min(1.0, (len(values) - rank) * values[position]))
        adjusted[position] = highest
    return adjusted


def check(rows: Sequence[tuple[float | None, float | None]], number: int) -> None:
    """rows: p and corrected p of a family."""
    assert len(rows) == number
    values = [p for p, _ in rows if p is not None]
    assert len(values) == number
    assert [p_holm for _, p_holm in rows] == [pytest.approx(p) for p in stepped(values)]
    assert len({round(p, 9) for p in values}) > 2, "the family must hold p-values that differ"


@pytest.fixture
def runs(tmp_path: Path) -> list[SaidRun]:
    vlms = [answer_run(tmp_path / f"r{n}", by_chance(n), called=f"vlm {n}") for n in range(2)]
    policies = [acted(tmp_path / f"p{n}", by_chance(9 + n, 0.15 * n), f"policy {n}") for n in range(3)]
    return [*vlms, *policies]


@pytest.mark.slow
def test_gaps_are_one_family_over_categories_and_pairs_and_means_another(runs: list[SaidRun]) -> None:
    gaps = retention_table(runs, vlm_vla=True).vlm_vla
    assert len({(gap.group, gap.minus) for gap in gaps}) == 6
    check([(gap.p, gap.p_holm) for gap in gaps if gap.category != "mean"], 12)
    check([(gap.p, gap.p_holm) for gap in gaps if gap.category == "mean"], 6)


def test_differences_are_one_family_and_means_another(runs: list[SaidRun]) -> None:
    differences = retention_table(runs[2:]).differences
    check([(row.p, row.p_holm) for row in differences if row.category != "mean"], 4)


def test_joins_that_a_report_shows_together_are_one_family(runs: list[SaidRun]) -> None:
    table = retention_table(runs)
    joins = join_runs(table.runs, table.results).tables
    tests = [
        comparison
        for join in joins
        for row in join.rows
        if row.category != OVERALL
        for comparison in row.comparisons
    ]
    check(
        [(comparison.p, comparison.p_holm) for comparison in tests], len(list(product(range(2), range(3), SHARES)))
    )
    summaries = [
        comparison
        for join in joins
        for row in join.rows
        if row.category == OVERALL
        for comparison in row.comparisons
    ]
    assert len(summaries) == 6
    assert all(summary.p_holm is None for summary in summaries)


def test_wordings_of_all_runs_are_one_family_over_categories_and_pairs(tmp_path: Path) -> None:
    wordings = retention_table([worded(tmp_path / f"run {seed}", seed) for seed in range(2)]).wordings
    check([(pair.p, pair.p_holm) for pair in wordings if pair.category != MEAN], 2 * 3 * 2)
    check([(pair.p, pair.p_holm) for pair in wordings if pair.category == MEAN], 2 * 3)


class Worded(SaidRun):
    """A run whose episodes were played in three wordings; tables show the first."""

    wordings = ("knowledge", "named", "side")

    @property
    def all_wordings(self) -> SaidRun:
        plain = [acted(Path(str(self.path)), by_chance(self.seed + n, -0.2 * n)).episodes for n in range(3)]
        tables = [
            table.assign(wording=name, episode_id=table["episode_id"] + f":{name}")
            for name, table in zip(self.wordings, plain, strict=True)
        ]
        return SaidRun(self.path, "policy", self.suite, pd.concat(tables, ignore_index=True), {})

    @property
    def seed(self) -> int:
        return int(self.settings["seed"])


def worded(path: Path, seed: int) -> SaidRun:
    plain = acted(path, by_chance(seed))
    episodes = plain.episodes.assign(wording="knowledge")
    return Worded(plain.path, "policy", plain.suite, episodes, {}, settings={"seed": 10 * seed})
