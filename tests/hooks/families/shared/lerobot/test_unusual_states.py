"""Which recorded states lie far from a checkpoint's statistics, in every kind of units."""

import numpy as np
import pytest

from probe_kit.hooks.families.molmoact2.packing import JointFrame, SteppedUnits
from probe_kit.hooks.families.shared.lerobot.normaliser import Bounds, Normaliser, Units

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 0.5], np.float32)
INSIDE, BELOW, ABOVE = (
    np.array([row], np.float32) for row in ((0.9, 0.5), (-1.1, 0.2), (0.0, 0.6))
)  # fmt: skip
NONE = np.zeros(2, bool)
BOUNDED: dict[str, Units] = {
    "MIN_MAX": Normaliser("MIN_MAX", LOW, HIGH, 1e-8, "file"),
    "QUANTILES": Normaliser("QUANTILES", LOW, HIGH, 1e-8, "file"),
    "clipped": Bounds(LOW, HIGH, "file"),
    "clamped": SteppedUnits(Normaliser("QUANTILES", LOW, HIGH, 1e-8, "file"), NONE, True, NONE),
}


@pytest.mark.parametrize("name", BOUNDED)
def test_values_outside_the_bounds_are_unusual_also_where_the_network_reads_them_clipped(name: str) -> None:
    units = BOUNDED[name]
    assert units.unusual(INSIDE).tolist() == [[False, False]]
    assert units.unusual(BELOW).tolist() == [[True, False]]
    assert units.unusual(ABOVE).tolist() == [[False, True]]


def test_more_than_five_deviations_from_the_mean_are_unusual() -> None:
    units = Normaliser("MEAN_STD", LOW, HIGH, 1e-8, "file")
    values = np.array([[3.9, 2.4], [4.1, -2.6]], np.float32)
    assert units.unusual(values).tolist() == [[False, False], [True, True]]


def test_numbers_without_statistics_are_never_unusual() -> None:
    nothing = np.zeros(0, np.float32)
    assert not Normaliser("IDENTITY", nothing, nothing, 0.0, "file").unusual(1e9 * BELOW).any()
    masked = SteppedUnits(Normaliser("MIN_MAX", LOW, HIGH, 1e-8, "file"), np.array([True, False]), True, NONE)
    assert masked.unusual(BELOW).tolist() == [[False, False]]


def test_recorded_joints_are_compared_in_the_frame_of_the_statistics() -> None:
    frame = JointFrame(np.array([-1], np.float32), np.array([2], np.float32))
    units = SteppedUnits(Normaliser("MIN_MAX", LOW, HIGH, 1e-8, "file"), NONE, True, NONE, frame)
    values = np.array([[2.0, 0.2], [0.0, 0.2]], np.float32)
    assert units.unusual(values).tolist() == [[False, False], [True, False]]
    np.testing.assert_allclose(units.restore(units.normalise(values[:1])), values[:1])
