"""The player of the scene: the arm carries out actions in front of two pictures."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv, Idle, SceneSpec, ScriptedExpert
from probe_kit.env.act2answer import Recorder
from probe_kit.extract.plan import Row
from probe_kit.extract.sources.player import Answer, Ending, Player
from probe_kit.extract.sources.source import Played
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import CAPTURE_ONLY, FIRST_FRAME
from probe_kit.runs.small_frames import FILM_HEIGHT, shrink
from probe_kit.suite.items import Side


@dataclass(frozen=True)
class Seen:
    """A first frame in which nothing moves. facts: what a run records of it."""

    observation: Observation
    facts: dict[str, Any]


class ScenePlayer(Player):
    """Plays episodes of the scene.

    played: with the script `expert`, `expert-mirrored` or `idle`, that plays every episode to its end at once.
    """

    def __init__(self, scene: SceneSpec, played: Played | None = None) -> None:
        self._played = played or Played()
        self._env, self._intrinsics = Act2AnswerEnv(scene), scene.intrinsics

    def begin(self, row: Row, film: bool) -> Answer:
        """Set up an episode and show its first frame, or let the script play it to its end."""
        self._film, self._frames, self.row = film, list[NDArray[np.uint8]](), row
        self._set_up(row)
        self._recorder = Recorder(self._env)
        self._shoot()
        return self._see() if self._played.script is None else self._follow_script()

    def look(self, row: Row) -> Seen:
        """Set up an episode and show its first frame; nothing on it moves."""
        answer = self.answer("begin", (row, False))
        assert isinstance(answer, Observation)
        return Seen(answer, self._facts)

    def look_swapped(self) -> Seen:
        """Show the item's other layout in the state that this episode is in; facts: its hash alone."""
        observation, frame = self._env.observe_exchanged()
        return Seen(self._observed(observation), {FIRST_FRAME: frame_sha256(frame)})

    def _set_up(self, row: Row) -> None:
        options = {"item": row.content.item, "layout": row.content.layout}
        _, start = self._env.reset(seed=row.columns["scene_seed"], options=options)
        frame = self._env.render()
        self._facts = {
            FIRST_FRAME: frame_sha256(frame),
            **{f"visible_{side}": share for side, share in start["tile_visibility"].items()},
        }
        self._small_frames: list[NDArray[np.uint8]] = []
        self._keep_small()

    def advance(self, actions: Iterable[NDArray[np.float32]]) -> Answer:
        """Carry out actions until they or the episode end."""
        return self._carry_out(actions) or self._see()

    def dismiss(self) -> Ending:
        """End the episode without an action: its model was only captured. There is no outcome."""
        return Ending({"outcome": CAPTURE_ONLY, **self._facts}, self._frames, tuple(self._small_frames))

    def tile_masks(self) -> dict[Side, NDArray[np.bool_]]:
        """(H, W) where in the last picture each tile's own picture is seen."""
        return self._env.tile_masks()

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def _follow_script(self) -> Ending:
        mirrored = self._played.script == "expert-mirrored"
        script = Idle(self._env) if self._played.script == "idle" else ScriptedExpert(self._env, mirrored)
        script.reset()
        ending = None
        while ending is None:
            ending = self._carry_out([script.act()])
        return ending

    def _carry_out(self, actions: Iterable[NDArray[np.float32]]) -> Ending | None:
        for action in actions:
            if self._played.frames == "all" and self._env.trial.steps == len(self._small_frames):
                self._keep_small()  # before the action, when the picture of an inference exists
            _, terminated, truncated, _ = self._env.advance(action)
            self._recorder.note(action)
            self._shoot()
            if terminated or truncated:
                self._keep_small()
                trajectory = self._recorder.trajectory().frames
                outcome = {**_record(self._env), **self._facts}
                return Ending(outcome, self._frames, tuple(self._small_frames), trajectory)
        return None

    def _keep_small(self) -> None:
        if self._played.frames != "none":
            every = self._played.frames == "all"
            self._small_frames.append(self._env.render_small(FILM_HEIGHT) if every else shrink(self._env.render()))

    def _see(self) -> Observation:
        return self._observed(self._env.observe())

    def _observed(self, observation: Mapping[str, Any]) -> Observation:
        instruction = self.row.content.item.instruction
        return Observation(observation["pixels"]["image"], observation["agent_pos"], instruction, self._intrinsics)

    def _shoot(self) -> None:
        if self._film:
            self._frames.append(self._env.render())


def frame_sha256(frame: NDArray[np.uint8]) -> str:
    """Hex sha256 of a frame (H, W, 3) as rendered, before it is resized for a model: its shape and every byte."""
    return sha256(f"{frame.shape}".encode() + np.ascontiguousarray(frame).tobytes()).hexdigest()


def _record(env: Act2AnswerEnv) -> dict[str, Any]:
    """The outcome as flat columns, beside those the plan already has."""
    outcome = env.outcome().to_json()
    x, y = outcome.pop("cube_xy")
    return {
        "outcome": outcome.pop("zone"),
        "cube_x": x,
        "cube_y": y,
        **{key: value for key, value in outcome.items() if key not in ("layout", "side_correct")},
    }
