"""False positives of probes of labels that know nothing of the features: how often p is below 0.05.

    python benchmarks/label_null.py [--labels 200] [--tasks continuous,classes,binary] [--one-site] [--jobs 1]
                                    [--keep DIR]

Features are drawn once per label: 20 groups of two episodes of 8 inferences, three sites of 12 features with an
autocorrelation of 0.9, a trend over the episode, and a part that is the same in a group. Labels are of six kinds;
classes are their terciles, binary labels their upper halves. Samples, folds, choice of the penalty, exchanges of
groups and fits are those of `probe-kit train --labels`, with 99 permutations. `--one-site` fits the first site of
the same features, at a third of the cost. With `--keep` the same command resumes.
"""

import argparse
import warnings
from collections.abc import Callable
from functools import partial
from multiprocessing import Pool
from pathlib import Path

import numpy as np
import pandas as pd
from kept_draws import kept_draws
from threadpoolctl import threadpool_limits

from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.label_permutations import p_value
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train import ArrayRun, ProbeSettings, Target
from probe_kit.train.choices import TASKS, Task
from probe_kit.train.problem import make_problem
from probe_kit.train.samples import Samples
from probe_kit.train.target_samples import TargetSamples

GROUPS, EPISODES, FRAMES, WIDTH, SITES, PERMUTATIONS = 20, 2, 8, 12, 3, 99
SHAPE = GROUPS, EPISODES, FRAMES


def autoregressive(draw: np.random.Generator, shape: tuple[int, ...], share: float = 0.9) -> Matrix:
    """A stationary AR(1) series along the last axis."""
    series = draw.normal(size=shape)
    for frame in range(1, shape[-1]):
        series[..., frame] = share * series[..., frame - 1] + np.sqrt(1 - share**2) * series[..., frame]
    return series


def features(draw: np.random.Generator) -> Matrix:
    """(SITES, n, WIDTH): autocorrelated, with a trend over the episode and a part of the group."""
    series = autoregressive(draw, (SITES, WIDTH, *SHAPE))
    trend = draw.normal(size=(SITES, WIDTH, 1, 1, 1)) * np.linspace(-1, 1, FRAMES)
    of_group = draw.normal(size=(SITES, WIDTH, GROUPS, 1, 1))
    return (series + trend + of_group).reshape(SITES, WIDTH, -1).transpose(0, 2, 1)


KINDS: dict[str, Callable[[np.random.Generator], Matrix]] = {
    "white noise": lambda draw: draw.normal(size=SHAPE),
    "AR(1), 0.9": lambda draw: autoregressive(draw, SHAPE),
    "start and slope per episode": lambda draw: (
        draw.normal(size=(*SHAPE[:2], 1)) + draw.normal(size=(*SHAPE[:2], 1)) * np.linspace(-1, 1, FRAMES)
    ),
    "common trend + AR(1)": lambda draw: 2 * np.linspace(-1, 1, FRAMES) + autoregressive(draw, SHAPE),
    "constant per episode": lambda draw: np.broadcast_to(draw.normal(size=(*SHAPE[:2], 1)), SHAPE),
    "constant per group": lambda draw: np.broadcast_to(draw.normal(size=(GROUPS, 1, 1)), SHAPE),
}


def coded(values: Matrix, task: Task) -> Matrix:
    """The label of every sample: the quantity, its tercile or its half."""
    if task == "continuous":
        return values
    levels = [1 / 3, 2 / 3] if task == "classes" else [0.5]
    return np.digitize(values, np.quantile(values, levels)).astype(float)


def p_values(kind: str, task: Task, fitted: int, seed: int) -> tuple[float, float]:
    """The p of the first site alone, and the least family-wise p of the first `fitted` sites."""
    draw = np.random.default_rng(derive_seed("label null", kind, seed))
    sites, values = features(draw)[:fitted], coded(KINDS[kind](draw).ravel(), task)
    group, episode, frame = (axis.ravel() for axis in np.indices(SHAPE))
    names = np.array([f"e{number}" for number in range(GROUPS * EPISODES)])
    rows = group * EPISODES + episode
    table = pd.DataFrame({"episode_id": names[rows], "inference": frame, "y": values})
    episodes = pd.DataFrame({"episode_id": names, "group_id": np.repeat(np.arange(GROUPS), EPISODES).astype(str)})
    episodes["category"] = "all"
    run = ArrayRun(Path("nowhere"), "none", "none", episodes, {})
    samples = TargetSamples(rows, frame, values, group.astype(str), np.full(rows.size, "all"), FRAMES, {})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        settings = ProbeSettings("m", False, None, "", "", "", "", ("all",), ("mean",), "y", PERMUTATIONS, seed)
        problem = make_problem(run, Target.read(table, "y", task), samples, "all", settings)
    probes = [problem.probe(Samples.pooled(site)) for site in sites]
    metric, null = np.array([probe.scores.mean() for probe in probes]), np.stack([probe.null for probe in probes])
    every = np.column_stack([metric, null])
    excess = every - every.mean(axis=1, keepdims=True)
    family = p_value(excess.max(axis=0)[:1], excess.max(axis=0)[None, 1:])
    return float(p_value(metric, null)[0]), float(family[0])


def drawn(kind: str, task: Task, fitted: int, seed: int) -> tuple[float, float]:
    """The same with one BLAS thread."""
    with threadpool_limits(1):
        return p_values(kind, task, fitted, seed)


def main() -> None:
    """Draw, and print both error rates of every task and kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, default=200, help="of each task and kind")
    parser.add_argument("--tasks", default="continuous,classes,binary")
    parser.add_argument("--one-site", action="store_true", help="leave the family out")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="a folder that keeps draws, to resume; in one process")
    options = parser.parse_args()
    tasks: list[Task] = [task for task in TASKS if task in options.tasks.split(",")]  # type: ignore[misc]
    fitted = 1 if options.one_site else SITES
    heading = "one site" if options.one_site else f"one site / family of {SITES} sites"
    print(f"{options.labels} labels each, p < 0.05: {heading}", flush=True)
    for task in tasks:
        for kind in KINDS:
            work, seeds = partial(drawn, kind, task, fitted), range(options.labels)
            if options.jobs > 1:
                with Pool(options.jobs) as pool:
                    draws_p = np.array(pool.map(work, seeds, chunksize=1))
            else:
                draws_p = np.array(kept_draws(options.keep, f"{task} labels, {kind}, {fitted} sites", seeds, work))
            site, family = (draws_p < SIGNIFICANCE).mean(axis=0)
            rates = f"{site:.3f}" if options.one_site else f"{site:.3f} / {family:.3f}"
            print(f"{task:11} {kind:28} {rates}", flush=True)


if __name__ == "__main__":
    main()
