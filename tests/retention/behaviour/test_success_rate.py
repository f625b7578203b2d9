from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy.stats import beta, binomtest, t

from probe_kit.errors import SceneError, UsageError
from probe_kit.retention import Regime, chance_margin, normalised_score, sensitivity, success_rate
from probe_kit.retention.behaviour import paired_items, regime

Outcomes = Callable[..., pd.DataFrame]


@pytest.mark.parametrize(("n", "margin"), [(300, 0.0566), (140, 0.0828), (150, 0.0800)])
def test_the_margin_around_chance_matches_the_published_figures(n: int, margin: float) -> None:
    assert chance_margin(n) == pytest.approx(margin, abs=5e-5)


def test_the_normalised_score_matches_the_published_magma_row() -> None:
    magma = [0.72, 0.63, 0.59, 0.89, 0.81, 0.37, 0.51, 0.77, 0.88, 0.80, 0.94, 0.77]
    assert normalised_score(magma) == pytest.approx(44.67, abs=0.005)
    assert normalised_score([0.5]) == 0
    assert normalised_score([1.0, 1.0]) == 100


@pytest.mark.parametrize(
    ("sr", "wrong", "oob", "expected", "reason"),
    [
        (0.60, 0.30, 0.10, Regime.KNOWLEDGE, "above"),
        (0.55, 0.45, 0.00, Regime.NO_RELIABLE_KNOWLEDGE, "within"),
        (0.45, 0.15, 0.40, Regime.NO_RELIABLE_KNOWLEDGE, "within"),
        (0.20, 0.10, 0.70, Regime.FAILURE, "outside both zones in 70%"),
        (0.20, 0.70, 0.10, Regime.FAILURE, "wrong picture is chosen in 70%"),
    ],
)
def test_the_regime_says_why(sr: float, wrong: float, oob: float, expected: Regime, reason: str) -> None:
    name, why = regime(sr, 0.0566, wrong, oob)
    assert name is expected
    assert reason in why


def test_rates_add_up_and_split_by_layout_and_side(outcome_table: Outcomes) -> None:
    success = success_rate(outcome_table(correct=101, wrong=49, oob=50))
    assert (success.sr, success.share_wrong, success.share_outside) == (0.505, 0.245, 0.25)
    assert (success.n_episodes, success.n_items) == (200, 100)
    assert (success.sr_original, success.sr_swapped, success.layout_mean) == (0.51, 0.5, 0.505)
    assert success.sr_left is not None
    assert success.sr_right is not None
    assert (success.sr_left + success.sr_right) / 2 == pytest.approx(0.505)
    assert success.ci[0] < 0.505 < success.ci[1]
    assert success.chance_margin_episodes < success.chance_margin_items


def test_a_policy_that_always_goes_left_is_half_right_but_never_twice(outcome_table: Outcomes) -> None:
    episodes = outcome_table(correct=100, wrong=0, oob=0)
    episodes["side_placed"] = "left"
    episodes["outcome"] = (episodes["side_correct"] == "left").map({True: "correct", False: "wrong"})
    success = success_rate(episodes)
    assert success.sr == 0.5
    assert success.side_preference == 1.0
    assert (success.paired.both, success.paired.exactly_one, success.paired.none) == (0, 50, 0)
    assert (success.sr_left, success.sr_right) == (1.0, 0.0)


def test_items_right_twice_are_tested_against_items_wrong_twice(outcome_table: Outcomes) -> None:
    paired = paired_items(outcome_table(correct=28, wrong=12, oob=6))
    assert (paired.both, paired.exactly_one, paired.none, paired.both_wrong) == (14, 0, 9, 6)
    assert paired.p == pytest.approx(binomtest(14, 20, alternative="greater").pvalue)


def doubles(groups: int, knows: Callable[[int, int], bool]) -> pd.DataFrame:
    """Groups of two items, each right in both layouts or wrong in both."""
    rows = [
        {
            "item_id": f"{group}-{item}", "group_id": f"g{group}", "layout": layout, "side_correct": side,
            "side_placed": side, "outcome": "correct" if knows(group, item) else "wrong",
        }
        for group in range(groups)
        for item in range(2)
        for layout, side in (("original", "left"), ("swapped", "right"))
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_pairs_of_items_that_answer_alike_count_as_one_item() -> None:
    alike = success_rate(doubles(40, lambda group, _: group % 5 < 3))
    assert alike.chance_margin == pytest.approx(chance_margin(40))
    assert alike.chance_margin_items == pytest.approx(chance_margin(80))
    assert alike.regime is Regime.NO_RELIABLE_KNOWLEDGE, "0.60 of 160 episodes, but only 40 answers"
    assert alike.paired.p == pytest.approx(binomtest(24, 40, alternative="greater").pvalue)
    assert alike.ci[1] - alike.ci[0] > 0.25


def test_pairs_of_items_that_answer_apart_count_as_items() -> None:
    apart = success_rate(doubles(40, lambda group, item: (group % 5 < 3) == (item == 0) or group % 4 == 0))
    assert apart.chance_margin == apart.chance_margin_items


@pytest.mark.slow
def test_a_guesser_with_a_fixed_preference_per_item_is_not_called_knowing() -> None:
    """Over episodes, which repeat the preference, it was in 9 % of categories."""
    generator = np.random.default_rng(0)
    regimes = [success_rate(doubles(75, lambda *_: bool(generator.random() < 0.5))).regime for _ in range(150)]
    assert np.mean([verdict is Regime.KNOWLEDGE for verdict in regimes]) <= 0.025 + 3 * 0.0128


def test_knowledge_never_stands_beside_an_interval_that_includes_one_half() -> None:
    generator = np.random.default_rng(1)
    rates = [
        success_rate(doubles(groups, lambda *_, ability=ability: bool(generator.random() < ability)))
        for groups in range(4, 40)
        for ability in (generator.uniform(0.5, 1.0),)
    ]
    lows = [rate.ci[0] for rate in rates if rate.regime is Regime.KNOWLEDGE and rate.ci is not None]
    assert len(lows) > 5
    assert all(low is not None and low > 0.5 for low in lows)


def test_items_that_ran_in_one_layout_are_not_paired(outcome_table: Outcomes) -> None:
    assert paired_items(outcome_table(correct=3, wrong=0, oob=0)).both == 1


def test_an_item_that_occurs_twice_in_one_layout_is_refused(outcome_table: Outcomes) -> None:
    episodes = outcome_table(correct=2, wrong=2, oob=0)
    with pytest.raises(UsageError, match="twice in one layout"):
        paired_items(pd.concat([episodes, episodes]))


def test_a_layout_that_did_not_run_has_no_rate(outcome_table: Outcomes) -> None:
    episodes = outcome_table(correct=10, wrong=0, oob=0)
    success = success_rate(episodes[episodes["layout"] == "original"])
    assert success.sr_original == 1.0
    assert success.sr_swapped is None
    assert success.layout_mean is None


def test_no_episodes_have_no_success_rate(outcome_table: Outcomes) -> None:
    with pytest.raises(UsageError, match="no finished episodes"):
        success_rate(outcome_table(correct=1, wrong=0, oob=0)[:0])


def test_success_is_scored_again_for_every_radius(outcome_table: Outcomes) -> None:
    episodes = outcome_table(2, 2, 0).assign(
        distance_correct=[0.05, 0.06, 0.2, None], distance_wrong=[0.2, 0.2, 0.06, None]
    )
    assert sensitivity(episodes) == {0.055: 0.25, 0.065: 0.5, 0.081: 0.5}
    assert sensitivity(episodes, (0.01,)) == {0.01: 0.0}


def test_a_radius_that_makes_zones_overlap_is_refused(outcome_table: Outcomes) -> None:
    episodes = outcome_table(1, 0, 0).assign(distance_correct=0.05, distance_wrong=0.06)
    with pytest.raises(SceneError, match="overlap"):
        sensitivity(episodes, (0.07,))


def test_a_table_without_distances_has_no_sensitivity(outcome_table: Outcomes) -> None:
    assert sensitivity(outcome_table(1, 0, 0)) == {}


def test_twelve_groups_of_four_that_are_all_right_are_known_like_twelve_tosses() -> None:
    interval = success_rate(doubles(12, lambda *_: True)).ci
    exact = binomtest(12, 12).proportion_ci(0.95, "exact")
    assert interval == pytest.approx((exact.low, exact.high))
    assert interval == pytest.approx((0.735, 1), abs=5e-4)


def test_the_interval_is_korn_and_graubards() -> None:
    """Clopper and Pearson's, with as many episodes as count where groups answer alike."""
    rate = success_rate(doubles(40, lambda group, item: group % 5 < 2 or (group % 5 == 2 and item == 0)))
    hits = np.array([4.0, 4, 2, 0, 0] * 8)
    variance = np.sum((hits - 4 * 0.5) ** 2) * 40 / 39 / 160**2
    count = 0.25 / variance * (t.ppf(0.975, 159) / t.ppf(0.975, 39)) ** 2
    expected = beta.ppf(0.025, count / 2, count / 2 + 1), beta.ppf(0.975, count / 2 + 1, count / 2)
    assert (rate.sr, rate.ci) == (0.5, pytest.approx(expected))


@pytest.mark.parametrize(
    ("outcome", "expected"), [("correct", (0.025 ** (1 / 10), 1)), ("oob", (0, 1 - 0.025 ** (1 / 10)))]
)
def test_an_interval_has_a_width_even_where_all_episodes_agree(
    outcome: str, expected: tuple[float, float]
) -> None:
    """A bootstrap would claim certainty; Clopper and Pearson's interval for ten items does not."""
    rows = [
        {"item_id": f"i{item}", "layout": layout, "side_correct": side, "outcome": outcome, "side_placed": "none"}
        for item in range(10)
        for layout, side in (("original", "left"), ("swapped", "right"))
    ]
    interval = success_rate(pd.DataFrame(rows)).ci
    assert interval == pytest.approx(expected)
    exact = binomtest(10 if outcome == "correct" else 0, 10).proportion_ci(0.95, "exact")
    assert interval == pytest.approx((exact.low, exact.high))
