"""Replay sessions: a run's policy and observations, set up again to repeat and edit its inferences.

In the scene both layouts of an item are drawn again from the same state. Of other runs a pair is two frames: the
source is the clean frame with one of the inputs of a donor, another frame of another group.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.errors import (
    CaptureChangedActionError,
    NoTrajectoryError,
    OtherFramesError,
    SettingsMismatchError,
    UsageError,
)
from probe_kit.extract.rollout.capturing import FEWEST_FOR_THREADS
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    Frame,
    draw_donors,
    hardly_changed,
    with_input,
)
from probe_kit.extract.sources.scene_source import ScenePlayer, scene_row
from probe_kit.hashing import derive_seed
from probe_kit.hooks.checkpoints.checkpoint import cached_folder, pinned_commits
from probe_kit.hooks.checkpoints.third_party import copied, while_acting
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.family import SIZE
from probe_kit.intervene.outcomes import Choice, PairRow, directions_of, has_sides, items_of, spread_of
from probe_kit.intervene.places import Chunk, Given, Pair, check_pairs
from probe_kit.runs.layout import FIRST_FRAME, stored_inputs_of
from probe_kit.runs.plan import Row
from probe_kit.runs.reader import origin_of
from probe_kit.runs.run import Run
from probe_kit.runs.run_source import OF_SCENE
from probe_kit.suite.items import Episode, Item, Layout, check_wordings, counterparts_of, in_words
from probe_kit.train.run_suite import suite_of

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy


FAR = 0.01
"""By how much a number of a repeated first action may differ from the stored one, in its unit.

Batches of another size, threads and GPUs round otherwise. More is another policy or scene.
"""


class Progress(Protocol):
    """Called after every item."""

    def __call__(self, count: int, total: int, what: str, /) -> None:
        """Take items so far, of `total`, and the last one."""


@dataclass(frozen=True)
class ReplaySource:
    """The places of a run's policy, pictures and files; their hashes must be the run's.

    suite: folder; None for that of the run, see `suite_of`. checkpoint, options, weights_seed: as for
    `probe-kit extract`; by default those of the run, of a checkpoint its folder if it is still there. Options of
    the run stay but for those that are named anew. device: of the model. moved: parts of the run's source that lie
    elsewhere now, by field of its settings: `folder` and `table` of recordings and pictures, `environment` (and
    `options`, beside those of the run), `scene.background`, `scene.arm_urdf`; by default where the run had them.
    """

    suite: Path | None = None
    checkpoint: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights_seed: int | None = None
    device: str = "cpu"
    moved: Mapping[str, Any] = field(default_factory=dict)


LoadPolicy = Callable[[Run, ReplaySource], "Policy"]


class ReplaySession(ABC):
    """A policy and its observations; a context manager, because it can hold a simulator.

    on_fit_progress: called after every item that is inferred beforehand, for directions and erasers. passed_over:
    places of a wildcard, each with its role, at which an answer has no direction, and why.
    certificate: entries of the kind's own.
    """

    def __init__(self, run: Run, policy: "Policy") -> None:
        self.run, self.policy = run, policy
        self.on_fit_progress: Progress | None = None
        self.passed_over: dict[str, str] = {}
        self.certificate: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Free a simulator or files."""

    @abstractmethod
    def pairs(self, item: str) -> list[Pair]:
        """Return the pairs of an item's episodes. Raises OtherFramesError for other observations."""

    @abstractmethod
    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return the number that is read off a chunk (chunk, D) of actions after the pair's clean observation."""

    @abstractmethod
    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return the same up to a constant, as a function of actions (chunk, D) that keeps their graph."""

    @abstractmethod
    def with_other_instruction(self, pair: Pair) -> Observation | None:
        """Return the clean observation under its counterpart's instruction; None without one."""

    @abstractmethod
    def has_other_instruction(self, item: str) -> bool:
        """Whether an item has a counterpart that asks for another action before the same observation."""

    def categories_of(self, items: Sequence[str]) -> list[str]:
        """Return the category of every item."""
        episodes = self.run.episodes
        by_item = dict(zip(episodes["item_id"].astype(str), episodes["category"].astype(str), strict=True))
        return [by_item[item] for item in items]

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Use as many threads as the run had, so that sums are rounded alike."""
        threads = 1 if self.policy.card.parameters < FEWEST_FOR_THREADS else None
        with torch_threads(threads):
            yield

    def act(self, model_input: Given, seed: int) -> Chunk:
        """Return (chunk, D): one inference, alone in its batch. Raises PolicyFailedError if the policy raises."""
        assert isinstance(model_input, Observation), "pairs of runs are of observations"
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.act(copied([model_input]), [seed])[0], np.float32)

    def replay_error(self, pair: Pair, chunk: Chunk) -> float:
        """Return by how much a clean inference differs from the stored actions; NaN where there are none.

        Raises CaptureChangedActionError if it is another action altogether.
        """
        if pair.stored is None:
            return nan
        count = min(len(pair.stored), len(chunk))
        largest = float(np.abs(chunk[:count] - pair.stored[:count]).max())
        if not largest <= FAR:  # negated, so that NaN is refused too
            raise CaptureChangedActionError(
                f"the first action of {pair.episode}, inferred again, differs from the stored one by "
                f"{largest:.3g}; expected the same. The policy has other options than the run's, or is not "
                "deterministic"
            )
        return largest


def load_policy_of(run: Run, source: ReplaySource) -> "Policy":
    """Return the policy that a run names, loaded as its own process loaded it.

    A file whose weights call themselves random is loaded as a file: only requested random weights are drawn.
    """
    from probe_kit.hooks import load_policy

    origin = origin_of(run)
    checkpoint = source.checkpoint or None
    if checkpoint is None:
        # Where the run had it, if its folder, or its commit of the hub, is here: none is fetched.
        before = origin.checkpoint
        is_folder = before not in ("", EMBEDDED) and Path(before).expanduser().is_dir()
        checkpoint = before if is_folder or cached_folder(before) is not None else None
    options = {name: value for name, value in origin.options.items() if checkpoint is None or name != SIZE}
    # Branches of its vision-language model or tokenizer may have gone on since the run was made.
    with pinned_commits(origin.repositories):
        return load_policy(
            run.model,
            checkpoint,
            source.device,
            run.settings["dtype"],
            origin.random_weights,
            origin.weights_seed if source.weights_seed is None else source.weights_seed,
            **{**options, **source.options},
        )


def check_policy(run: Run, policy: "Policy") -> None:
    """Raise SettingsMismatchError for other weights or options than the run's."""
    card = policy.card
    if card.weights_sha256 != run.weights_sha256:
        checkpoint = origin_of(run).checkpoint or "an unknown checkpoint"
        raise SettingsMismatchError(
            f"the weights of {card.checkpoint} are {card.weights_sha256[:12]}; {run.location} was made with "
            f"{str(run.weights_sha256)[:12]}, loaded from {checkpoint}. Give that --checkpoint (or --weights-seed)"
        )
    was, now = dict(run.settings.get("policy", {})), dict(card.settings)
    if was != now:
        different = sorted(name for name in was | now if was.get(name) != now.get(name))
        lines = "; ".join(f"{name}: stored {was.get(name)!r}, here {now.get(name)!r}" for name in different)
        raise SettingsMismatchError(f"{run.location} was made with other options ({lines}). Give the same with -M")


# -- the scene -----------------------------------------------------------------------------------------------

_OTHER: Mapping[Layout, Layout] = {"original": "swapped", "swapped": "original"}


class SceneSession(ReplaySession):
    """A policy and a scene.

    items: of the run's suite, by id. counterparts: of those that have one, see `counterparts_of`.
    """

    def __init__(self, run: Run, policy: "Policy", scene: SceneSpec, items: Mapping[str, Item]) -> None:
        super().__init__(run, policy)
        self.scene, self.items, self.counterparts = scene, items, counterparts_of(items.values())
        self.stage = ScenePlayer(scene)
        left_tile, right_tile = np.array(scene.tile_left), np.array(scene.tile_right)
        self._middle, self._across = (
            (left_tile + right_tile) / 2,
            (left_tile - right_tile) / float(np.linalg.norm(left_tile - right_tile)),
        )

    @classmethod
    def of(cls, run: Run, source: ReplaySource, load: "Callable[[], Policy]") -> "SceneSession":
        """Return that of a run. Raises SuiteError, SuiteNotFoundError, SceneError for a missing file."""
        files = {name: path for name, path in origin_of(run).scene_files.items() if path.is_file()}
        moved = {field.removeprefix(OF_SCENE): Path(path) for field, path in source.moved.items()}
        scene = SceneSpec.from_json(run.settings["scene"], {**files, **moved})
        suite = suite_of(run, source.suite)
        return cls(run, load(), scene, {item.item_id: item for item in suite.items})

    def close(self) -> None:
        """Close the simulator."""
        self.stage.close()

    def pairs(self, item: str) -> list[Pair]:
        """Return the first inferences of an item's episodes, each with that of the other layout.

        Raises OtherFramesError if a frame is not the one that the run began with.
        """
        episodes = self.run.episodes
        rows = np.flatnonzero((episodes["item_id"] == item).to_numpy())
        frames: dict[Layout, tuple[Observation, dict[str, Any]]] = {}
        pairs = []
        for row in rows:
            record = episodes.iloc[int(row)]
            worded = replace(self.items[item], instruction=str(record["instruction"]))
            layout = _layout_of(record)
            if layout not in frames:
                planned = scene_row(0, Episode(worded, layout), int(record["scene_seed"]), 0)
                frames[layout] = self.stage.look(planned)
                frames[_OTHER[layout]], tiles = self.stage.look_swapped(), self.stage.tile_masks()
            stored, drawn = record.get(FIRST_FRAME), frames[layout][1][FIRST_FRAME]
            if stored is not None and stored != drawn:
                raise OtherFramesError(
                    f"the first frame of {record['episode_id']}, drawn again, is {drawn[:12]}; "
                    f"{self.run.location} began with {str(stored)[:12]}. Its pictures, its scene or the renderer "
                    "are others here; use the machine and versions that its provenance names"
                )
            pairs.append(
                Pair(
                    clean=frames[layout][0],
                    source=frames[_OTHER[layout]][0],
                    seed=derive_seed(int(record["policy_seed"]), "inference", 0),
                    toward=-1 if record["side_correct"] == "left" else 1,
                    group=str(record["group_id"]),
                    item=item,
                    row=int(row),
                    episode=str(record["episode_id"]),
                    category=str(record["category"]),
                    side="left" if record["side_correct"] == "left" else "right",
                    tiles=tiles,
                    stored=self._stored(int(row)),
                )
            )
        return pairs

    def planned(self, pair: Pair) -> Row:
        """Return a pair's episode as the run planned it."""
        assert isinstance(pair.clean, Observation)
        record = self.run.episodes.iloc[pair.row]
        item = replace(self.items[pair.item], instruction=pair.clean.instruction)
        seeds = int(record["scene_seed"]), int(record["policy_seed"])
        return scene_row(0, Episode(item, _layout_of(record)), *seeds)

    def _stored(self, row: int) -> Chunk | None:
        try:
            commanded = self.run.trajectory(row).commanded
        except NoTrajectoryError:
            return None
        # Of averaged chunks only the first action is that of one inference: there is no earlier chunk yet.
        executed = 1 if self.policy.card.ensemble is not None else int(self.run.settings["execute"])
        return np.asarray(commanded[:executed], np.float32)

    # -- readout -----------------------------------------------------------------------------------------

    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return where the chunk would bring the hand, see `lateral_displacement`."""
        assert isinstance(pair.clean, Observation)
        return self.lateral_displacement(chunk, pair.clean)

    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return `lateral_motion`."""
        del pair
        return self.lateral_motion

    def lateral_displacement(self, chunk: Chunk, observation: Observation) -> float:
        """Return where the chunk would bring the hand, in metres left of the middle between the tiles."""
        end = np.asarray(observation.state[:2], np.float64) + chunk[:, :2].astype(np.float64).sum(axis=0)
        return self.lateral_offset(end)

    def lateral_motion(self, chunk: "Tensor") -> "Tensor":
        """Return how far a chunk (chunk, 7) moves the hand to the left, in metres, with its graph."""
        return (chunk[:, :2].sum(dim=0) * chunk.new_tensor(self._across)).sum()

    def lateral_offset(self, point: NDArray[np.float64]) -> float:
        """Return how far a point (2,) is from the middle between the tiles, in metres; left is positive."""
        return float((point - self._middle) @ self._across)

    # -- words -------------------------------------------------------------------------------------------

    def counterpart_instruction(self, item_id: str, layout: Layout) -> str | None:
        """Return the counterpart's instruction in the run's wording, its pictures lying as in `layout`."""
        counterpart = self.counterparts.get(item_id)
        if counterpart is None:
            return None
        if self.run.wording is None:
            return counterpart.instruction
        # The counterpart may list the same two pictures in the other order, and then lies in the other layout.
        alike = self.items[item_id].left_pixels_sha256 == counterpart.left_pixels_sha256
        (wording,) = check_wordings([self.run.wording])
        worded = in_words(Episode(counterpart, layout if alike else _OTHER[layout]), wording)
        return None if worded is None else worded.item.instruction

    def has_other_instruction(self, item: str) -> bool:
        """Whether the suite has an item with the same pictures that asks for the other one."""
        return self.counterpart_instruction(item, "original") is not None

    def with_other_instruction(self, pair: Pair) -> Observation | None:
        """Return the clean observation under its counterpart's instruction; None without one."""
        assert isinstance(pair.clean, Observation)
        words = self.counterpart_instruction(pair.item, _layout_of(self.run.episodes.iloc[pair.row]))
        return None if words is None else replace(pair.clean, instruction=words)


def _layout_of(record: Any) -> Layout:
    return "original" if record["layout"] == "original" else "swapped"


# -- runs without sides --------------------------------------------------------------------------------------

CACHED = 256
"""Observations that are kept: those of the nearest frames are compared again and again."""
_CONTENT = "content_blake2b"


class Frames:
    """All frames of a run that can be shown again: of each row those that its source gives without an action.

    cameras: of the policy, those that get a picture. index: the frames, in the order of rows and inferences.
    """

    def __init__(self, run: Run, source: ReplaySource) -> None:
        """Raises UsageError if files of the source are gone, OtherFramesError for another version of it."""
        from probe_kit.extract.config_files import source_again
        from probe_kit.extract.sources.source import Played

        self.run, inputs = run, stored_inputs_of(run.settings)
        opened = source_again(run, source.moved).open()
        opened.check_same(run.settings)
        opened.columns = tuple(inputs["columns"])
        self._name, self._rows = opened.name, {row.episode_id: row for row in opened.rows(run.settings["seed"])}
        self._player = opened.play(Played())()
        self.cameras = tuple(camera if isinstance(camera, str) else camera[0] for camera in inputs["cameras"])
        self._cached = lru_cache(maxsize=CACHED)(self.observe)
        self.index = list(self._listed())

    @cached_property
    def by_name(self) -> dict[tuple[str, int], Frame]:
        """The frames by number and episode, or item: a table of pairs may name either."""
        names = {(frame.item, frame.number): frame for frame in self.index}
        return names | {(frame.episode, frame.number): frame for frame in self.index}

    def check_varied(self, vary: str) -> None:
        """Raise UsageError for an input that the frames do not have, such as a mistyped camera."""
        inputs = (INSTRUCTION, PICTURE, *(f"{PICTURE}.{name}" for name in self.cameras), STATE)
        if vary not in inputs:
            raise UsageError(f"vary is {vary!r}; expected one of {', '.join(inputs)}")

    def observe(self, frame: Frame) -> Observation:
        """Show a frame. Raises OtherFramesError if it is not the run's."""
        row = self._rows[frame.episode]
        stored = self.run.episodes.iloc[frame.row].get(_CONTENT)
        if stored != row.columns.get(_CONTENT):
            raise OtherFramesError(
                f"{self._name}: the files of {frame.item} are not those of {self.run.location}: their hash "
                "differs. Give the files of the run"
            )
        single = row if row.frames is None else replace(row, frames=(frame.number,))
        observation = self._player.answer("begin", (single, False))
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

    def close(self) -> None:
        """Free what the player holds."""
        self._player.close()

    def _listed(self) -> Iterator[Frame]:
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
                    seed=derive_seed(int(record["policy_seed"]), "inference", number),
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
"""Frames of an episode that are used if nothing is said."""


class ObservedSession(ReplaySession):
    """A policy and frames of recordings, or first observations of an environment.

    vary: the input that the source has of its donor. frames_each: of an episode. table: pairs of the user's own,
    by which donors are chosen. items: those whose clean actions are the unit of displacements.
    """

    def __init__(self, run: Run, policy: "Policy", frames: Frames, choice: Choice | None = None) -> None:
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


def open_session(
    run: Run,
    source: ReplaySource,
    load: LoadPolicy | None = None,
    choice: Choice | None = None,
    table: Sequence[PairRow] = (),
) -> ReplaySession:
    """Load the run's policy and set up its observations.

    load: how the policy is found, if not by its name. choice: of pairs of a run without sides. table: pairs of the
    user's own, by default those of the choice; the frames that it names are looked up before the policy is loaded.
    Raises SettingsMismatchError if it is another one, SuiteError for another suite, SuiteNotFoundError for one
    that is neither given nor can be drawn again, SceneError for a scene that needs a file which is not given,
    UsageError for a table with a frame that the run lacks.
    """

    def policy() -> "Policy":
        return (load or load_policy_of)(run, source)

    table = table or (() if choice is None else choice.pairs)
    with ExitStack() as on_failure:
        session: ReplaySession
        if has_sides(run):
            check_pairs(table, {(str(episode), 0) for episode in run.episodes["episode_id"]})
            session = SceneSession.of(run, source, policy)
            on_failure.callback(session.close)
        else:
            frames = Frames(run, source)
            on_failure.callback(frames.close)
            check_pairs(table, frames.by_name)
            if choice is not None:
                frames.check_varied(choice.varied)
            session = ObservedSession(run, policy().with_cameras(list(frames.cameras)), frames, choice)
        check_policy(run, session.policy)
        on_failure.pop_all()
    return session


def find_pairs(session: ReplaySession, category: str, items: int | None = None) -> list[Pair]:
    """Return the inferences of a category's episodes in a run, each paired with its source's.

    In the scene these are first inferences, and those before swapped images; the metric that fits is
    `session.lateral_displacement`: metres, left positive. items: how many items, both layouts of each; None for
    all. Every clean inference is repeated and compared with the action that the run executed. Raises
    UnknownCategoryError for a category that the run does not have, OtherFramesError and CaptureChangedActionError
    for pictures or actions that are not those of the run.
    """
    pairs = []
    for item in items_of(session.run, (category,), items):
        for pair in session.pairs(item):
            session.replay_error(pair, session.act(pair.clean, pair.seed))
            pairs.append(pair)
    return pairs
