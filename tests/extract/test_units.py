"""Own data are never in other units, with lerobot's statistics of them; changed numbers are named."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.extract.sources.units import DEGREES, Kind, Units, compare_units
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser
from tests.support.slow_cases import slow_but

MODES = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"),
         "QUANTILE10": ("q10", "q90")}  # fmt: skip
NAMES = ["base", "shoulder", "elbow", "x", "y", "z", "gripper", "still"]
Episodes = list[NDArray[np.float32]]


def lerobots(episodes: Sequence[NDArray[np.float32]]) -> dict[str, NDArray[Any]]:
    """The statistics of a feature by lerobot's own functions, as its recorder calls them."""
    from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats

    features = {"s": {"dtype": "float32", "shape": (episodes[0].shape[1],)}}
    stored: dict[str, NDArray[Any]] = aggregate_stats(
        [compute_episode_stats({"s": e}, features) for e in episodes]
    )["s"]
    return stored


def checkpoint(episodes: Episodes, mode: str = "MEAN_STD", alone: bool = False) -> FeatureStatistics:
    """The statistics of a checkpoint: all that lerobot stores, or those of the mode alone."""
    stored = {name: np.asarray(numbers, np.float32) for name, numbers in lerobots(episodes).items()}
    low, high = (stored[name] for name in MODES[mode])
    statistics = Normaliser(mode, low, high, 1e-8, "file", stored={} if alone else stored).statistics
    assert statistics is not None
    return statistics


def recorded(episodes: Episodes) -> FeatureStatistics | None:
    return FeatureStatistics.of(lerobots(episodes), episodes[0].shape[1])


def played(seed: int, count: int, frames: int, ratio: float, still: float = -1.5708) -> Episodes:
    """Episodes at other places; `ratio` is the spread inside of an episode over that between them."""
    random = np.random.default_rng(seed)
    spread, centers = np.array([0.5, 0.3, 0.8, 0.1, 0.2, 0.05]), np.array([0.2, -0.8, 1.5, 0.4, 0.1, 0.2])
    episodes = []
    for _ in range(count):
        base = centers + spread * random.standard_normal(6)
        bent = random.gamma(2, 1, (frames, 6)) - 2
        gripper = (np.arange(frames) > 0.8 * frames).astype(float)
        values = np.column_stack([base + spread * ratio * bent, gripper, np.full(frames, still)])
        episodes.append(values.astype(np.float32))
    return episodes


def compared(expected: FeatureStatistics, episodes: Episodes, stored: bool = True, begins: bool = False) -> Units:
    return compare_units(expected, episodes, NAMES, recorded(episodes) if stored else None, begins)


def multiplied(episodes: Episodes, factor: float, numbers: slice) -> Episodes:
    scale = np.ones(8, np.float32)
    scale[numbers] = factor
    return [episode * scale for episode in episodes]


# -- own data ------------------------------------------------------------------------------------------------


def test_quantiles_of_episodes_are_combined_as_lerobot_does() -> None:
    episodes = [*played(0, 3, 200, 0.2), *played(1, 2, 50, 0.2)]
    ours, theirs = FeatureStatistics.of_episodes(episodes), lerobots(episodes)
    for name in ("min", "max", "mean", "q10", "q50", "q90"):
        np.testing.assert_allclose(ours.level(name), theirs[name], atol=0.05, err_msg=name)


@pytest.mark.parametrize("mode", slow_but({"QUANTILES"}, MODES))
@pytest.mark.parametrize("ratio", slow_but({0.2}, [0.02, 0.2, 1, 5]))
def test_the_frames_that_a_checkpoint_was_trained_on_are_never_in_other_units(mode: str, ratio: float) -> None:
    """All of them or one episode, with the statistics of the data set or without."""
    for count, still in ((1, 1000.3), (2, -1.5708), (12, 0.3)):
        episodes = played(count, count, 40, ratio, still)
        for some in (episodes, episodes[:1]):
            for stored in (True, False):
                assert not compared(checkpoint(episodes, mode), some, stored).are_other


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX"])
def test_own_frames_fit_a_checkpoint_that_has_the_statistics_of_its_mode_alone(mode: str) -> None:
    episodes = played(3, 12, 40, 0.2)
    assert not compared(checkpoint(episodes, mode, alone=True), episodes, stored=False).are_other


@pytest.mark.parametrize("value", slow_but({1000.3, -1.5708}, [100.3, 1000.3, -1.5708, 1e-3, 0.0]))
def test_a_number_that_never_moves_or_hardly_moves_beside_its_mean_fits(value: float) -> None:
    for noise in (0, 1e-5 * abs(value)):
        random = np.random.default_rng(0)
        episodes = [
            np.column_stack([e[:, :7], value + noise * random.standard_normal(len(e))]).astype(np.float32)
            for e in played(0, 4, 60, 1)
        ]
        assert not compared(checkpoint(episodes), episodes, stored=False).misfits


def test_the_same_data_set_gives_no_warning_even_of_few_chosen_frames() -> None:
    episodes = played(0, 12, 40, 0.1)
    chosen_frames = [episodes[0][:1]]
    assert not compare_units(checkpoint(episodes), chosen_frames, NAMES, recorded(episodes)).misfits


def test_one_small_region_of_the_workspace_is_said_and_not_refused() -> None:
    episodes = played(0, 12, 40, 1)
    spot = [episodes[0][:1] + 0.01 * (episode - episode.mean(axis=0)) for episode in episodes]
    units = compared(checkpoint(episodes), spot)
    assert [misfit.kind for misfit in units.misfits] == ["narrow"]
    assert not units.are_other
    assert "times less than in training" in units.misfits[0].words


def test_statistics_of_a_data_set_that_do_not_describe_its_frames_decide_nothing() -> None:
    """The frames were converted, and `meta/stats.json` stayed as it was."""
    episodes = played(0, 12, 40, 1)
    units = compare_units(checkpoint(episodes), multiplied(episodes, 1000, slice(0, 3)), NAMES, recorded(episodes))
    assert units.are_other


# -- other units -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", slow_but({DEGREES, 1 / DEGREES}, [DEGREES, 1 / DEGREES, 1000, 1e-3, 100, 0.01]))
@pytest.mark.parametrize("count", slow_but({3}, [3, 6, 7]))
@pytest.mark.parametrize("mode", slow_but({"QUANTILES"}, MODES))
def test_a_factor_is_refused_in_both_directions_and_named_with_its_numbers(
    factor: float, count: int, mode: str
) -> None:
    """Of the training data themselves, and of other episodes of the same robot."""
    numbers, expected = slice(0, count), checkpoint(played(0, 20, 40, 1), mode)
    for seed in (0, 1):
        units = compared(expected, multiplied(played(seed, 20, 40, 1), factor, numbers))
        assert units.are_other
        misfit = next(misfit for misfit in units.misfits if misfit.kind == "factor")
        assert misfit.factor == pytest.approx(factor)
        assert set(misfit.numbers) >= set(range(8)[numbers]) - {6}
        assert "base (number 0)" in units.refused


def other_sign(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values * np.where(np.arange(8) == 2, -1, 1).astype(np.float32)


def turned_round(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.column_stack([values[:, :6], 1 - values[:, 6:7], values[:, 7:]])


def exchanged(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values[:, [0, 2, 1, 3, 4, 5, 6, 7]]


def shifted(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values + np.where(np.arange(8) == 4, 1, 0).astype(np.float32)


CHANGES: list[tuple[Callable[[NDArray[np.float32]], NDArray[np.float32]], Kind, str]] = [
    (other_sign, "sign", "elbow (number 2) has the other sign"),
    (turned_round, "inverted", "gripper (number 6) is turned round, x for 1 − x"),
    (exchanged, "exchange", "elbow (number 2) looks like shoulder (number 1)"),
    (shifted, "offset", "y (number 4) is shifted by 1 (y from "),
]


@pytest.mark.parametrize(("change", "kind", "words"), CHANGES)
@pytest.mark.parametrize("mode", slow_but({"MEAN_STD"}, MODES))
def test_sign_gripper_order_and_offset_of_the_training_data_are_refused_by_name(
    change: Callable[[NDArray[np.float32]], NDArray[np.float32]], kind: Kind, words: str, mode: str
) -> None:
    episodes = played(0, 12, 30, 1)
    units = compared(checkpoint(episodes, mode), [change(episode) for episode in episodes])
    assert [misfit.kind for misfit in units.misfits] == [kind]
    assert units.are_other
    assert words in units.refused


def test_a_symmetric_number_with_the_other_sign_cannot_be_told() -> None:
    random = np.random.default_rng(0)
    half = random.normal(0, 1, (50, 8)).astype(np.float32)
    episodes = [np.concatenate([half, -half])]
    assert not compared(checkpoint(episodes), [-episodes[0]]).misfits


def test_the_beginnings_of_episodes_show_degrees_by_their_place() -> None:
    """Of a scene or an environment only some first states are compared, which hardly differ."""
    training = played(0, 12, 30, 0.3)
    begin = [np.mean(training, axis=(0, 1))[None].astype(np.float32)]
    assert not compared(checkpoint(training), begin, stored=False, begins=True).misfits
    units = compared(checkpoint(training), multiplied(begin, DEGREES, slice(0, 3)), stored=False, begins=True)
    assert units.are_other
    assert "57.3 times larger than in training, as degrees for radians" in units.refused


def test_beginnings_that_are_squeezed_are_suspicious() -> None:
    """They lie inside the statistics: another start, or radians for degrees."""
    training = multiplied(played(0, 12, 30, 1), DEGREES, slice(0, 6))
    begin = [np.mean(training, axis=(0, 1))[None].astype(np.float32)]
    units = compared(checkpoint(training), multiplied(begin, 1 / DEGREES, slice(0, 6)), stored=False, begins=True)
    assert [misfit.kind for misfit in units.misfits] == ["factor"]
    assert "57.3 times smaller than in training, as radians for degrees" in units.misfits[0].words
