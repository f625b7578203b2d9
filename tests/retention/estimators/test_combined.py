"""Retention between its bounds, on curves of which the truth is known."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from probe_kit.hooks import Site
from probe_kit.retention.estimators.combined import PEAK_SHARE, area_fit, bounded_fit, smoothing
from probe_kit.retention.estimators.cross_fit import GroupScores, crossfit
from probe_kit.retention.estimators.retention import retention_interval

BACKBONE = [Site("backbone", layer) for layer in range(7)]
EXPERT = [Site("expert", layer, iteration=step) for step in range(3) for layer in range(6)]
PROTOTYPE = Path(__file__).parents[4] / "shared/design/prototypes/bounded_retention.py"


def scores(sites: int, above: np.ndarray | float, seed: int, groups: int = 75) -> GroupScores:
    generator = np.random.default_rng(seed)
    share = np.broadcast_to(0.5 + np.asarray(above, float), (sites,))[:, None]
    return GroupScores(generator.binomial(4, np.repeat(share, groups, axis=1)).astype(float), np.full(groups, 4.0))


def test_smoothing_is_a_quarter_of_each_neighbour_and_an_edge_stands_for_its_own() -> None:
    weights = smoothing(BACKBONE)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights[3, 2:5].tolist() == [0.25, 0.5, 0.25]
    assert weights[0, :2].tolist() == [0.75, 0.25]
    both = smoothing(EXPERT)
    np.testing.assert_allclose(both.sum(axis=1), 1)
    row = EXPERT.index(Site("expert", 2, iteration=1))
    assert both[row, EXPERT.index(Site("expert", 3, iteration=2))] == pytest.approx(1 / 16)
    assert both[row, row] == pytest.approx(1 / 4)


def test_other_quantities_are_no_neighbours() -> None:
    sites = [Site("backbone", 0), Site("backbone", 1, "mlp"), Site("backbone", 1)]
    assert smoothing(sites)[0].tolist() == [0.75, 0, 0.25]


def test_the_estimate_lies_between_the_crossfitted_and_the_plug_in_ratio_of_scores() -> None:
    backbone, expert = scores(7, 0.3, 0), scores(18, 0.1, 1)
    fit = bounded_fit(backbone, expert, (BACKBONE, EXPERT), 0.5, 0)
    guided = backbone.guided(smoothing(BACKBONE)), expert.guided(smoothing(EXPERT))
    low = crossfit(*guided, 0.5, 0)
    peak = expert.sums.sum(axis=1).max() / expert.sizes.sum() - 0.5
    assert low.expert < fit.expert < peak
    assert fit.expert == pytest.approx((1 - PEAK_SHARE) * low.expert + PEAK_SHARE * peak)
    np.testing.assert_array_equal(fit.covariance, low.covariance)
    assert fit.held_out.sum(axis=1) / fit.sizes.sum() - 0.5 == pytest.approx([fit.expert, fit.backbone])


@pytest.mark.skipif(not PROTOTYPE.exists(), reason="../shared with the prototype is absent")
def test_it_is_the_estimate_of_the_prototype() -> None:
    spec = importlib.util.spec_from_file_location("prototype", PROTOTYPE)
    assert spec is not None
    assert spec.loader is not None
    prototype = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prototype)
    backbone, expert = scores(7, 0.3, 2, 76), scores(18, 0.15, 3, 76)  # equal halves
    fit = bounded_fit(backbone, expert, (BACKBONE, EXPERT), 0.5, 5)
    ratio, low, high = prototype.retention(expert.sums.reshape(3, 6, -1), backbone.sums, backbone.sizes, seed=5)
    assert fit.expert / fit.backbone == pytest.approx(ratio)
    found = retention_interval(fit)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.08)  # other halvings


def test_area_is_the_ratio_of_means_and_needs_no_choice() -> None:
    fits = [area_fit(scores(7, 0.3, 2 * seed), scores(18, 0.15, 2 * seed + 1), 0.5) for seed in range(200)]
    assert np.mean([fit.expert / fit.backbone for fit in fits]) == pytest.approx(0.5, abs=0.01)
    covered = [(found := retention_interval(fit)).low <= 0.5 <= found.high for fit in fits]
    assert np.mean(covered) > 0.9


def test_a_stack_that_is_always_right_has_an_interval_with_a_width() -> None:
    perfect = GroupScores(np.full((7, 20), 4.0), np.full(20, 4.0))
    for fit in (area_fit(perfect, perfect, 0.5), bounded_fit(perfect, perfect, (BACKBONE, BACKBONE), 0.5, 0)):
        found = retention_interval(fit)
        assert fit.expert / fit.backbone == 1
        assert found.low < 0.95 < 1.05 < found.high
