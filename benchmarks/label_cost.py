"""Processor time of a label's probe at one site, with its label permutations.

    python benchmarks/label_cost.py [--task continuous] [--permutations 200]

Features are drawn: 1,720 samples of 43 groups, of the width of `pi0-tiny` (96) and of pi0 (2,048). Folds, choice
of the penalty and exchanges of groups are those of `probe-kit train --labels`. One process; `OMP_NUM_THREADS` sets
its threads.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd

from probe_kit.train import ArrayRun, ProbeSettings, Target
from probe_kit.train.choices import TASKS
from probe_kit.train.problem import Problem, make_problem
from probe_kit.train.samples import Samples
from probe_kit.train.target_samples import TargetSamples

GROUPS, EPISODES, FRAMES = 43, 4, 10
WIDTHS = (96, 2048)


def problem_of(task: str, permutations: int) -> Problem:
    """A label of every frame: a wandering quantity, its terciles or its halves."""
    draw = np.random.default_rng(0)
    group, episode, frame = (axis.ravel() for axis in np.indices((GROUPS, EPISODES, FRAMES)))
    values = draw.normal(size=(GROUPS * EPISODES, FRAMES)).cumsum(axis=1).ravel()
    levels = {"continuous": [], "classes": [1 / 3, 2 / 3], "binary": [0.5]}[task]
    if levels:
        values = np.digitize(values, np.quantile(values, levels)).astype(float)
    rows = group * EPISODES + episode
    names = np.array([f"e{number}" for number in range(GROUPS * EPISODES)])
    table = pd.DataFrame({"episode_id": names[rows], "inference": frame, "y": values})
    episodes = pd.DataFrame({"episode_id": names, "group_id": np.repeat(np.arange(GROUPS), EPISODES).astype(str)})
    episodes["category"] = "all"
    run = ArrayRun(Path("nowhere"), "none", "none", episodes, {})
    samples = TargetSamples(rows, frame, values, group.astype(str), np.full(rows.size, "all"), FRAMES, {})
    target = Target.read(table, "y", task)  # type: ignore[arg-type]
    settings = ProbeSettings("m", False, None, "", "", "", "", ("all",), ("mean",), "y", permutations, 0)
    return make_problem(run, target, samples, "all", settings)


def main() -> None:
    """Fit, and print seconds of processor and of the clock by width."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="continuous", choices=TASKS)
    parser.add_argument("--permutations", type=int, default=200)
    options = parser.parse_args()
    problem = problem_of(options.task, options.permutations)
    for width in WIDTHS:
        features = np.random.default_rng(1).normal(size=(problem.labels.size, width)).astype(np.float32)
        processor, clock = time.process_time(), time.perf_counter()
        problem.probe(Samples.pooled(features))
        processor, clock = time.process_time() - processor, time.perf_counter() - clock
        print(
            f"{options.task}, {problem.labels.size} x {width}, {options.permutations} permutations: "
            f"{processor:.1f} CPU-s, {clock:.1f} s"
        )


if __name__ == "__main__":
    main()
