"""Samples of a probe, and the sides of episodes."""

import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import NonFiniteActivationError, UnknownSiteError
from probe_kit.hooks import Site
from probe_kit.runs.arrays import TokenBlock
from probe_kit.train import ArrayRun
from probe_kit.train.samples import Samples, read_samples, role_of, sites_of
from probe_kit.train.target import side_labels

PlantedRun = Callable[..., ArrayRun]


def read_all(run: Any, view: str, site: Site, episodes: int = 80) -> Samples:
    """The first inference of every episode."""
    return read_samples(run, view, site, np.arange(episodes), np.zeros(episodes, int))


MASK = np.array([[True, False, True], [False, True, False], [True, True, True]])
VALUES = np.arange(18.0).reshape(3, 3, 2)
BLOCKS = [TokenBlock(0, VALUES[:, :2], MASK[:, :2]), TokenBlock(2, VALUES[:, 2:], MASK[:, 2:])]


def test_tokens_are_samples_and_means_are_over_the_tokens_of_an_episode() -> None:
    samples = Samples.tokens(BLOCKS, MASK)
    assert np.asarray(samples.features).tolist() == [
        *VALUES[0, [0, 2]].tolist(),
        VALUES[1, 1].tolist(),
        *VALUES[2].tolist(),
    ]
    assert samples.counts.tolist() == [2, 1, 3]
    expected = [VALUES[episode][MASK[episode]].mean(axis=0) for episode in range(3)]
    np.testing.assert_allclose(samples.means, expected)


def test_some_episodes_bring_all_their_samples_in_the_order_asked_for() -> None:
    some = Samples.tokens(BLOCKS, MASK).of(np.array([2, 0]))
    assert np.asarray(some.features).tolist() == [*VALUES[2].tolist(), *VALUES[0, [0, 2]].tolist()]
    assert some.repeat(np.array([[7], [8]]))[:, 0].tolist() == [7, 7, 7, 8, 8]


def test_a_pooled_column_is_one_sample_per_episode() -> None:
    samples = Samples.pooled(VALUES[:, 0])
    assert samples.pools
    assert not Samples.tokens(BLOCKS, MASK).pools
    assert samples.of(np.array([1])).features.tolist() == samples.of(np.array([1])).means.tolist()


def test_the_tokens_of_a_role_are_where_its_mean_is(planted_run: PlantedRun) -> None:
    run = planted_run()
    run.features[Site("expert", 0, "residual", 0), "mean:state"] = np.zeros((80, 8))  # type: ignore[index]
    assert {site.stream for site in sites_of(run, "tokens:state")} == {"expert"}
    assert {site.stream for site in sites_of(run, "tokens")} == {"backbone", "expert"}
    assert role_of("tokens:image.front") == "image.front"
    with pytest.raises(UnknownSiteError, match="no view 'tokens:language'"):
        sites_of(run, "tokens:language")


def test_a_broken_token_names_its_episode(planted_run: PlantedRun) -> None:
    run, site = planted_run(), Site("backbone", 0)
    values = np.zeros((80, 3, 20))
    values[5, 1, 0] = np.inf
    run.token_features[site, None] = (values, np.ones((80, 3), bool))  # type: ignore[index]
    with pytest.raises(NonFiniteActivationError, match=r"1 of 80 samples, the first inference 0 of 'color-2:s'"):
        read_all(run, "tokens", site)


class _Blockwise:
    """A run whose tokens can only be had in blocks, as those of a run too large for memory."""

    def __init__(self) -> None:
        self.held: list[weakref.ref[np.ndarray]] = []
        self.alive = 0

    def token_mask(self, *_: object) -> np.ndarray:
        return np.ones((4, 40), bool)

    def iter_token_blocks(self, *_: object) -> Iterator[TokenBlock]:
        for start in range(0, 40, 4):
            values = np.full((4, 4, 3), start, np.float32) + np.arange(4, dtype=np.float32)[None, :, None]
            self.held.append(weakref.ref(values))
            block = TokenBlock(start, values, np.ones((4, 4), bool))
            del values
            yield block
            del block
            self.alive = max(self.alive, sum(reference() is not None for reference in self.held))


def test_tokens_are_read_block_by_block_and_no_block_is_kept() -> None:
    run = _Blockwise()
    samples = read_all(run, "tokens", Site("backbone", 0), 4)
    assert np.asarray(samples.features)[:, 0].tolist() == [*range(40)] * 4
    assert run.alive <= 1


EPISODES = pd.DataFrame(
    {
        "item_id": ["a", "a", "b", "b"] * 20,
        "side_correct": ["left", "right", "right", "left"] * 20,
        "side_placed": ["left", "none", "left", "right"] * 20,
    }
)
EPISODES["item_id"] += (EPISODES.index // 4).astype(str)


def test_left_is_one() -> None:
    assert side_labels(EPISODES, "side.correct", 0)[:4].tolist() == [1, 0, 0, 1]


def test_an_episode_placed_nowhere_has_no_chosen_side() -> None:
    assert side_labels(EPISODES, "side.chosen", 0)[:4].tolist() == [1, -1, 1, 0]


def test_the_control_flips_about_half_of_the_items_as_a_whole() -> None:
    shuffled, correct = side_labels(EPISODES, "side.shuffled", 0), side_labels(EPISODES, "side.correct", 0)
    flipped = (shuffled != correct).reshape(-1, 2)
    assert (flipped[:, 0] == flipped[:, 1]).all()
    assert 10 < flipped[:, 0].sum() < 30
