"""Type I error of whole nested probes: how often p is below 0.05 on features without signal.

    python benchmarks/probe_null.py [--draws 2000] [--first-seed 0] [--keep DIR]

A draw has 24 items in both layouts and four neighbouring sites of twelve features, correlated 0.9. Choice of C,
folds and fits are those of `probe-kit train`, repeated for 99 permutations: one to two seconds per draw. Worlds
with shared pictures or missing episodes are those of `null_worlds.py`. With `--keep` the same command
resumes.
"""

import argparse
from pathlib import Path

import numpy as np
from kept_draws import kept_draws
from numpy.typing import NDArray
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p, p_value
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.samples import Samples

SITES, WIDTH, ITEMS, PERMUTATIONS = 4, 12, 24, 99


def neighbouring_sites(generator: np.random.Generator) -> NDArray[np.float64]:
    """(SITES, 2 * ITEMS, WIDTH) normal features; neighbouring sites correlated 0.9."""
    features = generator.standard_normal((SITES, 2 * ITEMS, WIDTH))
    for site in range(1, SITES):
        features[site] = 0.9 * features[site - 1] + np.sqrt(1 - 0.81) * features[site]
    return features


def p_values(seed: int) -> tuple[float, float]:
    """The p of the first site alone, and the least family-wise p of all sites."""
    items, labels = np.repeat(np.arange(ITEMS), 2), np.tile([True, False], ITEMS)
    sites = neighbouring_sites(np.random.default_rng(seed))
    permuted = flip_groups(labels, items, PERMUTATIONS, seed)
    folds = nested_folds(labels, items, seed)
    probes = [probe_site(Samples.pooled(site), labels, permuted, folds) for site in sites]
    accuracy = np.array([correctness(probe.decisions, labels).mean() for probe in probes])
    null = np.stack([probe.null for probe in probes])
    return float(p_value(accuracy, null)[0]), float(max_statistic_p(accuracy, null).min())


def main() -> None:
    """Draw, and print both error rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--first-seed", type=int, default=0, help="other seeds are other data")
    parser.add_argument("--keep", type=Path, help="a folder that keeps draws, to resume")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.draws)
    with threadpool_limits(1):
        p = kept_draws(options.keep, "nested probes without signal", seeds, p_values)
    alarms = (p < SIGNIFICANCE).sum(axis=0)
    above = min(binomtest(int(n), len(p), SIGNIFICANCE, alternative="greater").pvalue for n in alarms)
    site, family = alarms / len(p)
    print(f"{len(p)} draws, p < 0.05: one site {site:.1%}, family {family:.1%}; more than 5 %? p = {above:.3f}")


if __name__ == "__main__":
    main()
