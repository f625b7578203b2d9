"""The smallest set that keeps an effect, against effects that are written down."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from probe_kit.intervene.patching.sets import MOST_SINGLY, find_minimal_set

Cells = tuple[int, ...]


def of_each(effect: Callable[[Cells], float]) -> Callable[[Sequence[Cells]], list[float]]:
    return lambda sets: [effect(cells) for cells in sets]


def majority(cells: Cells) -> float:
    """Of 2, 5 and 7."""
    return float(len({2, 5, 7} & set(cells)) >= 2)


def both(cells: Cells) -> float:
    """3 with 4; each alone does nothing."""
    return float({3, 4} <= set(cells))


def either(cells: Cells) -> float:
    """Two copies."""
    return float(bool({1, 6} & set(cells)))


def one(cells: Cells) -> float:
    return float(8 in cells)


@pytest.mark.parametrize(("effect", "smallest"), [(majority, {5, 7}), (both, {3, 4}), (either, {6}), (one, {8})])
@pytest.mark.parametrize("count", [9, MOST_SINGLY + 34])
def test_no_cell_of_the_smallest_set_can_be_left_out(
    effect: Callable[[Cells], float], smallest: set[int], count: int
) -> None:
    found = find_minimal_set(range(count), of_each(effect))
    assert found.effect == effect(found.cells) == 1.0
    assert all(effect(tuple(set(found.cells) - {cell})) < 0.9 for cell in found.cells)
    assert len(found.cells) == len(smallest)
    if count <= MOST_SINGLY:
        assert set(found.cells) == smallest
        assert found.tried <= count * (count + 1) / 2


def test_halves_try_fewer_sets_than_single_cells() -> None:
    found = find_minimal_set(range(64), of_each(both))
    assert found.tried < 64 * 65 / 2 / 10


def test_what_costs_least_is_left_out_first() -> None:
    weights = np.array([0.02, 0.5, 0.03, 0.45])
    found = find_minimal_set(range(4), of_each(lambda cells: float(weights[list(cells)].sum())))
    assert found.cells == (1, 3)
    assert found.effect == pytest.approx(0.95)


def test_every_cell_stays_where_all_are_needed() -> None:
    found = find_minimal_set(range(5), of_each(lambda cells: float(len(cells) == 5)))
    assert found.cells == (0, 1, 2, 3, 4)
