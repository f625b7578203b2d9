"""Nested probes with a permutation null: probe_kit against loops over scikit-learn, one thread each.

    python benchmarks/probes.py [--permutations 200] [--sizes 300,1000] [--tokens 8,32] [--device cuda]

Features imitate a pooled VLM stream: 2,048 wide, a steep spectrum, a few features a thousand times larger, two
layouts per item. scikit-learn fits a stated subset of the sweep's problems; its time is scaled to all of them.
With --device, torch solves the same problems there.
"""

import argparse
import time
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from threadpoolctl import threadpool_limits

from probe_kit._system.types import Matrix
from probe_kit.runs.arrays import TokenBlock
from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval.nested_folds import STRENGTHS, nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.samples import Samples
from probe_kit.train.solver.design_matrix import Projection

WIDTH = 2048
SUBSET = 4  # label columns scikit-learn fits, at every C, in one inner fold


def features(n_episodes: int, width: int = WIDTH) -> NDArray[np.float32]:
    """(n_episodes, width) features without signal."""
    generator = np.random.default_rng(0)
    directions = np.logspace(1, -1, 64)[:, None] * generator.standard_normal((64, width))
    of_item = generator.standard_normal((n_episodes // 2, 64)).repeat(2, axis=0)
    mixture = (of_item + 0.5 * generator.standard_normal((n_episodes, 64))) @ directions
    values = mixture + 0.5 * generator.standard_normal((n_episodes, width))
    values[:, :5] *= 1000
    return values.astype(np.float32)


def labels_of(n_episodes: int) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Labels and items, two layouts per item."""
    return np.tile([True, False], n_episodes // 2), np.repeat(np.arange(n_episodes // 2), 2)


def seconds(work: Callable[[], object]) -> float:
    """Wall-clock time of `work()`."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def probe_kit_seconds(samples: Samples, permutations: int, device: str | None = None) -> float:
    """One site, everything included: folds, C grid, label permutations, and the way to the device."""
    labels, items = labels_of(len(samples.counts))
    permuted_labels = flip_items(labels, items, permutations, seed=0)
    folds = nested_folds(labels, items, seed=0)
    return seconds(lambda: probe_site(samples.to(device), labels, permuted_labels, folds))


def scikit_learn_seconds(samples: Matrix, columns: NDArray[np.bool_], tolerance: float) -> float:
    """Seconds per problem, averaged over the C grid and `columns`."""

    def fit_all() -> None:
        for strength in STRENGTHS:
            for column in columns.T:
                LogisticRegression(C=strength, tol=tolerance, max_iter=20_000).fit(samples, column)

    return seconds(fit_all) / (STRENGTHS.size * columns.shape[1])


def compare(n_episodes: int, permutations: int, device: str | None) -> Table:
    """Seconds per site of probe_kit, by numpy and by torch, and of three ways to use scikit-learn."""
    labels, items = labels_of(n_episodes)
    fold = nested_folds(labels, items, seed=0)[0].inner[0]
    coordinates = Projection.fit(features(n_episodes)[fold.train])
    raw = coordinates.standardise(features(n_episodes)[fold.train])
    columns = flip_items(labels, items, SUBSET, seed=0)[fold.train]
    problems = OUTER_FOLDS * (INNER_FOLDS * STRENGTHS.size + 1) * (permutations + 1)

    samples_of_site = Samples.pooled(features(n_episodes))
    ours = probe_kit_seconds(samples_of_site, permutations)
    table = Table("", "ms per problem", "s per site", "times slower")
    table.title = f"N = {n_episodes}, D = {WIDTH}, {permutations} permutations: {problems:,} problems per site"
    table.add_row("probe_kit", f"{1e3 * ours / problems:.3f}", f"{ours:.1f}", "1")
    if device is not None:
        probe_kit_seconds(samples_of_site, 0, device)  # the first use of a device is slow
        our_seconds = probe_kit_seconds(samples_of_site, permutations, device)
        table.add_row(
            f"probe_kit, {device}",
            f"{1e3 * our_seconds / problems:.3f}",
            f"{our_seconds:.1f}",
            f"{our_seconds / ours:.2f}",
        )
    for name, samples, tolerance in (
        ("scikit-learn, tol 1e-10", raw, 1e-10),
        ("scikit-learn, default tol", raw, 1e-4),
        ("scikit-learn, reduced features, tol 1e-10", coordinates.train.samples[:, :-1], 1e-10),
    ):
        each = scikit_learn_seconds(samples, columns, tolerance)
        table.add_row(
            name, f"{1e3 * each:.2f}", f"{each * problems:.0f} (scaled)", f"{each * problems / ours:.0f}"
        )
    return table


def costs(cases: dict[str, Samples], device: str | None) -> Table:
    """What one more site and one more label permutation cost."""
    table = Table("", "s per site without label permutations", "ms per label permutation and site")
    table.title = f"probe_kit, {device or 'numpy'}"
    for name, samples in cases.items():
        fixed, more = (probe_kit_seconds(samples, permutations, device) for permutations in (0, 20))
        table.add_row(name, f"{fixed:.2f}", f"{1e3 * (more - fixed) / 20:.1f}")
    return table


def pooled_cases(sizes: list[int]) -> dict[str, Samples]:
    """One sample per episode."""
    return {f"N = {size:,}, D = {WIDTH}": Samples.pooled(features(size)) for size in sizes}


def token_cases(lengths: list[int]) -> dict[str, Samples]:
    """60 episodes of that many tokens, 256 wide."""
    cases = {}
    for length in lengths:
        tokens = features(60 * length)[:, :256].reshape(60, length, 256)
        mask = np.ones((60, length), bool)
        cases[f"N = 60 × {length} tokens, D = 256"] = Samples.tokens([TokenBlock(0, tokens, mask)], mask)
    return cases


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--permutations", type=int, default=200)
    parser.add_argument("--sizes", default="300,1000,3440", help="episodes, for the table of costs")
    parser.add_argument("--tokens", default="8,32", help="tokens per episode, for the table of costs")
    parser.add_argument("--device", help="where torch solves the problems too")
    arguments = parser.parse_args()
    sizes, lengths = ([int(part) for part in text.split(",")] for text in (arguments.sizes, arguments.tokens))
    console = Console(width=120)
    with threadpool_limits(1), warnings.catch_warnings():
        # lbfgs stops before 1e-10 when the line search meets rounding: as precise as it gets, and timed as such.
        warnings.simplefilter("ignore", ConvergenceWarning)
        console.print(compare(300, arguments.permutations, arguments.device))
        for device in dict.fromkeys([None, arguments.device]):
            console.print(costs(pooled_cases(sizes) | token_cases(lengths), device))


if __name__ == "__main__":
    main()
