"""The session of a run in the scene: both layouts of an item, drawn again from the same state."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.errors import (
    NoTrajectoryError,
    OtherFramesError,
)
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.scene_source import ScenePlayer, scene_row
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.pairs import Chunk, Pair
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.plan import Row
from probe_kit.runs.reader import origin_of
from probe_kit.runs.run import Run
from probe_kit.runs.run_source import OF_SCENE
from probe_kit.runs.run_suite import suite_of
from probe_kit.suite.items import Episode, Item, Layout, check_wordings, counterparts_of, in_words

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy

from probe_kit.intervene.sessions import ReplayFiles, ReplaySession, largest_difference

_OTHER: Mapping[Layout, Layout] = {"original": "swapped", "swapped": "original"}


class SceneSession(ReplaySession):
    """A policy and a scene.

    `counterparts` has the counterparts of the items that have one, see `counterparts_of`.

    Args:
        run: Run in the scene.
        policy: The run's policy.
        scene: Specification of the run's scene.
        items: Items of the run's suite, by id.
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
    def of(cls, run: Run, source: ReplayFiles, load: "Callable[[], Policy]") -> "SceneSession":
        """Return the session of a run.

        Raises:
            SuiteError: For another suite than the run's.
            SuiteNotFoundError: For a suite that is neither given nor can be drawn again.
            SceneError: For a missing file of the scene.
        """
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

        Raises:
            OtherFramesError: If a frame is not the one that the run began with.
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
                # The other layout has the same state, and its row, if the run has it, begins with this very frame.
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
                    stored=self._stored_chunk(int(row)),
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

    # -- whole episodes ----------------------------------------------------------------------------------

    @property
    def player(self) -> ScenePlayer:
        """The player of the scene."""
        return self.stage

    def pair_at(self, pair: Pair, observation: Observation, call: int, swapping: bool) -> Pair:
        """Return the pair of an inference of the episode that is played; its source has the pictures swapped."""
        source = self.stage.look_swapped()[0] if swapping else observation
        seed = derive_seed(self.stage.row.policy_seed, "inference", call)
        tiles = self.stage.tile_masks()
        return replace(pair, clean=observation, source=source, seed=seed, tiles=tiles, step=call)

    def end_position(self, ending: Ending) -> float:
        """Return the lateral offset of the cube in metres, see `lateral_offset`."""
        return self.lateral_offset(np.array([float(ending.outcome["cube_x"]), float(ending.outcome["cube_y"])]))

    def trajectory_difference(self, pair: Pair, ending: Ending, actions: Sequence[Chunk]) -> float:
        """Return the largest difference of any number of the trajectory; NaN where the run keeps none."""
        del actions
        try:
            frames = self.run.trajectory(pair.row).frames
        except NoTrajectoryError:
            return nan
        assert ending.trajectory is not None
        return largest_difference(ending.trajectory, frames)

    def _stored_chunk(self, row: int) -> Chunk | None:
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
