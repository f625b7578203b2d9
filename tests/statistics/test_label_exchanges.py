"""Label permutations that exchange whole groups."""

from math import factorial

import numpy as np
import pytest

from probe_kit.statistics.label_permutations import exchange_blocks, movable_share


def blocks_of(groups: int, size: int) -> dict[str, np.ndarray]:
    order = np.random.default_rng(0).permutation(groups * size)
    return {f"g{number}": order[number * size : (number + 1) * size] for number in range(groups)}


@pytest.mark.parametrize("groups", [2, 3, 5, 6])
def test_up_to_six_groups_make_every_exchange_but_none(groups: int) -> None:
    blocks = blocks_of(groups, 3)
    source = exchange_blocks(blocks, dict.fromkeys(blocks, "alike"), 10, 0)
    assert source.shape == (3 * groups, factorial(groups) - 1)
    assert len({column.tobytes() for column in source.T.copy()}) == source.shape[1]
    assert not (source == np.arange(3 * groups)[:, None]).all(axis=0).any()


def test_many_groups_make_as_many_different_exchanges_as_asked_for() -> None:
    blocks = blocks_of(12, 4)
    source = exchange_blocks(blocks, dict.fromkeys(blocks, "alike"), 500, 0)
    assert source.shape == (48, 500)
    assert len({column.tobytes() for column in source.T.copy()}) == 500
    again = exchange_blocks(blocks, dict.fromkeys(blocks, "alike"), 500, 0)
    assert (again == source).all()


def test_a_group_gives_its_labels_as_a_block_in_order_to_one_of_its_kind() -> None:
    blocks = {f"g{number}": np.arange(3) + 3 * number for number in range(8)} | {"long": np.arange(24, 29)}
    kinds = {name: (len(block), int(name[-1]) % 2 if name != "long" else 0) for name, block in blocks.items()}
    source = exchange_blocks(blocks, kinds, 100, 1)
    for column in source.T:
        donors = [column[block] for block in blocks.values()]
        assert (np.sort(np.concatenate(donors)) == np.arange(29)).all(), "every label is given once"
        for name, donor in zip(blocks, donors, strict=True):
            giver = next(own for own, block in blocks.items() if block[0] == donor[0])
            assert (donor == blocks[giver]).all()
            assert kinds[giver] == kinds[name]
    assert (source[24:] == np.arange(24, 29)[:, None]).all()
    assert movable_share(blocks, kinds) == 24 / 29


def test_groups_without_another_of_their_kind_make_no_exchange() -> None:
    blocks = blocks_of(4, 2)
    assert exchange_blocks(blocks, {name: name for name in blocks}, 50, 0).shape == (8, 0)
    assert movable_share(blocks, {name: name for name in blocks}) == 0
