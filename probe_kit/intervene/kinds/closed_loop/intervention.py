"""Closed loop: the episode is really played again, with the change made at every inference.

What the first inference would do is a forecast. Here the cube lands somewhere, and the run's own outcomes are what
it is held against: the same scene, the same seeds, and a dose of zero that must give every one of them again.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.env.scoring.rules import DEFAULT_RULE
from probe_kit.errors import UsageError
from probe_kit.extract.store.run import Run
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.patching import Kept, Ledger, Tokens, patched
from probe_kit.intervene.edits.pooled_directions import MEAN_DIFFERENCE
from probe_kit.intervene.edits.sites import ALL, Place, places, token_mask
from probe_kit.intervene.kinds.interchange.intervention import NONE, TakenOver, along, needed
from probe_kit.intervene.replay.conditions import Condition, Exchanged, Intervention, Played, Replayed, Turn
from probe_kit.intervene.replay.image_tokens import TILES
from probe_kit.intervene.replay.session import Bench
from probe_kit.intervene.replay.token_directions import Bases, bases_of, check_direction
from probe_kit.intervene.store.answers import PLAIN
from probe_kit.intervene.store.settings import CHUNK, items_of

CELL = "|"
KIND = "closed-loop"


@dataclass(frozen=True, kw_only=True)
class ClosedLoop(Intervention):
    """Interchange at a few cells, carried out: dose zero, exchanged pictures, every cell, and its controls.

    cells: `PLACE|ROLE`, such as `backbone.02|image`; see `best_cells`. direction: as of an `Interchange`; along it
    a cell is taken over as well, beside `controls` random ones of the data's own covariance, where a place is one
    site and the role no tile; `none` for neither. The tokens of every cell are also taken over whole.
    """

    cells: tuple[str, ...]
    direction: str = f"{MEAN_DIFFERENCE}:1"
    controls: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != CHUNK:
            raise UsageError("a closed loop is read where the cube ends; leave --readout out")
        if not self.cells or any(cell.count(CELL) != 1 for cell in self.cells):
            raise UsageError(f"cells are {self.cells}; expected PLACE|ROLE, such as backbone.02|image")
        if self.direction != NONE:
            check_direction(self.direction)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or --controls 0")

    @property
    def kind(self) -> str:
        """`closed-loop`."""
        return KIND

    @property
    def needs(self) -> tuple[InterventionKind, ...]:
        """Edits; and a memory, where one of its places is."""
        sites, roles = zip(*map(self._split, self.cells), strict=True)
        return needed(sites, roles)

    @property
    def learns(self) -> bool:
        """Where its direction is of tokens."""
        return ":" in self.direction

    def own_settings(self) -> dict[str, Any]:
        """Where and along what; it is read where the cube ends."""
        return {
            "readout": "episode", "cells": list(self.cells), "direction": self.direction,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def chosen(self, run: Run) -> tuple[str, ...]:
        """Its categories. Raises UsageError for outcomes by another rule than they were recorded by."""
        if run.rule != DEFAULT_RULE:
            raise UsageError(
                f"{run.location} is read by the rule {run.rule!r}; a closed loop repeats outcomes as they were "
                f"recorded: open the run without another rule ({DEFAULT_RULE})"
            )
        return super().chosen(run)

    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """Dose zero, exchanged pictures, and every cell. Raises UnknownSiteError, NoProbesError."""
        split = [self._split(cell) for cell in self.cells]
        tried = [(place, role) for pattern, role in split for place in places(pattern, bench.policy)]
        donors = tuple(dict.fromkeys(site for place, _ in tried for site in place.sites))
        bases = self._bases(bench, tried)
        found: list[Condition] = [DoseZero(donors), Exchanged()]
        for place, role in tried:
            found.append(TakenOver(place, role, donors))
            if (place, role) in bases:
                found += along(self.direction, bases[place, role], place, role, donors)
        return found

    def play(self, bench: Bench, item: str, conditions: Sequence[Condition]) -> Replayed:
        """The item's episodes, each under every condition, from its first step to its last."""
        from probe_kit.intervene.replay.rollout import play

        return play(bench, bench.questions(item), conditions)

    def _bases(self, bench: Bench, tried: Sequence[tuple[Place, str]]) -> Mapping[tuple[Place, str], Bases]:
        """Of the cells that have directions."""
        wanted: dict[Place, list[str]] = {}
        for place, role in tried:
            if self.direction != NONE and len(place.sites) == 1 and role not in TILES:
                wanted.setdefault(place, []).append(role)
        items = items_of(bench.run, replace(self, items=None))
        return bases_of(bench, items, wanted, self.direction, self.controls, self.seed)

    @staticmethod
    def _split(cell: str) -> tuple[str, str]:
        place, _, role = cell.partition(CELL)
        return place, role


@dataclass(frozen=True)
class DoseZero:
    """As the run made it, with every site that any condition changes written back as it was."""

    sites: tuple[Site, ...]
    name: str = PLAIN

    def play(self, turn: Turn) -> Played:
        """Hooks fire, and nothing moves."""
        bench, seen = turn.bench, turn.question.seen
        with ExitStack() as stack:
            ledgers = [
                stack.enter_context(
                    patched(
                        bench.policy,
                        [site for site in self.sites if site.stream == stream],
                        Tokens.of(token_mask(bench.policy, seen, stream, ALL), bench.policy.card.device),
                        Kept(),
                    )
                )
                for stream in dict.fromkeys(site.stream for site in self.sites)
            ]
            chunk = bench.act(seen, turn.question.seed)
        return Played(chunk, Ledger.sum(ledgers))
