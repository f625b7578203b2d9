"""Tokens are read by role: what stands at other positions of a row never gets out."""

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from probe_kit.runs.arrays import Rows, role_mask, token_blocks

TOKENS, WIDTH = 7, 3
SPANS = [
    [("image", 0, 2), ("language", 2, 5), ("padding", 5, 7)],
    [("padding", 0, 1), ("language", 1, 3), ("image", 3, 7)],
]
"""Spans of two episodes: role, first position and the one behind the last."""


def bfloat16(values: NDArray[np.float32]) -> NDArray[np.uint16]:
    """The upper half of the bits of float32."""
    return (values.view(np.uint32) >> 16).astype(np.uint16)


@pytest.fixture
def stored() -> tuple[Rows, NDArray[np.float32]]:
    """Three planned episodes of one call and two layers, of which 0 and 2 are committed; and their values.

    Whole numbers below 256 have an exact bfloat16. The first position of every episode is NaN, the last infinite.
    """
    values = np.arange(3 * 1 * 2 * TOKENS * WIDTH, dtype=np.float32).reshape(3, 1, 2, TOKENS, WIDTH) + 1
    values[..., 0, :], values[..., -1, :] = np.nan, np.inf
    array = zarr.create_array(zarr.storage.MemoryStore(), data=bfloat16(values))
    return Rows(array, [0, 2]), values[[0, 2]]


@pytest.mark.parametrize("block", [1, 2, 3, TOKENS, 100])
@pytest.mark.parametrize("role", ["language", "image", None])
def test_every_token_of_a_role_comes_once_and_zeros_stand_for_all_others(
    stored: tuple[Rows, NDArray[np.float32]], role: str | None, block: int
) -> None:
    rows, values = stored
    belongs = np.array(
        [
            [next(name for name, start, stop in spans if start <= at < stop) for at in range(TOKENS)]
            for spans in SPANS
        ]
    )
    expected = belongs != "padding" if role is None else belongs == role
    mask = role_mask(SPANS, TOKENS, role)
    np.testing.assert_array_equal(mask, expected)
    found = np.zeros((2, TOKENS, WIDTH), np.float32)
    for part in token_blocks(rows, (0, 1), mask, block):
        np.testing.assert_array_equal(part.mask, expected[:, part.start : part.start + block])
        found[:, part.start : part.start + block] += part.values
    np.testing.assert_array_equal(found, np.where(expected[..., None], values[:, 0, 1], 0))
