"""Conditions: the ways in which one inference is made again, and the numbers of each; loads no model."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edits import LOG_FIELDS, EditLog
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edited_cells import NO_CELL, EditedCell, columns_of
from probe_kit.intervene.outcomes import CLEAN, CONTROL_INPUT, DONOR, IMAGE_SWAP, NOISE, ConditionOutcomes
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.intervene.patching.patch import Cell, patch_while_inferring
from probe_kit.intervene.tokens import PairTokens

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache
    from probe_kit.intervene.directions import Directions
    from probe_kit.intervene.sessions import ReplaySession


@dataclass
class ConditionContext:
    """One pair, with the values that its conditions share.

    Attributes:
        clean: (chunk, D) actions of the first condition; empty before that was played.
        results: Results of this pair that several conditions share, by what decides them.
    """

    session: "ReplaySession"
    pair: Pair
    clean: Chunk = field(default_factory=lambda: np.zeros((0, 7), np.float32))
    results: "dict[object, ConditionResult]" = field(default_factory=dict, init=False, repr=False)
    _source: "ActivationCache | None" = field(default=None, init=False, repr=False)

    @cached_property
    def tokens(self) -> PairTokens:
        """The tokens of the clean input."""
        return PairTokens(self.session.policy, self.pair)

    def act(self) -> Chunk:
        """Return the action (chunk, D) on the clean input."""
        return self.session.act(self.pair.clean, self.pair.seed)

    def source(self, sites: Sequence[Site]) -> "ActivationCache":
        """Return the activations of all these sites in the source's inference, which is made once."""
        from probe_kit.hooks import capture

        if self._source is None:
            with capture(self.session.policy, sites) as self._source:
                self.session.act(self.pair.source, self.pair.seed)
        return self._source


@dataclass(frozen=True)
class ConditionResult:
    """The result of one inference.

    Attributes:
        chunk: (chunk, D) actions.
        edit_log: Log of the edits; None without any.
        mass: (B, I, H, R) shares of its attention; None if not recorded; see `AttentionShares`.
        patches: (B, P) shares on the patches of the cameras' pictures, means over iterations and heads; None if
            not recorded.
        token_counts: Numbers of tokens that are cut, and of the others; None where no attention is cut.
        estimated: Displacement that an estimate adds to the chunk's, without an inference that makes it.
    """

    chunk: Chunk
    edit_log: EditLog | None = None
    mass: NDArray[np.float32] | None = None
    patches: NDArray[np.float32] | None = None
    token_counts: tuple[int, int] | None = None
    estimated: float = 0.0


@dataclass(frozen=True)
class Condition:
    """One way of making an inference again.

    Attributes:
        name: Name that is unique within its intervention.
        play: Function that makes the inference.
        places: Names of the places that it edits, by which it is known whether anything reads them.
        details: Values for `Intervention.extra_files`.
        cell: The one cell that it edits, whose columns are stored; empty for any other condition.
    """

    name: str
    play: Callable[[ConditionContext], ConditionResult] = field(repr=False)
    places: tuple[str, ...] = ()
    details: Any = field(default=None, repr=False)
    cell: EditedCell = NO_CELL

    @classmethod
    def of_cell(cls, cell: EditedCell, play: Callable[[ConditionContext], ConditionResult]) -> Self:
        """Return the condition that edits one cell, and has its name."""
        return cls(str(cell), play, (cell.site,), cell=cell)


def _condition_of_input(name: str, which: str) -> Condition:
    """Return the inference on one of a pair's inputs, with the same seed and nothing changed in the network."""

    def play(context: ConditionContext) -> ConditionResult:
        model_input: Given | None = getattr(context.pair, which)
        assert model_input is not None
        return ConditionResult(context.session.act(model_input, context.pair.seed))

    return Condition(name, play)


CLEAN_RUN = _condition_of_input(CLEAN, "clean")
"""Condition of the inference as the run made it."""
SOURCE_RUN = _condition_of_input(IMAGE_SWAP, "source")
"""Condition of the source's inference: in the scene, the two pictures in each other's place."""
DONOR_RUN = _condition_of_input(DONOR, "donor")
"""Condition of the donor's inference: all inputs are its own."""
CONTROL_RUN = _condition_of_input(CONTROL_INPUT, "control")
"""Condition of the clean inference after a meaningless change of the varied input."""


def _resample_noise(context: ConditionContext) -> ConditionResult:
    """Infer with noise drawn anew; the same action again where a policy draws none."""
    return ConditionResult(context.session.act(context.pair.clean, derive_seed(context.pair.seed, NOISE, 0)))


NOISE_RUN = Condition(NOISE, _resample_noise)
"""Condition of the clean inference with another seed."""


def patched_run(
    name: str | EditedCell,
    cells: Mapping[str, tuple[Cell, ...]],
    source_sites: tuple[Site, ...],
    direction: str = "",
    bases: "Directions | None" = None,
) -> Condition:
    """Return the clean inference with activations of cells from the source's: one inference for all cells.

    Args:
        name: Name of the condition, or the cell that it edits.
        cells: Cells by category, and for all other categories under the empty name.
        source_sites: All sites at which the source's inference is captured, once for all conditions.
        direction: Name of one of `bases`; empty to patch tokens in full.
        bases: Directions of the cell; None to patch tokens in full.
    """

    def play(context: ConditionContext) -> ConditionResult:
        patches = cells.get(context.pair.category, cells.get("", ()))
        if not patches:
            return ConditionResult(context.act())
        along = None if bases is None else bases.basis(direction, context.pair.episode)
        with patch_while_inferring(context.tokens, patches, context.source(source_sites), along) as edit_log:
            return ConditionResult(context.act(), edit_log)

    places = (cell.site_group.name for together in cells.values() for cell in together)
    cell = name if isinstance(name, EditedCell) else NO_CELL
    return Condition(str(name), play, tuple(dict.fromkeys(places)), cell=cell)


AttentionRecord = tuple[int, int, NDArray[np.float32], NDArray[np.float32] | None]
"""The attention of one inference: row in the run's episodes, call, (B, I, H, R) shares, (B, P) of patches."""


def room_for(pairs: Sequence[Pair], conditions: Sequence[Condition]) -> ConditionOutcomes:
    """Return outcomes with room for the numbers of these conditions in these pairs."""
    shape = len(conditions), len(pairs)
    columns: dict[str, Any] = {
        name: np.array([getattr(pair, field) or "" for pair in pairs], str)
        for name, field in (
            ("episodes", "episode"), ("items", "item"), ("groups", "group"), ("categories", "category"),
            ("sides", "side"),
        )
    }  # fmt: skip
    return ConditionOutcomes(
        conditions=tuple(condition.name for condition in conditions),
        **columns_of([condition.cell for condition in conditions]),
        **columns,
        displacement=np.empty(shape),
        max_action_change=np.zeros(shape),
        edit_log=np.zeros((*shape, len(LOG_FIELDS))),
        replay_error=np.empty(len(pairs)),
    )


def count_tokens(
    outcomes: ConditionOutcomes, counted: Mapping[tuple[int, int], tuple[int, int]]
) -> ConditionOutcomes:
    """Return outcomes with the numbers of cut and of other tokens, by condition and pair, if any were counted."""
    if not counted:
        return outcomes
    counts = np.zeros((*outcomes.displacement.shape, 2), np.int64)
    for cell, numbers in counted.items():
        counts[cell] = numbers
    return replace(outcomes, token_counts=counts)


def with_attention(outcomes: ConditionOutcomes, records: Sequence[AttentionRecord]) -> ConditionOutcomes:
    """Return outcomes with the attention of their inferences, if any was recorded."""
    if not records:
        return outcomes
    rows, calls, masses, patches = zip(*records, strict=True)
    return replace(
        outcomes,
        mass=np.stack(masses),
        inferences=np.stack([rows, calls], axis=1).astype(np.int64),
        patches=None if patches[0] is None else np.stack(patches),
    )


def replay(session: "ReplaySession", pairs: Sequence[Pair], conditions: Sequence[Condition]) -> ConditionOutcomes:
    """Play every condition on every pair; the first one is the clean one."""
    outcomes = room_for(pairs, conditions)
    attention_records: list[AttentionRecord] = []
    counted: dict[tuple[int, int], tuple[int, int]] = {}
    chunks: list[list[Chunk]] = []
    for column, pair in enumerate(pairs):
        context = ConditionContext(session, pair)
        clean = context.clean = conditions[0].play(context).chunk
        outcomes.replay_error[column] = session.replay_error(pair, clean)
        chunks.append([])
        for number, condition in enumerate(conditions):
            # The clean inference is not made again: `replay_error` has compared it with the run's.
            played = condition.play(context) if number else ConditionResult(clean)
            outcomes.displacement[number, column] = session.displacement(played.chunk, pair) + played.estimated
            outcomes.max_action_change[number, column] = float(np.abs(played.chunk - clean).max())
            chunks[-1].append(played.chunk.ravel())
            if played.edit_log is not None:
                outcomes.edit_log[number, column] = played.edit_log.row()
            if played.token_counts is not None:
                counted[number, column] = played.token_counts
            if played.mass is not None:
                attention_records.append((pair.row, pair.step, played.mass, played.patches))
    by_condition = np.array(chunks, np.float32).swapaxes(0, 1) if chunks else None
    return replace(with_attention(count_tokens(outcomes, counted), attention_records), chunks=by_condition)
