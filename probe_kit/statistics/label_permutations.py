"""Label permutations of whole groups, and the p-values that they give.

A label permutation treats a group of items as a whole, because items that share a picture share features. Flipped
one by one, they would look more independent than they are. It keeps the number of episodes of each class, because
a probe that names the larger class is no signal. Under "the answer is not encoded", every such label permutation
is as likely as the real labels. That makes the p-values exact.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from itertools import groupby, islice, permutations, product
from math import factorial, floor, prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.significance import SIGNIFICANCE


def flip_items(labels: NDArray[np.bool_], items: ArrayLike, count: int, seed: int) -> NDArray[np.bool_]:
    """Draw `count` label permutations (E, count) that flip all labels of a random half of the items.

    They suit the correct side, which a suite draws freely.

    Args:
        labels: (E,) class of every episode.
        items: (E,) item of every episode.
        count: Number of permutations.
        seed: Seed of the draws.
    """
    names, item_of = np.unique(np.asarray(items), return_inverse=True)
    flips = np.random.default_rng(seed).random((names.size, count)) < 0.5
    flipped: NDArray[np.bool_] = labels[:, None] ^ flips[item_of]
    return flipped


ENUMERATED_BELOW = 12
"""Number of groups below which all possible label permutations are made.

They are 1,023 at most where all groups are balanced.
"""


def flip_groups(labels: NDArray[np.bool_], groups: ArrayLike, count: int, seed: int) -> NDArray[np.bool_]:
    """Draw about `count` permutations (E, P) that flip all labels of some groups and keep both classes' sizes.

    A group with as many episodes of either class is flipped or not, freely. The others exchange their signs among
    those with the same surplus. The permutations suit the correct side, which a suite draws freely.

    With fewer than ENUMERATED_BELOW groups, these are all permutations but the real one, in an order drawn from
    `seed`. None of them only mirrors another: a probe of mirrored labels is as accurate.

    Args:
        labels: (E,) class of every episode.
        groups: (E,) group of every episode.
        count: Number of permutations where they are drawn; 0 for none.
        seed: Seed of the draws, or of the order.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    surplus = 2 * np.bincount(group_of[labels], minlength=names.size) - np.bincount(group_of)
    generator = np.random.default_rng(seed)
    if count == 0:
        flips = np.zeros((names.size, 0), bool)
    elif names.size < ENUMERATED_BELOW:
        flips = generator.permutation(_every_flip(surplus), axis=1)
    else:
        flips = generator.random((names.size, count)) < 0.5
        for size in np.unique(np.abs(surplus[surplus != 0])):  # groups of one surplus exchange their signs
            alike = np.flatnonzero(np.abs(surplus) == size)
            signs = np.repeat(surplus[alike, None] > 0, count, axis=1)
            flips[alike] = generator.permuted(signs, axis=0) != signs
    flipped: NDArray[np.bool_] = labels[:, None] ^ flips[group_of]
    return flipped


def _every_flip(surplus: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the flips (G, P) that keep the sum of every surplus, without the one that flips nothing.

    Of two flips that mirror each other, one is returned.
    """
    numbers = np.arange(2**surplus.size)
    flips = (numbers >> np.arange(surplus.size)[:, None]) & 1 == 1
    keeps = np.ones(numbers.size, bool)
    mirrored = True
    for size in np.unique(np.abs(surplus[surplus != 0])):
        alike = np.abs(surplus) == size
        keeps &= (np.where(flips[alike], -1, 1) * surplus[alike, None]).sum(axis=0) == surplus[alike].sum()
        mirrored &= bool(surplus[alike].sum() == 0)
    if mirrored:
        keeps &= ~flips[0]  # of every two the one that leaves the first group as it is
    keeps[0] = False  # which flips nothing
    allowed: NDArray[np.bool_] = flips[:, keeps]
    return allowed


def exchange_groups(
    labels: NDArray[np.bool_], groups: ArrayLike, items: ArrayLike, layouts: ArrayLike, count: int, seed: int
) -> NDArray[np.bool_]:
    """Draw `count` label permutations (E, count) in which groups exchange their labels, layout by layout.

    Only groups whose items are present in the same layouts are exchanged. This keeps the share of every class, and
    so any side preference: it suits the chosen side.

    Args:
        labels: (E,) class of every episode.
        groups: (E,) group of every episode.
        items: (E,) item of every episode.
        layouts: (E,) layout of every episode.
        count: Number of permutations.
        seed: Seed of the draws.
    """
    generator = np.random.default_rng(seed)
    exchanged = np.repeat(labels[:, None], count, axis=1)
    shaped = sorted(_shapes(groups, items, layouts), key=lambda shaped: shaped[0])
    for _, alike in groupby(shaped, key=lambda shaped: shaped[0]):
        rows = np.array([episodes for _, episodes in alike])
        for draw in range(count):
            exchanged[rows, draw] = labels[rows[generator.permutation(len(rows))]]
    return exchanged


Shape = tuple[tuple[str, ...], ...]
"""The layouts in which each item of a group is present."""


def _shapes(groups: ArrayLike, items: ArrayLike, layouts: ArrayLike) -> list[tuple[Shape, list[int]]]:
    """Return the shape and the episodes of every group, the episodes in the order of the shape."""
    members: dict[str, dict[str, dict[str, int]]] = {}
    columns = (np.asarray(column).astype(str).tolist() for column in (groups, items, layouts))
    for row, (group, item, layout) in enumerate(zip(*columns, strict=True)):
        members.setdefault(group, {}).setdefault(item, {})[layout] = row
    shapes = []
    for of_group in members.values():
        ordered = sorted((tuple(sorted(rows)), item) for item, rows in of_group.items())
        episodes = [of_group[item][layout] for present, item in ordered for layout in present]
        shapes.append((tuple(present for present, _ in ordered), episodes))
    return shapes


Positions = NDArray[np.intp]

ENUMERATED = factorial(6)
"""Number of exchanges, those of six groups, up to which all are made."""


def exchange_blocks(
    blocks: Mapping[str, Positions], kinds: Mapping[str, Hashable], count: int, seed: int
) -> Positions:
    """Draw P exchanges of groups: (n, P) the sample whose label each of n samples has, never the real labelling.

    With up to six groups, or where there are no more than `count` exchanges, these are all exchanges. Else they
    are `count` different ones.

    Args:
        blocks: By group, its samples in an order that corresponds between groups; together 0 … n − 1.
        kinds: By group, what it must have in common with the groups with which it exchanges, so also the number of
            samples.
        count: Number of exchanges where they are drawn; 0 for none.
        seed: Seed of the draws.
    """
    size = sum(len(block) for block in blocks.values())
    families = _families(blocks, kinds)
    orders: Iterator[tuple[tuple[int, ...], ...]]
    possible = prod(factorial(len(family)) for family in families)
    if count == 0 or possible == 1:
        return np.empty((size, 0), np.intp)
    if possible <= max(ENUMERATED, count + 1):
        orders = islice(product(*(permutations(range(len(family))) for family in families)), 1, None)
    else:
        orders = _draw_orders([len(family) for family in families], count, np.random.default_rng(seed))
    columns = []
    for order in orders:
        source = np.arange(size)
        for family, family_order in zip(families, order, strict=True):
            source[family.ravel()] = family[list(family_order)].ravel()
        columns.append(source)
    return np.stack(columns, axis=1)


def movable_share(blocks: Mapping[str, Positions], kinds: Mapping[str, Hashable]) -> float:
    """Return the share of the samples whose group has another one of its kind to exchange with."""
    moving = sum(family.size for family in _families(blocks, kinds) if len(family) > 1)
    return moving / sum(len(block) for block in blocks.values())


def _families(blocks: Mapping[str, Positions], kinds: Mapping[str, Hashable]) -> list[Positions]:
    """Return, for every kind, the samples of its groups (groups, samples)."""
    families: dict[Hashable, list[Positions]] = {}
    for group, block in blocks.items():
        families.setdefault(kinds[group], []).append(block)
    return [np.stack(family) for family in families.values()]


def _draw_orders(
    sizes: Sequence[int], count: int, generator: np.random.Generator
) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Draw `count` different orders of families, none of them the identity; there are more than `count`."""
    drawn = {tuple(tuple(range(size)) for size in sizes)}
    while len(drawn) <= count:
        order = tuple(tuple(generator.permutation(size).tolist()) for size in sizes)
        if order not in drawn:
            drawn.add(order)
            yield order


def possible_flips(groups: int) -> int:
    """Return how many permutations `flip_groups` makes of groups that have as many episodes of either class.

    This holds below ENUMERATED_BELOW groups; with more groups, `flip_groups` draws the requested number.
    """
    return 2 ** (groups - 1) - 1 if groups else 0


def smallest_p(permutations: int) -> float:
    """Return the smallest p-value that so many label permutations can give; 1 without any."""
    return 1 / (1 + permutations)


def permutations_for(tests: int = 1) -> int:
    """Return the fewest label permutations with which p can be below the level: 19 give 1/20, which is not.

    Args:
        tests: Number of tests that p is corrected for.
    """
    return floor(tests / SIGNIFICANCE + 1e-9)  # 0.05 is not exact in binary


def shortage(least_p: float, permutations: int, tests: int = 1) -> Literal["", "permutations", "groups"]:
    """Return what is too few for any p below the level; empty where there is enough.

    Args:
        least_p: The smallest p that is possible.
        permutations: Number of permutations that was requested. Where so many would give a smaller p, the groups
            are too few.
        tests: Number of tests that p is corrected for.
    """
    if round(tests * least_p, 12) < SIGNIFICANCE:
        return ""
    # Equal up to rounding: as many permutations were made as were asked for.
    return "groups" if least_p > 1.001 * smallest_p(permutations) else "permutations"


def max_statistic_p(observed: NDArray[np.float64], null: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the p-value of every site (S,) against the best of all sites of each null curve.

    It is the share of null curves whose maximum is as high as the site. The probability that any site without
    signal falls below 0.05 is then at most 0.05. NaN without a null.
    """
    return p_value(observed, null.max(axis=0, keepdims=True) if observed.size else null)


def p_value(observed: NDArray[np.float64], null: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (S,) the share of draws in `null`, (S, P) or (1, P), that are as high as `observed` (S,).

    The observation counts as one of the draws. This is the p of every site on its own. NaN without a null.
    """
    draws = null.shape[1]
    if draws == 0:
        return np.full(observed.shape, np.nan)
    # Scores are shares of episodes; the margin makes equal shares equal whatever the summation order.
    as_good = (null >= observed[:, None] - 1e-12).sum(axis=1)
    p: NDArray[np.float64] = (1 + as_good) / (1 + draws)
    return p
