import numpy as np
import pytest

from probe_kit.suite.generators.drawing.canvas import Points
from probe_kit.suite.generators.drawing.outlines import OUTLINES


def area(points: Points) -> float:
    x, y = points.T
    return abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


def test_there_are_fifteen_outlines() -> None:
    assert len(OUTLINES) == 15


@pytest.mark.parametrize("name", list(OUTLINES))
def test_all_outlines_have_the_same_area_and_are_centred(name: str) -> None:
    points = OUTLINES[name]
    assert area(points) == pytest.approx(area(OUTLINES["square"]))
    np.testing.assert_allclose(points.min(axis=0), -points.max(axis=0), atol=1e-9)


def test_outlines_cannot_be_changed_by_accident() -> None:
    with pytest.raises(ValueError, match="read-only"):
        OUTLINES["star"][0] = 0
