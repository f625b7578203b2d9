from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.errors import TooFewGroupsError
from probe_kit.train import ArrayRun, ProbeSettings, Target
from probe_kit.train.problem import category_problem

PlantedRun = Callable[..., ArrayRun]


def settings(target: Target = "correct") -> ProbeSettings:
    return ProbeSettings(
        "m", False, None, "s@1#0", "0", "0", ("color",), ("mean",), target, permutations=30, seed=0
    )


def test_relabelling_the_correct_side_flips_whole_items(planted_run: PlantedRun) -> None:
    problem = category_problem(planted_run().episodes, "color", settings())
    flipped = problem.relabellings != problem.labels[:, None]
    assert problem.relabellings.shape == (80, 30)
    assert (flipped[0::2] == flipped[1::2]).all()


def test_relabelling_the_chosen_side_keeps_its_share(planted_run: PlantedRun) -> None:
    problem = category_problem(planted_run().episodes, "color", settings("chosen"))
    assert problem.labels.size < 80
    np.testing.assert_array_equal(problem.relabellings.mean(axis=0), problem.labels.mean())


def test_no_group_is_split_between_outer_or_inner_folds(planted_run: PlantedRun) -> None:
    problem = category_problem(planted_run().episodes, "color", settings())
    for fold in problem.folds:
        for split in (fold.outer, *fold.inner):
            assert not set(problem.groups[split.train]) & set(problem.groups[split.test])


def test_a_category_takes_part_only_with_its_own_episodes(planted_run: PlantedRun) -> None:
    episodes = planted_run(categories=("shape", "color")).episodes
    problem = category_problem(episodes, "color", settings())
    assert (episodes["category"].iloc[problem.rows] == "color").all()


def test_the_pooled_category_has_every_episode(planted_run: PlantedRun) -> None:
    episodes = planted_run(categories=("shape", "color")).episodes
    assert category_problem(episodes, "all", settings()).rows.tolist() == list(range(160))


def test_missing_episodes_move_chance_and_say_so(planted_run: PlantedRun) -> None:
    episodes = planted_run().episodes
    left = episodes[(episodes["side_correct"] == "left") | (episodes.index < 60)]
    with pytest.warns(UserWarning, match=r"chance is 0\.5.*Episodes are missing"):
        category_problem(left, "color", settings())


def test_too_few_groups_name_category_and_target(planted_run: PlantedRun) -> None:
    with pytest.raises(TooFewGroupsError, match=r"category 'color', target 'chosen': \d independent groups"):
        category_problem(planted_run(n_items=6).episodes, "color", settings("chosen"))
