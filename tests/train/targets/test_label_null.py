"""The null of labels: groups exchange, so that what is alike within an episode or a group is no signal."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from probe_kit.statistics.label_permutations import pointwise_p
from probe_kit.train import ArrayRun, Target
from probe_kit.train.choices import TASKS, Task
from probe_kit.train.crossval.site_probe import probe_labels
from probe_kit.train.data.samples import Samples
from probe_kit.train.problem import Problem, make_problem
from probe_kit.train.target_samples import TargetSamples
from tests.train.conftest import settings_of

GROUPS, FRAMES = 12, 6
GROUP, FRAME = (axis.ravel() for axis in np.indices((GROUPS, FRAMES)))


def problem_of(
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
    columns = columns_of(problem_of(values, 50))
    assert columns.shape == (GROUP.size, 51)
    assert (columns % FRAMES == FRAME[:, None]).all(), "labels of one step stay at that step"
    blocks = (columns // FRAMES).reshape(GROUPS, FRAMES, -1)
    assert (blocks == blocks[:, :1]).all(), "a group gives all its labels to one other"


def test_groups_of_another_layout_do_not_exchange() -> None:
    kinds = ["original"] * 7 + ["swapped"] * 5
    columns = columns_of(problem_of(np.arange(GROUP.size, dtype=np.float64), 50, kinds))
    assert ((columns < 7 * FRAMES) == (columns[:, :1] < 7 * FRAMES)).all()


def test_folds_never_split_a_group_and_do_not_depend_on_the_labels() -> None:
    draw = np.random.default_rng(0)
    one, other = (problem_of(draw.normal(size=GROUP.size), 0) for _ in range(2))
    assert (one.fold_of == other.fold_of).all()
    for number in range(GROUPS):
        assert np.unique(one.fold_of[number == GROUP]).size == 1


def test_a_trend_over_the_episode_is_read_and_is_no_signal() -> None:
    draw = np.random.default_rng(1)
    problem = problem_of(trend_and_noise(draw), 19)
    features = FRAME[:, None] + 0.1 * draw.normal(size=(GROUP.size, 4))
    probe = probe_labels(Samples.pooled(features), columns_of(problem), "continuous", problem.folds)
    assert probe.scores.mean() > 0.2, "the label can be predicted from the step"
    assert probe.null.mean() > 0.2, "so chance is not 0"
    assert pointwise_p(np.array([probe.scores.mean()]), probe.null[None, :])[0] > 0.05
    free = np.column_stack([problem.labels, *(draw.permutation(problem.labels) for _ in range(19))])
    shuffled = probe_labels(Samples.pooled(features), free, "continuous", problem.folds)
    assert pointwise_p(np.array([shuffled.scores.mean()]), shuffled.null[None, :])[0] == 0.05, (
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
    problem = problem_of(values, 5, task=task)
    features = draw.normal(size=(GROUP.size, 4))
    probe = probe_labels(Samples.pooled(features), columns_of(problem), task, problem.folds)
    turned = probe_labels(Samples.pooled(features), np.roll(columns_of(problem), 1, axis=1), task, problem.folds)
    expected = np.roll([probe.scores.mean(), *probe.null], 1)
    np.testing.assert_allclose([turned.scores.mean(), *turned.null], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["trend", "group", "noise"])
def test_labels_that_know_nothing_are_found_in_five_of_a_hundred(kind: str) -> None:
    found = 0
    for seed in range(100):
        draw = np.random.default_rng(seed)
        values = {
            "trend": trend_and_noise(draw),
            "group": draw.normal(size=GROUPS)[GROUP],
            "noise": draw.normal(size=GROUP.size),
        }[kind]
        of_group = draw.normal(size=(GROUPS, 4))[GROUP]
        features = of_group + FRAME[:, None] + draw.normal(size=(GROUP.size, 4))
        problem = problem_of(values, 39)
        probe = probe_labels(Samples.pooled(features), columns_of(problem), "continuous", problem.folds)
        found += int(pointwise_p(np.array([probe.scores.mean()]), probe.null[None, :])[0] <= 0.05)
    assert found <= 12, "five are expected; 13 or more have a chance of 0.0015"
