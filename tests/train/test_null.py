"""Calibration of the p-values, on real nested probes of features without signal."""

import numpy as np
import pytest
from scipy.stats import binom

from probe_kit.statistics.label_permutations import flip_groups, max_statistic_p, pointwise_p
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.crossval.site_probe import probe_site
from probe_kit.train.crossval.task_scores import correctness
from probe_kit.train.data.samples import Samples

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
    return pointwise_p(accuracy, null), max_statistic_p(accuracy, null)


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
