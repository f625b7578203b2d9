import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.train.solver.backend import array_namespace, check_device, to_device, to_numpy


def test_numpy_arrays_stay_where_they_are_without_a_device() -> None:
    array = np.ones(3)
    assert to_numpy(to_device(array, None)) is array
    assert array_namespace(array) is np


def test_tensors_come_back_as_the_same_numbers() -> None:
    torch = pytest.importorskip("torch")
    tensor = to_device(np.arange(3.0), "cpu")
    assert array_namespace(tensor) is torch
    assert tensor.dtype == torch.float64
    assert to_numpy(tensor).tolist() == [0, 1, 2]


def test_a_device_that_is_not_there_says_so() -> None:
    pytest.importorskip("torch")
    check_device(None)
    check_device("cpu")
    with pytest.raises(UsageError, match="device 'abacus' cannot be used"):
        check_device("abacus")
