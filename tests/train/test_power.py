import json
from math import ceil
from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.statistics.significance import detectable, items_for_width
from probe_kit.train.power import _carriers, _limit, fewest, items_needed, simulate


@pytest.mark.slow
def test_power_grows_with_items_and_with_the_signal() -> None:
    few, many = simulate(24, 0.15, draws=60), simulate(150, 0.15, draws=60)
    assert few.chance < many.chance
    assert few.untrained < many.untrained
    assert simulate(150, 0.1, draws=60).untrained < simulate(150, 0.25, draws=60).untrained
    assert simulate(150, 0.25, draws=60).untrained > 0.9


@pytest.mark.slow
def test_without_a_signal_power_is_the_false_alarm_rate() -> None:
    power = simulate(60, 0.0, draws=200)
    assert max(power.chance, power.random_features, power.untrained) <= 0.05 + 3 * (0.05 * 0.95 / 200) ** 0.5


@pytest.mark.slow
def test_nothing_is_called_absent_with_many_items_and_hardly_with_few() -> None:
    """Whatever the signal of the stream that is tested."""
    few, many = simulate(24, 0.25, draws=40), simulate(300, 0.25, draws=20)
    assert few.absent < 0.15
    assert many.absent > 0.9
    assert simulate(60, 0.0, sites=1, draws=60).absent > simulate(60, 0.0, sites=19, draws=60).absent


def test_what_a_control_could_have_seen_at_this_size() -> None:
    assert detectable(150) == pytest.approx(0.5 + (1.6449 + 0.8416) * (0.25 / 150) ** 0.5, abs=1e-4)
    assert detectable(24) > detectable(150) > 0.59
    with pytest.raises(UsageError, match="0 items"):
        detectable(0)


def test_one_site_carries_the_signal_too() -> None:
    """An independent simulation of one probe sees 25 points in nearly all experiments with 60 items."""
    power = simulate(60, 0.25, sites=1, draws=100)
    assert power.chance > 0.98
    assert power.random_features > 0.7
    assert simulate(60, 0.0, sites=1, draws=100).chance < 0.12


@pytest.mark.parametrize("sites", range(1, 40))
def test_a_third_of_the_sites_carry_the_signal_whatever_their_number(sites: int) -> None:
    carriers = range(sites)[_carriers(sites)]
    assert len(carriers) == max(1, round(sites / 3))


def independent(items: int, above: float, sites: int, draws: int) -> float:
    """Power against chance of `draws` experiments, from the whole covariance instead of its recursion."""
    generator = np.random.default_rng(12345)
    index = np.arange(sites)
    of_sites = 0.9 ** np.abs(index[:, None] - index)
    of_group = 0.3 + 0.7 * np.eye(4)
    root = np.linalg.cholesky(np.kron(of_sites, of_group))
    groups = items // 2

    def best(signal: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        limits = np.array([NormalDist().inv_cdf(0.5 + share) for share in signal])
        shares = []
        for _ in range(count):
            values = (generator.standard_normal((groups, 4 * sites)) @ root.T).reshape(groups, sites, 4)
            shares.append((values < limits[:, None]).mean(axis=(0, 2)).max())
        return np.array(shares)

    signal = np.zeros(sites)
    signal[_carriers(sites)] = above
    null = np.sort(best(np.zeros(sites), 10 * draws))
    return float((best(signal, draws) > null[-ceil(0.05 * len(null))]).mean())


@pytest.mark.slow
@pytest.mark.parametrize(("items", "above", "sites"), [(60, 0.25, 1), (60, 0.1, 1), (24, 0.15, 5)])
def test_power_against_chance_is_that_of_an_independent_simulation(items: int, above: float, sites: int) -> None:
    expected = independent(items, above, sites, 1000)
    powers = [simulate(items, above, sites, draws=100, seed=seed).chance for seed in range(4)]
    error = (expected * (1 - expected) * (1 / 1000 + 1 / 400)) ** 0.5
    assert np.mean(powers) == pytest.approx(expected, abs=3.5 * error + 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("items", "above"), [(60, 0.1), (24, 0.15), (150, 0.1)])
def test_power_over_all_sites_is_that_of_an_independent_simulation(items: int, above: float) -> None:
    expected = independent(items, above, 19, 1500)
    power = simulate(items, above, draws=1500).chance
    error = (2 * expected * (1 - expected) / 1500) ** 0.5
    assert power == pytest.approx(expected, abs=3.5 * error + 0.01)


@pytest.mark.slow
def test_the_limit_of_chance_hardly_depends_on_the_seed() -> None:
    """A step of one episode is what is left of it."""
    for groups in (12, 30, 75):
        limits = [_limit(groups, 19, seed) for seed in range(6)]
        assert max(limits) - min(limits) <= 1 / (4 * groups) + 1e-9


@pytest.mark.slow
def test_the_spread_is_the_error_over_seeds() -> None:
    """Over repetitions, shares vary as much as the spread says: more draws, less of both."""
    few = [simulate(24, 0.15, 5, draws=50, seed=seed) for seed in range(8)]
    many = [simulate(24, 0.15, 5, draws=400, seed=seed) for seed in range(4)]
    measured = max(
        np.std([getattr(estimate, name) for estimate in few], ddof=1)
        for name in ("chance", "random_features", "untrained")
    )
    stated_spread = float(np.mean([estimate.spread for estimate in few]))
    assert 0.4 * measured < stated_spread < 2.5 * measured
    assert np.mean([estimate.spread for estimate in many]) < 0.7 * stated_spread


@pytest.mark.parametrize("goal", [10, 12, 58, 68, 150, 152, 999, 1000])
def test_the_fewest_items_are_found_to_the_resolution_that_is_said(goal: int) -> None:
    fewest_items = fewest(lambda items: items >= goal, 10, 1000)
    assert fewest_items is not None
    items, resolution = fewest_items
    assert goal <= items < goal + resolution
    assert resolution <= max(2, items // 50)


def test_a_number_that_reaches_the_goal_by_luck_is_not_the_fewest() -> None:
    """Shares go in steps: 40 reach it and 42 do not."""
    fewest_items = fewest(lambda items: items == 40 or items >= 68, 10, 1000)
    assert fewest_items == (68, 2)
    assert fewest(lambda _: False, 10, 1000) is None
    assert fewest(lambda items: items == 1000, 10, 1000) is not None


@pytest.mark.slow
def test_the_items_needed_reach_the_power_and_a_step_less_does_not() -> None:
    needed = items_needed(0.25, 0.8, sites=3, draws=60)
    assert needed is not None
    needed_items, resolution = needed
    assert needed_items == simulate(needed_items.items, 0.25, 3, 60)
    assert (
        min(needed_items.chance, needed_items.random_features, needed_items.untrained) == needed_items.least >= 0.8
    )
    assert simulate(needed_items.items - resolution, 0.25, 3, 60).least < 0.8


def test_the_width_of_an_interval_asks_for_items_too() -> None:
    assert items_for_width(0.16) == 151  # 0.08 either side: the margin of 150 items
    for width in (0.0, 1.5):
        with pytest.raises(UsageError, match="expected a share"):
            items_for_width(width)


def test_sizes_and_signals_that_cannot_be_are_refused() -> None:
    with pytest.raises(UsageError, match="fewer than 5 groups"):
        simulate(8, 0.1)
    with pytest.raises(UsageError, match=r"from 0 to 0\.5"):
        simulate(24, 0.7)


def test_the_command_prints_every_number_of_items() -> None:
    result = CliRunner().invoke(app, ["power", "--items", "24,60", "--signal", "25", "--draws", "20", "--json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [row["items"] for row in rows] == [24, 60]
    assert all(0 <= row["absent"] <= 1 for row in rows)
    text = CliRunner().invoke(app, ["power", "--items", "24", "--signal", "25", "--draws", "20"]).stdout
    assert "against an untrained network" in text
    assert "absent if nothing" in " ".join(text.split())
    assert CliRunner().invoke(app, ["power", "--width", "16"]).stdout.startswith("151 items")
    assert CliRunner().invoke(app, ["power", "--items", "many"]).exit_code == 2


def test_the_command_looks_for_the_number_and_says_how_well_it_is_known() -> None:
    command = ["power", "--power", "70", "--signal", "50", "--sites", "1", "--draws", "20"]
    (answer,) = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert answer.keys() == {"above", "power", "items", "resolution", "reached", "spread"}
    text = CliRunner().invoke(app, command).stdout
    assert f"{answer['items']} items per category (to {answer['resolution']};" in text
    refused = CliRunner().invoke(app, [*command, "--items", "24,60"])
    assert refused.exit_code == 2
    assert "leave --items out" in refused.output


def test_two_questions_are_not_answered_by_one_of_them() -> None:
    result = CliRunner().invoke(app, ["power", "--width", "16", "--power", "80"])
    assert result.exit_code == 2
    assert "two questions" in result.output
