"""A site with many samples: all training sets in shared products against every training set on its own.

    python benchmarks/joint_probes.py [--episodes 300] [--tokens 271] [--width 2048] [--permutations 0]

Both solve the same problems to the same certified optimum. On its own, one inner training set is timed on the
whole grid of C and one outer one at the C that was chosen; both are scaled to all. Processor time, one thread, so
that a busy machine distorts little. Work is counted as products only: for k problems of M samples and D features,
a gradient or a step of conjugate gradients is 4·M·D·k for the samples and 4·D²·k for the axes; once per site
2·M·D² each for moments and turning. The machine's rate is that of square products in the same process.
`--part together` and `--part alone` do half of it each, so that a large site can be timed in two processes; alone
is then given the chosen `--strength`. `--decisions FILE` keeps what together decided in the first outer fold, and
alone compares with it. `--rival-memory` is what alone may take for turned training samples of a set in float64
(probe_kit has 0.5, beyond which it visits them in blocks, for two to eight times as long). Peak memory is that
of the whole process, with the making of samples.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from threadpoolctl import threadpool_limits

from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval import logistic_folds as probe
from probe_kit.train.crossval.joint_objective import JointProblems, JointSite, NewtonState
from probe_kit.train.crossval.logistic_folds import can_be_joint, cross_validate_jointly, labels_at_once
from probe_kit.train.crossval.nested_folds import (
    STRENGTHS,
    FittedFold,
    InnerQuality,
    NestedFold,
    nested_folds,
)
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import RowSubset
from probe_kit.train.solver.design_matrix import IN_MEMORY, Projection
from probe_kit.train.solver.logistic import LogisticSolver


def samples_of(episodes: int, tokens: int, width: int, signal: float) -> Samples:
    """Tokens that share what their item and their position are, bfloat16 values, five large features."""
    generator = np.random.default_rng(0)
    directions = np.logspace(1, -1, 64)[:, None] * generator.standard_normal((64, width))
    item = generator.standard_normal((episodes // 2, 64)).repeat(2, axis=0)
    item += 0.5 * generator.standard_normal((episodes, 64))
    position, answer = generator.standard_normal((tokens, 64)), generator.standard_normal(width)
    features = np.empty((episodes * tokens, width), np.float32)
    for episode in range(episodes):
        mixture = 0.6 * item[episode] + position + 0.7 * generator.standard_normal((tokens, 64))
        values = mixture @ directions + 0.5 * generator.standard_normal((tokens, width))
        tells = generator.random((tokens, 1)) < 0.1
        values += signal * (1 if episode % 2 == 0 else -1) * tells * answer
        features[episode * tokens : (episode + 1) * tokens] = values
    features[:, :5] *= 1000
    features.view(np.uint32)[:] &= np.uint32(0xFFFF0000)
    means = features.reshape(episodes, tokens, width).mean(axis=1, dtype=np.float64)
    return Samples(RowSubset.all(features), np.full(episodes, tokens), means)


def processor_seconds(work: Callable[[], object]) -> float:
    """Processor time of `work()`."""
    start = time.process_time()
    work()
    return time.process_time() - start


def rate(dtype: type[np.floating]) -> float:
    """GFLOP/s of a product of two square matrices."""
    square = np.random.default_rng(0).standard_normal((2048, 2048)).astype(dtype)
    return 2 * 2048**3 / min(processor_seconds(lambda: square @ square) for _ in range(3)) / 1e9


@dataclass
class Work:
    """GFLOP in products so far, by precision."""

    single: float = 0.0
    double: float = 0.0


class Counted(JointProblems):
    """The same problems, whose products are counted."""

    work = Work()

    def point(self, weights: object, rows: NDArray[np.intp], *, exact: bool) -> NewtonState:
        """As of JointProblems."""
        if exact:
            self.work.double += self._products(rows)
        else:
            self.work.single += self._products(rows)
        return super().point(weights, rows, exact=exact)

    def curved(self, directions: object, curvature: object, rows: NDArray[np.intp]) -> object:
        """As of JointProblems."""
        self.work.single += self._products(rows)
        return super().curved(directions, curvature, rows)

    def _products(self, rows: NDArray[np.intp]) -> float:
        width = self.site.turned.shape[1]
        of_fold = np.array([[block.outer, len(block.episode)] for block in self.site.blocks])
        outer = self.site.sets.outer[self.set_of[rows]]
        samples = sum((of_fold[of_fold[:, 0] != fold, 1].sum() for fold in outer), 0)
        return 4 * width * (float(samples) + width * len(rows)) / 1e9


def alone_seconds(
    samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold], strengths: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Processor time of every training set on its own, scaled from two, and the first outer fold's decisions."""
    inner, outer = folds[0].inner[0], folds[0].outer

    def one_inner() -> None:
        train = samples.of(inner.train)
        for _ in LogisticSolver(Projection.fit(train.features).train).path(
            train.repeat(labels[inner.train]), STRENGTHS
        ):
            pass

    seconds = OUTER_FOLDS * INNER_FOLDS * processor_seconds(one_inner)
    fitted: list[FittedFold] = []
    quality = InnerQuality(np.zeros(labels.shape[1]), np.zeros(len(labels)))
    once = processor_seconds(lambda: fitted.append(probe._fit_fold(samples, labels, outer, strengths, quality)))
    return seconds + OUTER_FOLDS * once, fitted[0].decisions


def main() -> None:
    """Print one comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--tokens", type=int, default=271, help="per episode; 1 is a pooled view")
    parser.add_argument("--width", type=int, default=2048)
    parser.add_argument("--permutations", type=int, default=0)
    parser.add_argument("--signal", type=float, default=0.3, help="0: none, and C is small")
    parser.add_argument("--part", choices=("together", "alone", "both"), default="both")
    parser.add_argument("--strength", type=float, default=10.0, help="C of the outer fold with --part alone")
    parser.add_argument(
        "--rival-memory", type=float, default=IN_MEMORY / 2**30, help="GiB for one training set alone"
    )
    parser.add_argument("--decisions", type=Path, help="file of the first outer fold's decisions")
    arguments = parser.parse_args()
    console = Console(width=115, highlight=False)
    samples = samples_of(arguments.episodes, arguments.tokens, arguments.width, arguments.signal)
    real = np.tile([True, False], arguments.episodes // 2)
    items = np.repeat(np.arange(arguments.episodes // 2), 2)
    labels = np.column_stack([real, flip_items(real, items, arguments.permutations, seed=0)])
    folds = nested_folds(real, items, seed=0)
    console.print(
        f"{arguments.episodes} × {arguments.tokens} samples × {arguments.width}, {labels.shape[1]} columns"
        f"; probe_kit solves them {'together' if can_be_joint(samples, labels.shape[1]) else 'alone'}"
    )
    seconds, strengths, decisions = 0.0, np.full(labels.shape[1], arguments.strength), None
    with (
        threadpool_limits(1),
        patch("probe_kit.train.solver.design_matrix.IN_MEMORY", arguments.rival_memory * 2**30),
    ):
        if arguments.part != "alone":
            seconds, fitted = together(samples, labels, folds, console)
            strengths, decisions = fitted[0].strengths, fitted[0].decisions
            if arguments.decisions:
                np.save(arguments.decisions, decisions)
        elif arguments.decisions:
            decisions = np.load(arguments.decisions)
        if arguments.part == "together":
            return
        alone, rival = alone_seconds(samples, labels, folds, strengths)
        console.print(f"alone: {alone:.1f} s, scaled; peak memory {peak_memory():.2f} GB")
        if seconds:
            console.print(f"{alone / seconds:.1f} times")
        if decisions is not None:
            console.print(f"decisions apart by {np.abs(decisions - rival).max() / np.abs(rival).max():.0e}")


def together(
    samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold], console: Console
) -> tuple[float, list[FittedFold]]:
    """Processor time of a whole site in shared products, and what is found; prints where it goes."""
    single, double = rate(np.float32), rate(np.float64)
    sites: list[JointSite] = []
    before = peak_memory()
    once = processor_seconds(lambda: sites.append(JointSite.of(samples, folds)))
    console.print(f"machine: {single:.0f} GFLOP/s in float32, {double:.0f} in float64; {once:.1f} s once")
    fitted: list[FittedFold] = []
    with patch.object(probe, "JointProblems", Counted):  # every product is made, and counted
        solving = processor_seconds(
            lambda: fitted.extend(cross_validate_jointly(sites[0], samples, labels, folds))
        )
    count, width = samples.features.shape
    moments = 4 * count * width**2 / 1e9
    work = Counted.work
    bound = (moments + work.single) / single + work.double / double
    console.print(f"{labels_at_once(sites[0], folds)} columns at once; alike: {sites[0].alike}")
    console.print(f"chosen C: {[float(fold.strengths[0]) for fold in fitted]}")
    console.print(f"products: {moments + work.single:.0f} GFLOP in float32, {work.double:.0f} in float64")
    console.print(
        f"together: {once:.1f} s once and {solving:.1f} s; {bound / (once + solving):.0%} of the rate; "
        f"peak memory {peak_memory():.2f} GB, {before:.2f} before"
    )
    return once + solving, fitted


def peak_memory() -> float:
    """GB of this process so far, at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


if __name__ == "__main__":
    main()
