import numpy as np
import pytest

from probe_kit.suite.generators.drawing.palette import COLORS, background_for, jittered


@pytest.mark.parametrize("name", ["black", "white", "gray"])
def test_a_colour_without_hue_stays_without_hue(name: str) -> None:
    rng = np.random.default_rng(0)
    assert all(len(set(jittered(COLORS[name], rng))) == 1 for _ in range(200))


def test_a_shade_stays_nearest_to_its_own_name() -> None:
    rng = np.random.default_rng(0)
    terms = np.array(list(COLORS.values()), np.float64)
    for number, color in enumerate(COLORS.values()):
        shades = np.array([jittered(color, rng) for _ in range(200)])
        nearest = np.linalg.norm(shades[:, None] - terms, axis=2).argmin(axis=1)
        assert (nearest == number).all()


def test_shades_differ() -> None:
    rng = np.random.default_rng(0)
    assert len({jittered(COLORS["red"], rng) for _ in range(100)}) > 80


def test_backgrounds_are_pale_whatever_the_ink() -> None:
    rng = np.random.default_rng(0)
    for ink in COLORS.values():
        backgrounds = np.array([background_for(ink, rng) for _ in range(100)])
        assert backgrounds.min() >= 150 - 12
        assert np.ptp(backgrounds, axis=1).max() <= 2 * 12
