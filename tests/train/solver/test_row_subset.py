import numpy as np
import pytest

from probe_kit.train.solver import row_subset as rows
from probe_kit.train.solver.row_subset import RowSubset, blocks_of

MATRIX = np.arange(20.0).reshape(10, 2)


def test_choosing_again_chooses_among_the_chosen_and_copies_nothing() -> None:
    some = RowSubset.all(MATRIX)[np.array([7, 3, 5])][np.array([2, 0])]
    assert some.matrix is MATRIX
    assert some.shape == (2, 2)
    assert some.read().tolist() == np.asarray(some).tolist() == [[10, 11], [14, 15]]


def test_blocks_are_all_rows_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "ROWS_PER_BLOCK", 4)
    chosen = RowSubset.all(MATRIX)[np.array([9, 8, 7, 6, 5, 0])]
    blocks = list(blocks_of(chosen))
    assert [len(block) for block in blocks] == [4, 2]
    assert np.concatenate(blocks).tolist() == chosen.read().tolist()
    assert next(blocks_of(MATRIX)) is MATRIX


def test_rows_on_a_torch_device_are_the_same_rows() -> None:
    pytest.importorskip("torch")
    chosen = RowSubset.all(MATRIX)[np.array([4, 1])]
    assert np.asarray(chosen.to("cpu")).tolist() == np.asarray(chosen).tolist()
