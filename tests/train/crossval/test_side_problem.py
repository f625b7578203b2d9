from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.train import ArrayRun
from tests.train.conftest import problem_of

PlantedRun = Callable[..., ArrayRun]


def test_permutation_the_correct_side_flips_whole_groups(planted_run: PlantedRun) -> None:
    problem = problem_of(planted_run().episodes)
    flipped = (problem.permuted_labels != problem.labels[:, None]).reshape(20, 4, 30)
    assert (flipped == flipped[:, :1]).all()


def with_concepts(episodes: pd.DataFrame) -> pd.DataFrame:
    """Groups 0 and 10, 1 and 11, … are about the same two concepts, once the other way round."""
    group = episodes["group_id"].str.rpartition("-")[2].astype(int)
    pair = (group % 10).astype(str)
    swapped = group >= 10
    return episodes.assign(
        target_concept=np.where(swapped, "b" + pair, "a" + pair),
        distractor_concept=np.where(swapped, "a" + pair, "b" + pair),
    )


def test_concept_folds_train_on_no_pair_of_concepts_that_they_test(planted_run: PlantedRun) -> None:
    episodes = with_concepts(planted_run().episodes)
    problem = problem_of(episodes, folds="concepts")
    pairs = episodes["target_concept"].str[1:].to_numpy()
    assert np.unique(problem.groups).size == 10
    for fold in problem.folds:
        for split in (fold.outer, *fold.inner):
            assert not set(pairs[split.train]) & set(pairs[split.test])
            assert not set(episodes["group_id"].iloc[split.train]) & set(episodes["group_id"].iloc[split.test])
    by_groups = problem_of(episodes)
    assert any(set(pairs[fold.outer.train]) & set(pairs[fold.outer.test]) for fold in by_groups.folds)


def test_concept_folds_without_concepts_are_refused(planted_run: PlantedRun) -> None:
    with pytest.raises(UsageError, match="target_concept and distractor_concept"):
        problem_of(planted_run().episodes, folds="concepts")


def test_dropping_incomplete_items_restores_balance(planted_run: PlantedRun) -> None:
    episodes = planted_run().episodes
    some = episodes[(episodes["side_correct"] == "left") | (episodes.index % 5 > 1)]
    problem = problem_of(some, incomplete="drop")
    assert problem.labels.mean() == 0.5
    assert 0 < problem.labels.size < len(some)
    assert (pd.Series(problem.items).value_counts() == 2).all()


def test_a_category_that_is_nearly_all_of_one_side_is_refused(planted_run: PlantedRun) -> None:
    episodes = planted_run().episodes
    left = episodes[(episodes["side_correct"] == "left") | (episodes.index < 20)]
    with pytest.raises(UnbalancedEpisodesError, match=r"chance is 0\.8.*drop"):
        problem_of(left)


def test_so_few_groups_that_nothing_can_be_significant_are_said(planted_run: PlantedRun) -> None:
    with pytest.warns(UserWarning, match=r"15 label permutations, the smallest possible p is 0\.062"):
        problem_of(planted_run(n_items=10).episodes)


def test_permutation_the_chosen_side_keeps_its_share(planted_run: PlantedRun) -> None:
    problem = problem_of(planted_run().episodes, target="side.chosen")
    assert problem.labels.size < 80
    np.testing.assert_array_equal(problem.permuted_labels.mean(axis=0), problem.labels.mean())


def test_no_group_is_split_between_outer_or_inner_folds(planted_run: PlantedRun) -> None:
    problem = problem_of(planted_run().episodes)
    for fold in problem.folds:
        for split in (fold.outer, *fold.inner):
            assert not set(problem.groups[split.train]) & set(problem.groups[split.test])


def test_a_category_takes_part_only_with_its_own_episodes(planted_run: PlantedRun) -> None:
    episodes = planted_run(categories=("shape", "color")).episodes
    problem = problem_of(episodes)
    assert (episodes["category"].iloc[problem.samples.rows] == "color").all()


def test_the_pooled_category_has_every_episode(planted_run: PlantedRun) -> None:
    episodes = planted_run(categories=("shape", "color")).episodes
    assert problem_of(episodes, "all").samples.rows.tolist() == list(range(160))


def test_missing_episodes_move_chance_and_say_so(planted_run: PlantedRun) -> None:
    episodes = planted_run().episodes
    left = episodes[(episodes["side_correct"] == "left") | (episodes.index < 60)]
    with pytest.warns(UserWarning, match=r"chance is 0\.5.*Episodes are missing"):
        problem_of(left)


def test_too_few_groups_name_category_and_target(planted_run: PlantedRun) -> None:
    with pytest.raises(TooFewGroupsError, match=r"category 'color', target 'side.chosen': \d independent groups"):
        problem_of(planted_run(n_items=6), target="side.chosen")


def test_folds_of_the_chosen_side_do_not_know_which_side_was_chosen(planted_run: PlantedRun) -> None:
    episodes = planted_run().episodes
    exchanged = episodes.copy()
    placed = {"left": "right", "right": "left", "none": "none"}
    some = exchanged["group_id"].isin(sorted(set(exchanged["group_id"]))[:7])
    exchanged.loc[some, "side_placed"] = exchanged.loc[some, "side_placed"].map(placed)
    folds = [problem_of(table, target="side.chosen").folds for table in (episodes, exchanged)]
    for here, there in zip(*folds, strict=True):
        for one, other in zip((here.outer, *here.inner), (there.outer, *there.inner), strict=True):
            np.testing.assert_array_equal(one.test, other.test)


def test_folds_of_the_chosen_side_are_refused_where_a_training_side_holds_one_side(
    planted_run: PlantedRun,
) -> None:
    episodes = planted_run().episodes.assign(side_placed="left")
    episodes.loc[episodes["group_id"] == episodes["group_id"].iloc[0], "side_placed"] = "right"
    with pytest.raises(TooFewGroupsError, match="chose the left side, and a training fold holds one side"):
        problem_of(episodes, target="side.chosen")
