import pandas as pd

from probe_kit.train.target import side_labels

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
