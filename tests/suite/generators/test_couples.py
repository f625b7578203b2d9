from collections import Counter
from itertools import combinations, islice

import numpy as np

from probe_kit.suite.generators import Concept
from probe_kit.suite.generators.couples import visiting_order

CONCEPTS = [Concept(name, name) for name in "abcdefg"]
PAIRS = tuple(combinations(CONCEPTS, 2))


def visited(count: int, seed: int = 0) -> list[tuple[str, str]]:
    order = visiting_order(PAIRS, np.random.default_rng(seed))
    return [(left.name, right.name) for left, right in islice(order, count)]


def test_all_pairs_are_visited_before_any_is_visited_again() -> None:
    rounds = visited(2 * len(PAIRS))
    for once in (rounds[: len(PAIRS)], rounds[len(PAIRS) :]):
        assert {frozenset(pair) for pair in once} == {frozenset((a.name, b.name)) for a, b in PAIRS}


def test_the_second_round_has_another_order() -> None:
    rounds = visited(2 * len(PAIRS))
    assert [set(pair) for pair in rounds[: len(PAIRS)]] != [set(pair) for pair in rounds[len(PAIRS) :]]


def test_at_every_point_each_concept_has_lain_left_about_as_often_as_right() -> None:
    lean: Counter[str] = Counter()
    for left, right in visited(500):
        lean.update({left: 1, right: -1})
        assert max(map(abs, lean.values())) <= 3


def test_the_order_depends_on_the_seed() -> None:
    assert visited(20, seed=0) != visited(20, seed=1)
