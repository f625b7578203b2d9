"""The probing problem of a category: folds and label permutations of sides and of labels, and their level."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binom

from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p, p_value
from probe_kit.train import ArrayRun, Target
from probe_kit.train.choices import TASKS, Task
from probe_kit.train.crossval.nested_folds import STRENGTHS, nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.problem import Problem, make_problem
from probe_kit.train.samples import Samples
from probe_kit.train.solver.design_matrix import Projection
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.target_samples import TargetSamples
from tests.train.conftest import problem_of, settings_of

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
    remaining_episodes = episodes[(episodes["side_correct"] == "left") | (episodes.index < 20)]
    with pytest.raises(UnbalancedEpisodesError, match=r"chance is 0\.8.*drop"):
        problem_of(remaining_episodes)


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
    remaining_episodes = episodes[(episodes["side_correct"] == "left") | (episodes.index < 60)]
    with pytest.warns(UserWarning, match=r"chance is 0\.5.*Episodes are missing"):
        problem_of(remaining_episodes)


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
    for original, mirrored in zip(*folds, strict=True):
        for first, other in zip((original.outer, *original.inner), (mirrored.outer, *mirrored.inner), strict=True):
            np.testing.assert_array_equal(first.test, other.test)


def test_folds_of_the_chosen_side_are_refused_where_a_training_side_holds_one_side(
    planted_run: PlantedRun,
) -> None:
    episodes = planted_run().episodes.assign(side_placed="left")
    episodes.loc[episodes["group_id"] == episodes["group_id"].iloc[0], "side_placed"] = "right"
    with pytest.raises(TooFewGroupsError, match="chose the left side, and a training fold holds one side"):
        problem_of(episodes, target="side.chosen")


GROUPS, FRAMES = 12, 6
GROUP, FRAME = (axis.ravel() for axis in np.indices((GROUPS, FRAMES)))


def label_problem_of(
    values: NDArray[np.float64], permutations: int, kinds: list[str] | None = None, task: Task = "continuous"
) -> Problem:
    """Labels of one episode per group."""
    names = np.array([f"e{number}" for number in range(GROUPS)])
    table = pd.DataFrame({"episode_id": names[GROUP], "inference": FRAME, "y": values})
    episodes = pd.DataFrame({"episode_id": names, "group_id": names, "layout": kinds or ["original"] * GROUPS})
    episodes["category"] = "all"
    run = ArrayRun(Path("nowhere"), "none", "none", episodes, {})
    everywhere = np.full(GROUP.size, "all")
    samples = TargetSamples(GROUP, FRAME, values, names[GROUP], everywhere, FRAMES, {})
    return make_problem(run, Target.read(table, "y", task), samples, "all", settings_of(permutations))


def columns_of(problem: Problem) -> NDArray[np.float64]:
    """The labels, and every permutation of them."""
    return np.column_stack([problem.labels, problem.permuted_labels])


def trend_and_noise(draw: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(3 * FRAME / FRAMES + draw.normal(size=GROUP.size))


def test_a_permutation_keeps_the_position_in_the_episode_and_the_blocks_of_groups() -> None:
    values = np.arange(GROUP.size, dtype=np.float64)
    columns = columns_of(label_problem_of(values, 50))
    assert columns.shape == (GROUP.size, 51)
    assert (columns % FRAMES == FRAME[:, None]).all(), "labels of one step stay at that step"
    blocks = (columns // FRAMES).reshape(GROUPS, FRAMES, -1)
    assert (blocks == blocks[:, :1]).all(), "a group gives all its labels to one other"


def test_groups_of_another_layout_do_not_exchange() -> None:
    kinds = ["original"] * 7 + ["swapped"] * 5
    columns = columns_of(label_problem_of(np.arange(GROUP.size, dtype=np.float64), 50, kinds))
    assert ((columns < 7 * FRAMES) == (columns[:, :1] < 7 * FRAMES)).all()


def test_folds_never_split_a_group_and_do_not_depend_on_the_labels() -> None:
    draw = np.random.default_rng(0)
    first, other = (label_problem_of(draw.normal(size=GROUP.size), 0) for _ in range(2))
    assert (first.fold_of == other.fold_of).all()
    for number in range(GROUPS):
        assert np.unique(first.fold_of[number == GROUP]).size == 1


def test_a_trend_over_the_episode_is_read_and_is_no_signal() -> None:
    draw = np.random.default_rng(1)
    problem = label_problem_of(trend_and_noise(draw), 19)
    features = FRAME[:, None] + 0.1 * draw.normal(size=(GROUP.size, 4))
    probe = probe_site(
        Samples.pooled(features), problem.labels, problem.permuted_labels, problem.folds, "continuous"
    )
    assert probe.scores.mean() > 0.2, "the label can be predicted from the step"
    assert probe.null.mean() > 0.2, "so chance is not 0"
    assert p_value(np.array([probe.scores.mean()]), probe.null[None, :])[0] > 0.05
    free = np.column_stack([problem.labels, *(draw.permutation(problem.labels) for _ in range(19))])
    shuffled = probe_site(Samples.pooled(features), free[:, 0], free[:, 1:], problem.folds, "continuous")
    assert p_value(np.array([shuffled.scores.mean()]), shuffled.null[None, :])[0] == 0.05, (
        "as a null of frames has it"
    )


@pytest.mark.parametrize("task", TASKS)
def test_the_score_of_a_labelling_does_not_depend_on_its_place_among_the_permutations(task: Task) -> None:
    """So the real labels are one of equally likely labellings, and p is exact whatever the probe is."""
    draw = np.random.default_rng(2)
    values = trend_and_noise(draw)
    levels = {"binary": [0.5], "classes": [1 / 3, 2 / 3], "continuous": []}[task]
    if levels:
        values = np.digitize(values, np.quantile(values, levels)).astype(np.float64)
    problem = label_problem_of(values, 5, task=task)
    features = draw.normal(size=(GROUP.size, 4))
    probe = problem.fit(Samples.pooled(features), problem.permuted_labels)
    first = problem.permuted_labels[:, -1]
    labellings = np.column_stack([problem.labels, problem.permuted_labels[:, :-1]])
    turned = probe_site(Samples.pooled(features), first, labellings, problem.folds, task)
    expected = np.roll([probe.scores.mean(), *probe.null], 1)
    np.testing.assert_allclose([turned.scores.mean(), *turned.null], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["trend", "group", "noise"])
def test_labels_that_know_nothing_are_found_in_five_of_a_hundred(kind: str) -> None:
    false_alarms = 0
    for seed in range(100):
        draw = np.random.default_rng(seed)
        values = {
            "trend": trend_and_noise(draw),
            "group": draw.normal(size=GROUPS)[GROUP],
            "noise": draw.normal(size=GROUP.size),
        }[kind]
        of_group = draw.normal(size=(GROUPS, 4))[GROUP]
        features = of_group + FRAME[:, None] + draw.normal(size=(GROUP.size, 4))
        problem = label_problem_of(values, 39)
        probe = probe_site(
            Samples.pooled(features), problem.labels, problem.permuted_labels, problem.folds, "continuous"
        )
        false_alarms += int(p_value(np.array([probe.scores.mean()]), probe.null[None, :])[0] <= 0.05)
    assert false_alarms <= 12, "five are expected; 13 or more have a chance of 0.0015"


ITEMS = np.repeat(np.arange(20), 2)
LABELS = np.tile([True, False], 20)


def p_values(seed: int, sites: int, permuted_labels: int) -> tuple[np.ndarray, np.ndarray]:
    """Per-site and family-wise p of `sites` correlated sites of noise."""
    generator = np.random.default_rng(seed)
    shared = generator.standard_normal((40, 6))
    columns = flip_groups(LABELS, ITEMS, permuted_labels, seed)
    folds = nested_folds(LABELS, ITEMS, seed)
    probes = [
        probe_site(Samples.pooled(shared + generator.standard_normal((40, 6))), LABELS, columns, folds)
        for _ in range(sites)
    ]
    accuracy = np.array([correctness(probe.decisions, LABELS).mean() for probe in probes])
    null = np.stack([probe.null for probe in probes])
    return p_value(accuracy, null), max_statistic_p(accuracy, null)


@pytest.mark.slow
def test_p_values_without_signal_are_uniform_or_larger() -> None:
    """Ties between accuracies make p larger, never smaller."""
    p = np.sort([p_values(seed, 1, 19)[0][0] for seed in range(40)])
    for level in (0.1, 0.25, 0.5, 0.75):
        most = binom.ppf(0.9999, p.size, level)
        assert most < p.size, "a bound that nothing can exceed tests nothing"
        assert (p <= level).sum() <= most
    assert (p <= 0.5).mean() >= 0.2


@pytest.mark.slow
def test_family_wise_error_stays_below_its_level() -> None:
    draws = [p_values(seed, 4, 59) for seed in range(300)]
    some_site = np.mean([site.min() < 0.05 for site, _ in draws])
    some_family = np.mean([family.min() < 0.05 for _, family in draws])
    assert some_family <= 0.06
    assert some_site > 0.08  # which is why the family-wise p exists


SHAPES = {"count": st.integers(8, 40), "width": st.integers(1, 60), "seed": st.integers(0, 2**31)}


def problem(count: int, width: int, seed: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples of any scale, and label columns that hold both classes."""
    draw = np.random.default_rng(seed)
    samples = draw.normal(size=(count, width)) * 10 ** draw.uniform(-2, 3, width) + draw.normal(size=width)
    labels = draw.random((count, columns)) < 0.5
    labels[0], labels[1] = True, False
    return samples, labels


def decisions(samples: np.ndarray | torch.Tensor, labels: np.ndarray) -> np.ndarray:
    """(C, N, K) of the training samples."""
    coordinates = Projection.fit(samples)
    inside = coordinates(samples)
    path = LogisticSolver(coordinates.train).path(labels, STRENGTHS)
    return np.stack([np.asarray(inside @ weights) for weights in path])


@pytest.mark.slow
@given(**SHAPES)
@settings(max_examples=15, deadline=None)
def test_labels_solved_together_equal_labels_solved_alone(count: int, width: int, seed: int) -> None:
    samples, labels = problem(count, width, seed, 4)
    together = decisions(samples, labels)
    for column in range(4):
        alone = decisions(samples, labels[:, [column]])[..., 0]
        np.testing.assert_allclose(together[..., column], alone, rtol=0, atol=1e-6 * np.abs(alone).max())


@given(**SHAPES)
@settings(max_examples=15, deadline=None)
def test_torch_gives_the_decisions_of_numpy(count: int, width: int, seed: int) -> None:
    samples, labels = problem(count, width, seed, 3)
    ours, theirs = decisions(samples, labels), decisions(torch.from_numpy(samples), labels)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6 * np.abs(ours).max())
