"""The session of a run without sides: frames of recordings, or first observations of an environment.

A pair is two frames. The source is the clean frame with one of the inputs of a donor, another frame of another
group.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import (
    OtherFramesError,
    UsageError,
)
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    Frame,
    InputComparison,
    draw_donors,
    hardly_changed,
    normal_form,
    why_not_varied,
    with_input,
)
from probe_kit.hashing import derive_seed
from probe_kit.hooks.checkpoints.third_party import copy_observations, while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.outcomes import directions_of, spread_of
from probe_kit.intervene.pairs import Chunk, Given, Pair, PairRow
from probe_kit.intervene.settings import Choice
from probe_kit.runs.layout import AT_END, source_settings_of
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.extract.sources.player import Ending, Player
    from probe_kit.hooks import Policy
    from probe_kit.runs.plan import Row

from probe_kit.intervene.sessions import ReplayFiles, ReplaySession, largest_difference

CACHED = 256
"""Number of observations that are kept: those of the nearest frames are compared again and again."""
_CONTENT = "content_blake2b"


class Frames:
    """All frames of a run that can be shown again: those of each row that its source gives without an action.

    `cameras` are the policy's cameras that get a picture. `index` lists the frames, in the order of rows and
    inferences.
    """

    def __init__(self, run: Run, source: ReplayFiles) -> None:
        """Open the source of the run again and list its frames.

        Raises:
            UsageError: If files of the source are gone.
            OtherFramesError: For another version of the source.
        """
        from probe_kit.extract.config_files import source_again
        from probe_kit.extract.sources.source import Played

        self.run, inputs = run, source_settings_of(run.settings)
        opened = source_again(run, source.moved).open()
        opened.check_same(run.settings)
        opened.columns = tuple(inputs["columns"])
        self._name, self._rows = opened.name, {row.episode_id: row for row in opened.rows(run.settings["seed"])}
        self.player = opened.play(Played())()
        self.cameras = tuple(camera if isinstance(camera, str) else camera[0] for camera in inputs["cameras"])
        self._cached = lru_cache(maxsize=CACHED)(self.observe)
        self.index = list(self._list_frames())
        if not self.index:
            raise UsageError(
                f"{run.location} has no frame that can be shown again: the streams of all its episodes were "
                "edited (--condition). Serve episodes of the condition none as well"
            )

    @cached_property
    def by_name(self) -> dict[tuple[str, int], Frame]:
        """The frames by number and episode, item or recorded episode: a table of pairs may name any of them."""
        # Episodes come last, so that a name which is both is an episode's.
        sources = self.run.episodes["source_episode"].tolist() if self.run.recorded else []
        names = {(str(sources[frame.row]), frame.number): frame for frame in self.index if sources}
        names |= {(frame.item, frame.number): frame for frame in self.index}
        return names | {(frame.episode, frame.number): frame for frame in self.index}

    def check_varied(self, vary: str, task_words: Sequence[str] = ()) -> None:
        """Refuse an input that the frames do not have, such as a mistyped camera, and a single instruction.

        Args:
            vary: The input.
            task_words: Words of other tasks.

        Raises:
            UsageError: For an input that the frames do not have, or an instruction that they all share.
        """
        inputs = (INSTRUCTION, PICTURE, *(f"{PICTURE}.{name}" for name in self.cameras), STATE)
        if vary not in inputs:
            raise UsageError(f"vary is {vary!r}; expected one of {', '.join(inputs)}")
        instructions = [frame.instruction for frame in self.index]
        if vary == INSTRUCTION and not task_words and len(set(map(normal_form, instructions))) == 1:
            raise UsageError(why_not_varied(instructions, vary))

    def observe(self, frame: Frame) -> Observation:
        """Show a frame.

        Raises:
            OtherFramesError: If it is not the run's.
        """
        row = self._rows[frame.episode]
        stored = self.run.episodes.iloc[frame.row].get(_CONTENT)
        if stored != row.columns.get(_CONTENT):
            raise OtherFramesError(
                f"{self._name}: the files of {frame.item} are not those of {self.run.location}: their hash "
                "differs. Give the files of the run"
            )
        single = row if row.frames is None else replace(row, frames=(frame.number,))
        observation = self.player.answer("begin", (single, False))
        assert isinstance(observation, Observation)
        if frame.state.size and not np.array_equal(observation.state.astype(np.float64), frame.state):
            raise OtherFramesError(
                f"{self._name}, {frame.episode}: the state at the beginning is not that of {self.run.location}. "
                "Take all randomness from the episode's seed, and use the run's version"
            )
        pictures = {name: np.array(picture) for name, picture in observation.cameras.items()}
        return replace(
            observation, image=np.array(observation.image), state=np.array(observation.state), cameras=pictures
        )

    def planned(self, row: int) -> "Row":
        """Return a row of the run as its source plans it."""
        return self._rows[str(self.run.episodes["episode_id"].iloc[row])]

    def close(self) -> None:
        """Free the player's resources."""
        self.player.close()

    def _list_frames(self) -> Iterator[Frame]:
        inputs = self.run.inputs
        assert inputs is not None
        states = inputs.read("state").astype(np.float64) if "state" in inputs.kinds else None
        kind = next((name for name in ("prediction", "action") if name in inputs.kinds), None)
        actions = None if kind is None else inputs.read(kind)
        for row, record in enumerate(self.run.episodes.to_dict("records")):
            planned = self._rows.get(str(record["episode_id"]))
            if planned is None:
                raise OtherFramesError(
                    f"{self._name} has no episode {record['episode_id']!r} any more; use the run's version"
                )
            for call, number in enumerate((0,) if planned.frames is None else planned.frames):
                yield Frame(
                    name=f"{record['episode_id']}@{number}",
                    group=str(record["group_id"]),
                    seed=derive_seed(int(record["policy_seed"]), "inference", planned.noise_of(call)),
                    instruction=str(record["instruction"]),
                    state=np.zeros(0) if states is None else states[row, call],
                    observe=self._cached,
                    row=row,
                    number=number,
                    item=str(record["item_id"]),
                    episode=str(record["episode_id"]),
                    category=str(record["category"]),
                    stored=None if actions is None else np.asarray(actions[row, call], np.float32),
                )


FRAMES = 4
"""Default number of frames of an episode.

Frames of one episode are alike, and the unit of tests is its group: more frames cost inferences and add little
evidence.
"""


REWORDED = 100
"""The most frames that donors with further instructions are made of: each text with pictures of many groups."""


class FrameSession(ReplaySession):
    """A policy and frames of recordings, or first observations of an environment.

    `vary` is the input that the source has of its donor. `frames_each` is the number of frames of an episode.
    `table` has pairs of the user's own, by which donors are chosen. The clean actions of `items` are the unit of
    displacements.

    Args:
        run: Run without sides.
        policy: The run's policy.
        frames: Frames of the run.
        choice: Settings of the intervention; None for pictures of donors, the default number of frames, and all
            items.
    """

    def __init__(self, run: Run, policy: "Policy", frames: Frames, choice: Choice | None = None) -> None:
        """Set up the session of a run's frames; see also `Frames.check_varied`.

        Raises:
            UsageError: For a varied input that no other group varies.
        """
        super().__init__(run, policy)
        self.frames = frames
        self.vary, self.frames_each = PICTURE, FRAMES
        self.table: tuple[PairRow, ...] = ()
        self.instructions: tuple[str, ...] = ()
        self.items: Sequence[str] = tuple(dict.fromkeys(frame.item for frame in frames.index))
        self._ends: dict[tuple[int, int, str], tuple[Chunk, NDArray[np.float64]]] = {}
        self._spread = _state_spread(frames.index)
        if choice is not None:
            self.vary, self.frames_each = choice.varied, choice.frames or FRAMES
            self.table, self.items = choice.pairs, choice.items_in(run)
            self.instructions = choice.instructions
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
        index = self._candidates
        rows = [at for at, frame in enumerate(self.frames.index) if frame.item == item]
        spaced = np.linspace(0, len(rows) - 1, min(self.frames_each, len(rows))).round().astype(int)
        donors = []
        for row in (rows[at] for at in np.unique(spaced)):
            # A draw of its own for every frame: items are replayed one by one, and resumed at any of them.
            rng = np.random.default_rng(derive_seed("donor", self.vary, index[row].name))
            drawn = draw_donors(index, self.vary, rng, of=[row], compared=self._compare_instructions())
            donors += [(index[row], index[donor]) for _, donor in drawn]
        return donors

    @cached_property
    def _candidates(self) -> list[Frame]:
        """All frames, and behind them some with every further instruction, which are donors alone."""
        index = self.frames.index
        if self.vary != INSTRUCTION or not self.instructions:
            return index
        spaced = np.unique(np.linspace(0, len(index) - 1, min(REWORDED, len(index))).round().astype(int))
        return [*index, *(index[at].with_instruction(text) for text in self.instructions for at in spaced)]

    def _compare_instructions(self) -> InputComparison | None:
        """Return the comparison of instructions, once; that of pictures would keep all of a data set."""
        return self._compared_instructions if self.vary == INSTRUCTION else None

    @cached_property
    def _compared_instructions(self) -> InputComparison:
        return InputComparison.of(self._candidates, INSTRUCTION)

    @cached_property
    def _tabled(self) -> list[tuple[Frame, Frame]]:
        """The frames and donors of the user's own table, which `open_session` has checked."""
        by_name = self.frames.by_name
        return [(by_name[row[:2]], by_name[row[2:]]) for row in self.table]

    def _check_vary(self) -> None:
        """Refuse an input that no frame of another group varies.

        Raises:
            UsageError: If no frame of another group varies the input.
        """
        if not any(self._donors(item) for item in self.items):
            raise UsageError(why_not_varied([frame.instruction for frame in self.frames.index], self.vary))

    # -- actions and readout -----------------------------------------------------------------------------

    def act(self, model_input: Given, seed: int) -> Chunk:
        """Return one prediction (chunk, D) in the checkpoint's own units, alone in its batch."""
        assert isinstance(model_input, Observation)
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.predict(copy_observations([model_input]), [seed])[0], np.float32)

    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return how far a chunk lies toward the source's, in spreads of clean actions; 0 is the clean action."""
        clean, direction = self._end(pair)
        return float((chunk.astype(np.float64).ravel() - clean.astype(np.float64).ravel()) @ direction)

    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return `displacement` up to a constant, as a function of actions with their graph.

        Raises:
            UsageError: For a family whose gradients are in other units.
        """
        clean, direction = self._end(pair)
        assert isinstance(pair.clean, Observation)
        if not np.array_equal(clean, self.policy.act(copy_observations([pair.clean]), [pair.seed])[0]):
            raise UsageError(
                f"gradients of {self.policy.card.family} are of an arm's actions, and these frames have "
                "predictions in other units. Patch exactly: --kind interchange"
            )
        return lambda actions: (actions.flatten() * actions.new_tensor(direction)).sum()

    def _end(self, pair: Pair) -> tuple[Chunk, NDArray[np.float64]]:
        """Return the clean chunk, and the direction (N,) along which displacements of this pair are measured."""
        at = pair.row, pair.step, pair.donor_name  # a table may give a frame several donors
        if at not in self._ends:
            clean, source = self.act(pair.clean, pair.seed), self.act(pair.source, pair.seed)
            start, end = (chunk.astype(np.float64).ravel()[None] for chunk in (clean, source))
            (direction,), _ = directions_of(start, end, self.weights)
            self._ends[at] = clean, direction
        return self._ends[at]

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """The weights (N,), 1 / spread² of every number of the clean actions, over all pairs of the items."""
        clean = [self.act(pair.clean, pair.seed).ravel() for item in self.items for pair in self.pairs(item)]
        return spread_of(np.array(clean))

    # -- whole episodes ----------------------------------------------------------------------------------

    @property
    def player(self) -> "Player":
        """The player of the environment or the recordings."""
        return self.frames.player

    def planned(self, pair: Pair) -> "Row":
        """Return a pair's episode as the run planned it."""
        return self.frames.planned(pair.row)

    def pair_at(self, pair: Pair, observation: Observation, call: int, swapping: bool) -> Pair:
        """Return the pair of an inference of the episode that is played; without a source of its own."""
        del swapping
        planned = self.player.row
        seed = derive_seed(planned.policy_seed, "inference", planned.noise_of(call))
        return replace(pair, clean=observation, source=observation, seed=seed, step=call, stored=None)

    def end_position(self, ending: "Ending") -> float:
        """Return 1 for success after the last action, else 0."""
        return float(ending.outcome[AT_END])

    def trajectory_difference(self, pair: Pair, ending: "Ending", actions: Sequence[Chunk]) -> float:
        """Return the largest difference of a stored action; the smallest number if only pictures differ.

        The run keeps the hash of all pictures of an episode, and the actions of its captured inferences.
        """
        if str(self.run.episodes["frames_blake2b"].iloc[pair.row]) == ending.outcome["frames_blake2b"]:
            return 0.0
        assert self.run.inputs is not None
        stored = self.run.inputs.row("action", pair.row)
        apart = [largest_difference(*both) for both in zip(actions, stored, strict=False)]
        return max([*apart, float(np.finfo(np.float32).tiny)])

    # -- words -------------------------------------------------------------------------------------------

    def has_other_instruction(self, item: str) -> bool:
        """Whether a frame of the item has a donor."""
        return bool(self._donors(item))

    def with_other_instruction(self, pair: Pair) -> Observation | None:
        """Return the source: a swap of the instruction varies the instruction alone. None for a question."""
        return pair.source if isinstance(pair.source, Observation) else None


def _state_spread(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Return the standard deviation (D,) of every number of the state, 1 where it has none."""
    spread = np.std([frame.state for frame in frames], axis=0)
    # 1 where a number never changes: `hardly_changed` then moves it by a hundredth of its unit.
    return np.where(spread > 0, spread, 1.0)
