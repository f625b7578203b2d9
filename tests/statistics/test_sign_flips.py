"""Effects of many sites tested together."""

import numpy as np
import pytest

from probe_kit.statistics.sign_flips import max_t


def test_a_site_that_nothing_reads_stays_finite_and_says_nothing() -> None:
    items = np.repeat(np.arange(10), 2)
    t, p, p_fwe = max_t(np.stack([np.zeros(20), np.full(20, 0.1)]), items, items, 0)
    assert np.isfinite(t).all()
    assert t[0] == 0
    assert p[0] == 1.0
    assert p[1] == p_fwe[1] == pytest.approx(2.0**-10)


def test_the_sign_counts() -> None:
    items = np.arange(8)
    _, p, _ = max_t(np.stack([np.full(8, 0.1), np.full(8, -0.1)]), items, items, 0)
    assert p.tolist() == [2.0**-8, 1.0]


def test_items_of_a_group_turn_together() -> None:
    values, items = np.full((1, 12), 0.1), np.arange(12)
    _, p, _ = max_t(values, items, items % 3, 0)
    assert p[0] == 2.0**-3


def test_looking_at_more_sites_costs() -> None:
    draw = np.random.default_rng(0)
    items, values = np.arange(10), draw.normal(size=(1, 10)) + 0.6
    _, _, alone = max_t(values, items, items, 0)
    _, _, among = max_t(np.vstack([values, draw.normal(size=(20, 10))]), items, items, 0)
    assert among[0] > alone[0]


def test_no_world_without_effects_is_called_significant_too_often() -> None:
    """One-sided binomial test at 5 % over 200 worlds of 16 sites whose items share noise."""
    draw, items, found = np.random.default_rng(1), np.repeat(np.arange(14), 2), 0
    for world in range(200):
        values = draw.normal(size=(16, 28)) + draw.normal(size=(1, 28))
        found += bool((max_t(values, items, items, world)[2] < 0.05).any())
    assert found <= 15  # P(more | 200, 0.05) < 0.05
