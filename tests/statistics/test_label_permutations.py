"""Label permutations that exchange whole groups."""

from math import factorial

import numpy as np
import pytest

from probe_kit.statistics.label_permutations import (
    exchange_blocks,
    exchange_groups,
    flip_groups,
    flip_items,
    max_statistic_p,
    movable_share,
    p_value,
    permutations_for,
    shortage,
    smallest_p,
)
from probe_kit.statistics.significance import SIGNIFICANCE

ITEMS = np.repeat(np.arange(200), 2)
LAYOUTS = np.tile(["original", "swapped"], 200)
LABELS = np.tile([True, False], 200)


def test_flipping_keeps_the_two_layouts_of_an_item_opposite() -> None:
    flipped = flip_items(LABELS, ITEMS, 50, seed=0)
    assert (flipped[0::2] != flipped[1::2]).all()
    assert 0.45 < (flipped != LABELS[:, None]).mean() < 0.55


def test_exchanging_keeps_the_class_share_of_each_layout() -> None:
    labels = np.random.default_rng(0).random(400) < np.where(LAYOUTS == "original", 0.9, 0.2)
    exchanged = exchange_groups(labels, ITEMS // 2, ITEMS, LAYOUTS, 50, seed=0)
    for layout in ("original", "swapped"):
        assert (exchanged[layout == LAYOUTS].mean(axis=0) == labels[layout == LAYOUTS].mean()).all()
    assert (exchanged != labels[:, None]).any(axis=0).all()


def test_a_flip_takes_the_whole_group_and_the_twins_of_an_item_with_it() -> None:
    flipped = flip_groups(LABELS, ITEMS // 2, 50, seed=0) != LABELS[:, None]
    assert (np.ptp(flipped.reshape(100, 4, 50).astype(int), axis=1) == 0).all()
    assert 0.4 < flipped.mean() < 0.6


def test_missing_episodes_leave_the_classes_as_large_as_they_are() -> None:
    """A null that restores balance would call a probe significant that only names the larger class."""
    present = np.random.default_rng(0).random(400) < np.where(LABELS, 1.0, 0.6)
    for count in (400, 40):  # groups of four: drawn, and with 10 groups enumerated
        labels, groups = LABELS[:count][present[:count]], (ITEMS // 2)[:count][present[:count]]
        permuted = flip_groups(labels, groups, 50, seed=0)
        assert permuted.shape[1] >= 7
        assert (permuted.sum(axis=0) == labels.sum()).all()
        assert (permuted != labels[:, None]).any()


def test_few_groups_are_enumerated_without_the_real_labels_and_without_mirror_images() -> None:
    labels, groups = LABELS[:24], np.repeat(np.arange(6), 4)
    permuted = flip_groups(labels, groups, 7, seed=0)
    assert permuted.shape == (24, 2**5 - 1)
    distinct = {tuple(column) for column in permuted.T}
    assert len(distinct) == 31
    assert tuple(labels) not in distinct
    assert not distinct & {tuple(~column) for column in permuted.T}
    assert smallest_p(31) == 1 / 32
    assert flip_groups(labels, groups, 0, seed=0).shape == (24, 0)


def test_groups_of_another_shape_exchange_nothing() -> None:
    groups = np.array([0, 0, 0, 0, 1, 1])
    items, layouts = np.array([0, 0, 1, 1, 2, 2]), np.array(["original", "swapped"] * 3)
    labels = np.array([True, True, True, True, False, False])
    assert (exchange_groups(labels, groups, items, layouts, 20, seed=0) == labels[:, None]).all()


def test_items_with_one_episode_exchange_only_among_themselves() -> None:
    items, layouts = np.array([0, 0, 1, 1, 2, 3]), np.array(["original", "swapped"] * 2 + ["original"] * 2)
    labels = np.array([True, True, True, True, False, False])
    exchanged = exchange_groups(labels, items, items, layouts, 20, seed=0)
    assert (exchanged == labels[:, None]).all()


def test_the_same_seed_gives_the_same_permuted_labels() -> None:
    assert (flip_items(LABELS, ITEMS, 5, seed=3) == flip_items(LABELS, ITEMS, 5, seed=3)).all()


def test_p_counts_the_real_labels_among_the_draws() -> None:
    null = np.array([[0.5, 0.6, 0.7], [0.4, 0.5, 0.5]])
    assert p_value(np.array([0.65, 0.9]), null).tolist() == [2 / 4, 1 / 4]


def test_family_wise_p_compares_with_the_best_site() -> None:
    null = np.array([[0.5, 0.6, 0.5], [0.4, 0.5, 0.7]])
    assert max_statistic_p(np.array([0.65, 0.55]), null).tolist() == [2 / 4, 3 / 4]


def test_p_is_missing_without_permuted_labels() -> None:
    assert np.isnan(p_value(np.array([0.9]), np.empty((1, 0)))).all()
    assert np.isnan(max_statistic_p(np.array([0.9]), np.empty((1, 0)))).all()


@pytest.mark.parametrize("tests", [1, 2, 3, 7, 12, 40])
def test_one_permutation_fewer_than_needed_can_show_nothing_after_a_correction(tests: int) -> None:
    needed = permutations_for(tests)
    assert tests * smallest_p(needed) < SIGNIFICANCE <= tests * smallest_p(needed - 1) + 1e-12
    assert shortage(smallest_p(needed), needed, tests) == ""
    assert shortage(smallest_p(needed - 1), needed - 1, tests) == "permutations"


def test_groups_are_too_few_where_they_allow_fewer_permutations_than_were_asked_for() -> None:
    assert shortage(smallest_p(15), 200) == "groups"
    assert shortage(smallest_p(15), 15) == "permutations"
    assert shortage(smallest_p(0), 0) == "permutations"


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
            giver = next(group for group, block in blocks.items() if block[0] == donor[0])
            assert (donor == blocks[giver]).all()
            assert kinds[giver] == kinds[name]
    assert (source[24:] == np.arange(24, 29)[:, None]).all()
    assert movable_share(blocks, kinds) == 24 / 29


def test_groups_without_another_of_their_kind_make_no_exchange() -> None:
    blocks = blocks_of(4, 2)
    assert exchange_blocks(blocks, {name: name for name in blocks}, 50, 0).shape == (8, 0)
    assert movable_share(blocks, {name: name for name in blocks}) == 0
