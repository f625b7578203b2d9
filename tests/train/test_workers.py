from collections.abc import Iterator

import numpy as np

from probe_kit.hooks import Site
from probe_kit.train.permutation import flip_items
from probe_kit.train.probe import nested_folds
from probe_kit.train.problem import CategoryProblem
from probe_kit.train.samples import Samples
from probe_kit.train.workers import Key, probe_columns

ITEMS = np.repeat(np.arange(10), 2)
LABELS = np.tile([True, False], 10)
PROBLEM = CategoryProblem(
    rows=np.arange(20),
    labels=LABELS,
    items=ITEMS.astype(str),
    groups=ITEMS.astype(str),
    episodes=np.arange(20).astype(str),
    folds=nested_folds(LABELS, ITEMS, 0),
    relabellings=flip_items(LABELS, ITEMS, 3, 0),
    token_permutations=0,
)


def columns(read: list[Key]) -> Iterator[tuple[Key, Samples]]:
    for layer in range(6):
        key = ("mean", Site("backbone", layer))
        read.append(key)
        yield key, Samples.pooled(np.random.default_rng(layer).standard_normal((20, 4)).astype(np.float32))


def test_processes_give_the_same_numbers_as_this_one() -> None:
    alone = dict(probe_columns(columns([]), {"color": PROBLEM}, jobs=1))
    together = dict(probe_columns(columns([]), {"color": PROBLEM}, jobs=2))
    assert alone.keys() == together.keys()
    for key, probes in alone.items():
        np.testing.assert_array_equal(probes["color"].decisions, together[key]["color"].decisions)


def test_columns_are_read_only_when_they_are_needed() -> None:
    read: list[Key] = []
    probing = probe_columns(columns(read), {"color": PROBLEM}, jobs=1)
    next(probing)
    assert len(read) == 1
