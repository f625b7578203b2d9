"""A pooled site at full size: how much of the machine's own matrix rate its probes reach.

    python benchmarks/pooled_probes.py [--episodes 3440] [--width 2048] [--permutations 200] [--folds 1]

One inner training set on the whole grid of C and one outer set at the C that was chosen are timed (`--folds`: as
many of each as outer folds), in processor time and on one thread, and scaled to the 20 and 5 of a site. Work is
counted as it is done: a product of N samples in R coordinates with k columns is 2·N·R·k, whole Hessians are
2·N·R²·k. Projection are N·D² for moments, of which one half is computed, and 2·N·D² for turning training samples,
as much for every test sample; where eigenvectors are found in float32, D³ in float64 and 2·D³ in float32 make them
orthogonal again. The eigenvectors of D × D, about 9·D³, are shown apart and are no part of the share. The rate is
that of square products, 2,048 wide, in the same process.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from probes import features, labels_of
from rich.console import Console
from threadpoolctl import threadpool_limits

from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval import logistic_folds as probe
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.samples import Samples
from probe_kit.train.solver.design_matrix import WORTH_NARROWING, DenseDesign, Projection


@dataclass
class Work:
    """GFLOP in products so far, by precision."""

    single: float = 0.0
    double: float = 0.0

    def __sub__(self, other: "Work") -> "Work":
        return Work(self.single - other.single, self.double - other.double)

    def add(self, design: DenseDesign, columns: int, inner: int = 1) -> None:
        """A product of the design with so many columns; inner: of so many coordinates each."""
        count, width = design.shape
        gigaflop = 2 * count * width * columns * inner / 1e9
        if design.samples.dtype == np.float32:
            self.single += gigaflop
        else:
            self.double += gigaflop


def counting(work: Work) -> dict[str, Callable[..., object]]:
    """The products of a design, counted."""
    product, gather, moments = DenseDesign.__matmul__, DenseDesign.gather, DenseDesign.moments

    def counted_product(self: DenseDesign, weights: NDArray[np.float64]) -> object:
        work.add(self, weights.shape[-1] if weights.ndim > 1 else 1)
        return product(self, weights)

    def counted_gather(self: DenseDesign, values: NDArray[np.float64]) -> object:
        work.add(self, values.shape[1])
        return gather(self, values)

    def counted_moments(self: DenseDesign, weights: NDArray[np.float64]) -> object:
        work.add(self, weights.shape[1], self.shape[1])
        return moments(self, weights)

    return {"__matmul__": counted_product, "gather": counted_gather, "moments": counted_moments}


def rate(dtype: type[np.floating]) -> float:
    """GFLOP/s of a product of two square matrices."""
    square = np.random.default_rng(0).standard_normal((2048, 2048)).astype(dtype)
    times = []
    for _ in range(3):
        start = time.process_time()
        square @ square
        times.append(time.process_time() - start)
    return 2 * 2048**3 / min(times) / 1e9


def main() -> None:
    """Time some folds of a site and print the share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=3440)
    parser.add_argument("--width", type=int, default=2048)
    parser.add_argument("--permutations", type=int, default=200)
    parser.add_argument("--folds", type=int, default=1)
    parser.add_argument("--sites", type=int, default=1, help="of the model, for the scaled time")
    arguments = parser.parse_args()
    console = Console(width=115, highlight=False)
    samples = Samples.pooled(features(arguments.episodes, arguments.width))
    real, items = labels_of(arguments.episodes)
    labels = np.column_stack([real, flip_items(real, items, arguments.permutations, seed=0)])
    folds = nested_folds(real, items, seed=0)
    spent, work_done = {"coordinates": 0.0, "inner": 0.0, "outer": 0.0}, {"inner": Work(), "outer": Work()}
    fit, turn, work, setting = Projection.fit.__func__, Projection.__call__, Work(), Work()  # type: ignore[attr-defined]

    def total() -> Work:
        return Work(work.single + setting.single, work.double + setting.double)

    def timed_fit(cls: type[Projection], features: object) -> Projection:
        start = time.process_time()
        projection: Projection = fit(cls, features)
        spent["coordinates"] += time.process_time() - start
        count, width = samples_shape(features)
        if count >= width >= WORTH_NARROWING:
            setting.single += 2 * width**3 / 1e9
            setting.double += (3 * count + width) * width**2 / 1e9
        else:
            setting.double += 3 * count * width**2 / 1e9
        return projection

    def timed_turn(self: Projection, features: NDArray[np.float64]) -> object:
        start = time.process_time()
        turned = turn(self, features)
        spent["coordinates"] += time.process_time() - start
        setting.double += 2 * len(features) * self.axes.shape[0] * self.axes.shape[1] / 1e9
        return turned

    with (
        threadpool_limits(1),
        patch.multiple(DenseDesign, **counting(work)),
        patch.object(Projection, "fit", classmethod(timed_fit)),
        patch.object(Projection, "__call__", timed_turn),
    ):
        single, double = rate(np.float32), rate(np.float64)
        for fold in folds[: arguments.folds]:
            start = time.process_time()
            strengths, quality = probe.choose_strengths(samples, labels, fold.inner[:1])
            spent["inner"] += time.process_time() - start
            work_done["inner"] = total() - work_done["outer"]
            start = time.process_time()
            probe._fit_fold(samples, labels, fold.outer, strengths, quality)
            spent["outer"] += time.process_time() - start
            work_done["outer"] = total() - work_done["inner"]
    seconds = spent["inner"] + spent["outer"]
    bound = {part: of.single / single + of.double / double for part, of in work_done.items()}
    full, least = (
        (OUTER_FOLDS * INNER_FOLDS * of["inner"] + OUTER_FOLDS * of["outer"]) / arguments.folds
        for of in (spent, bound)
    )
    console.print(f"N = {arguments.episodes:,}, D = {arguments.width:,}, {labels.shape[1]} label columns")
    console.print(f"machine: {single:.0f} GFLOP/s in float32, {double:.0f} in float64")
    console.print(
        f"inner {spent['inner']:.1f} s, outer {spent['outer']:.1f} s, "
        f"of both coordinates {spent['coordinates']:.1f} s"
    )
    console.print(
        f"products: {work.single:.0f} GFLOP in float32, {work.double:.0f} in float64; "
        f"coordinates {setting.single:.0f} and {setting.double:.0f}, "
        f"eigenvectors about {2 * arguments.folds * 9 * arguments.width**3 / 1e9:.0f}"
    )
    console.print(
        f"{sum(bound.values()) / seconds:.0%} of the rate, {bound['inner'] / spent['inner']:.0%} in the inner set "
        f"and {least / full:.0%} of a site (of both sets, as if float32 paid nothing: "
        f"{(total().single + total().double) / double / seconds:.0%})"
    )
    console.print(
        f"a site, scaled: {full:.0f} s; {arguments.sites} sites: {arguments.sites * full / 3600:.1f} CPU-hours"
    )
    console.print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


def samples_shape(features: object) -> tuple[int, int]:
    """(N, D) of what coordinates are fitted to."""
    shape = getattr(features, "shape", (0, 0))
    return int(shape[0]), int(shape[1])


if __name__ == "__main__":
    main()
