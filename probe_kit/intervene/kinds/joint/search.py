"""The search for the smallest set of cells, in one half of a category's groups."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.kinds.joint.cells import Cell, CellsPatched, all_but
from probe_kit.intervene.kinds.joint.minimal_set import KEEP, find_minimal_set
from probe_kit.intervene.replay.conditions import CleanRun, Condition, ImagesSwapped, replay
from probe_kit.intervene.replay.per_step import evaluate_per_step
from probe_kit.intervene.replay.session import ReplayInput, ReplaySession
from probe_kit.intervene.store.settings import PER_STEP

WORTH_SEARCHING = 0.5
"""Effect of all cells together from which a smallest set is searched."""


@dataclass(frozen=True)
class Found:
    """What the search found in one category.

    cells: the smallest set; second: of the other cells, the smallest set that carries the effect as well; both may
    be empty. choosing: the groups that were searched. effect: of `cells`, in these. tried: how many sets.
    """

    choosing: tuple[str, ...]
    cells: tuple[Cell, ...] = ()
    second: tuple[Cell, ...] = ()
    effect: float = 0.0
    tried: int = 0

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "cells": list(map(str, self.cells)), "second": list(map(str, self.second)),
            "choosing": list(self.choosing), "effect": self.effect, "tried": self.tried,
        }  # fmt: skip


def choosing_half(groups: Sequence[str], seed: int) -> tuple[str, ...]:
    """One half of the groups, by a drawn order; the larger one of an odd number stays for scoring."""
    names = sorted(set(groups))
    order = np.random.default_rng(derive_seed("joint places", seed, *names)).permutation(len(names))
    return tuple(sorted(names[at] for at in order[: len(names) // 2]))


@dataclass(frozen=True)
class Search:
    """Plays sets of cells on the choosing half. readout: of the intervention."""

    session: ReplaySession
    cells: tuple[Cell, ...]
    source_sites: tuple[Site, ...]
    readout: str
    seed: int

    def run(self, inputs: Mapping[str, Sequence[ReplayInput]]) -> dict[str, Found]:
        """By category. inputs: all episodes of each."""
        return {category: self._of_category(list(own)) for category, own in inputs.items()}

    def _of_category(self, inputs: list[ReplayInput]) -> Found:
        choosing = choosing_half([one.group_id for one in inputs], self.seed)
        chosen = [one for one in inputs if one.group_id in choosing]
        if not chosen or self._effects(chosen, [self.cells])[0] < WORTH_SEARCHING:
            return Found(choosing)
        first = find_minimal_set(self.cells, lambda sets: self._effects(chosen, sets))
        rest = all_but(self.cells, first.cells)
        second: tuple[Cell, ...] = ()
        tried = first.tried
        if rest and self._effects(chosen, [rest])[0] >= KEEP * first.effect:
            other = find_minimal_set(rest, lambda sets: self._effects(chosen, sets))
            second, tried = other.cells, tried + other.tried
        return Found(choosing, first.cells, second, first.effect, tried)

    def _effects(self, inputs: Sequence[ReplayInput], sets: Sequence[tuple[Cell, ...]]) -> list[float]:
        """The share of the image swap's displacement that each set carries."""
        patched = [CellsPatched(str(number), {"": own}, self.source_sites) for number, own in enumerate(sets)]
        conditions: list[Condition] = [CleanRun(), ImagesSwapped(), *patched]
        play = evaluate_per_step if self.readout == PER_STEP else replay
        clean, swapped, *moved = play(self.session, inputs, conditions).displacement
        whole = swapped - clean
        total = float((whole**2).sum())
        return [float(((own - clean) * whole).sum()) / total if total else 0.0 for own in moved]
