"""The session of a run without sides: pairs of frames that differ in one input, read toward the donor's action.

A donor is another frame of another group. The source of a pair is the clean frame with one of the donor's inputs.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.extract.sources.inputs import PICTURE, Frame, draw_donors, hardly_changed, with_input
from probe_kit.hashing import derive_seed
from probe_kit.hooks.checkpoints.third_party import copied, while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.intervene.sessions.frames import Frames
from probe_kit.intervene.sessions.session import ReplaySession
from probe_kit.intervene.settings import PairChoice, PairRow
from probe_kit.intervene.spread import directions_of, spread_of
from probe_kit.runs import Run

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy

FRAMES = 4
"""Frames of an episode that are used if nothing is said."""


class ObservedSession(ReplaySession):
    """A policy and frames of recordings, or first observations of an environment.

    vary: the input that the source has of its donor. frames_each: of an episode. table: pairs of the user's own,
    by which donors are chosen. items: those whose clean actions are the unit of displacements.
    """

    def __init__(self, run: Run, policy: "Policy", frames: Frames, choice: PairChoice | None = None) -> None:
        """Raises UsageError for a varied input that no other group varies; see also `Frames.check_varied`."""
        super().__init__(run, policy)
        self.frames = frames
        self.vary, self.frames_each = PICTURE, FRAMES
        self.table: tuple[PairRow, ...] = ()
        self.items: Sequence[str] = tuple(dict.fromkeys(frame.item for frame in frames.index))
        self._ends: dict[tuple[int, int, str], tuple[Chunk, NDArray[np.float64]]] = {}
        self._spread = _state_spread(frames.index)
        if choice is not None:
            self.vary, self.frames_each = choice.varied, choice.frames or FRAMES
            self.table, self.items = choice.pairs, choice.items_in(run)
            self._check_vary()

    def close(self) -> None:
        """Close the environment."""
        self.frames.close()

    def pairs(self, item: str) -> list[Pair]:
        """Return the pairs of an item's frames; frames without a donor are left out."""
        pairs = []
        for frame, donor in self._donors(item):
            clean, other = frame.observation, donor.observation
            pairs.append(
                Pair(
                    clean=clean,
                    source=with_input(clean, self.vary, other),
                    donor=other,
                    donor_name=donor.name,
                    control=hardly_changed(clean, self.vary, self._spread),
                    seed=frame.seed,
                    group=frame.group,
                    item=item,
                    row=frame.row,
                    step=frame.number,
                    episode=frame.name if self.run.recorded else frame.episode,
                    category=frame.category,
                    stored=frame.stored,
                )
            )
        return pairs

    def _donors(self, item: str) -> list[tuple[Frame, Frame]]:
        """Return frames of an item with the donor of each: of the table, or drawn."""
        if self.table:
            return [(frame, donor) for frame, donor in self._tabled if frame.item == item]
        index = self.frames.index
        rows = [at for at, frame in enumerate(index) if frame.item == item]
        spaced = np.linspace(0, len(rows) - 1, min(self.frames_each, len(rows))).round().astype(int)
        donors = []
        for row in (rows[at] for at in np.unique(spaced)):
            # A draw of its own for every frame: items are replayed one by one, and resumed at any of them.
            rng = np.random.default_rng(derive_seed("donor", self.vary, index[row].name))
            donors += [(index[row], index[donor]) for _, donor in draw_donors(index, self.vary, rng, of=[row])]
        return donors

    @cached_property
    def _tabled(self) -> list[tuple[Frame, Frame]]:
        """Frames and donors of the user's own table, which `open_session` has checked."""
        by_name = self.frames.by_name
        return [(by_name[row[:2]], by_name[row[2:]]) for row in self.table]

    def _check_vary(self) -> None:
        """Raise UsageError for an input that no frame of another group varies."""
        if not any(self._donors(item) for item in self.items):
            raise UsageError(
                f"no frame of another group has another {self.vary}; extract more episodes, or choose another "
                "--vary"
            )

    # -- actions and readout -----------------------------------------------------------------------------

    def act(self, model_input: Given, seed: int) -> Chunk:
        """Return (chunk, D): one prediction in the checkpoint's own units, alone in its batch."""
        assert isinstance(model_input, Observation)
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.predict(copied([model_input]), [seed])[0], np.float32)

    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return how far a chunk lies toward the source's, in spreads of clean actions; 0 is the clean action."""
        clean, direction = self._end(pair)
        return float((chunk.astype(np.float64).ravel() - clean.astype(np.float64).ravel()) @ direction)

    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return the same up to a constant. Raises UsageError for a family whose gradients are in other units."""
        clean, direction = self._end(pair)
        assert isinstance(pair.clean, Observation)
        if not np.array_equal(clean, self.policy.act(copied([pair.clean]), [pair.seed])[0]):
            raise UsageError(
                f"gradients of {self.policy.card.family} are of an arm's actions, and these frames have "
                "predictions in other units. Patch exactly: --kind interchange"
            )
        return lambda actions: (actions.flatten() * actions.new_tensor(direction)).sum()

    def _end(self, pair: Pair) -> tuple[Chunk, NDArray[np.float64]]:
        """Return the clean chunk, and the direction (N,) that displacements of this pair are read along."""
        at = pair.row, pair.step, pair.donor_name  # a table may give a frame several donors
        if at not in self._ends:
            clean, source = self.act(pair.clean, pair.seed), self.act(pair.source, pair.seed)
            start, end = (chunk.astype(np.float64).ravel()[None] for chunk in (clean, source))
            (direction,), _ = directions_of(start, end, self.weights)
            self._ends[at] = clean, direction
        return self._ends[at]

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """Return (N,) 1 / spread² of every number of the clean actions, over all pairs of the items."""
        clean = [self.act(pair.clean, pair.seed).ravel() for item in self.items for pair in self.pairs(item)]
        return spread_of(np.array(clean))

    # -- words -------------------------------------------------------------------------------------------

    def has_other_instruction(self, item: str) -> bool:
        """Whether a frame of the item has a donor."""
        return bool(self._donors(item))

    def with_other_instruction(self, pair: Pair) -> Observation | None:
        """Return the source: a swap of the instruction varies just that."""
        return pair.source if isinstance(pair.source, Observation) else None


def _state_spread(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Return (D,) the standard deviation of every number of the state, 1 where it has none."""
    spread = np.std([frame.state for frame in frames], axis=0)
    # 1 where a number never changes: `hardly_changed` then moves it by a hundredth of its unit.
    return np.where(spread > 0, spread, 1.0)
