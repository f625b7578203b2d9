"""A stage: one environment and its current episode, advanced by one chunk of actions at a time."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv, Idle, SceneSpec, ScriptedExpert
from probe_kit.env.recorder import Recorder
from probe_kit.errors import (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    ProbeKitError,
    RecordingError,
    SceneError,
    StageDiedError,
)
from probe_kit.extract.plan import PlannedEpisode
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import CAPTURE_ONLY, FrameChoice
from probe_kit.runs.small_frames import FILM_HEIGHT, SmallFrames, shrink
from probe_kit.suite.items import Side

# What one episode can get wrong by itself; everything else is wrong with the whole run and stops it.
EPISODE_ERRORS = (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    RecordingError,
    SceneError,
    StageDiedError,
)


@dataclass(frozen=True)
class Ending:
    """The end of an episode: its record as flat columns, a frame per action if it was filmed, its small frames.

    trajectory: (T + 1, C) float32; see `probe_kit.env.scoring.trajectory`. seconds: that the stage worked on the
    episode, by the wall clock. inputs: (n, …) by kind what was shown in n inferences, of recordings.
    """

    outcome: dict[str, Any]
    frames: list[NDArray[np.uint8]]
    small_frames: SmallFrames = ()
    trajectory: NDArray[np.float32] | None = None
    seconds: float = 0.0
    inputs: Mapping[str, NDArray[Any]] | None = None


@dataclass(frozen=True)
class Seen:
    """The first frame of an episode in which nothing moves. facts: what the run records of it.

    seconds: that the stage worked on it, by the wall clock.
    """

    observation: Observation
    facts: dict[str, Any]
    small_frames: SmallFrames = ()
    seconds: float = 0.0


Answer = Observation | Ending | Seen
_BEGINNINGS = ("begin", "look")


class TimedStage:
    """One source of observations with its current episode, and the seconds it worked on that."""

    _seconds = 0.0

    def timed(self, method: str, arguments: tuple[Any, ...]) -> Answer:
        """Call one of the methods below; what ends an episode says how many seconds all of its calls took."""
        if method in _BEGINNINGS:
            self._seconds = 0.0
        started = perf_counter()
        answer: Answer = getattr(self, method)(*arguments)
        self._seconds += perf_counter() - started
        return answer if isinstance(answer, Observation) else replace(answer, seconds=self._seconds)

    def close(self) -> None:
        """Free what it holds."""


class Stage(TimedStage):
    """Plays episodes in this process.

    script: `expert`, `expert-mirrored` or `idle` to let that script play every episode to its end at once.
    frames: which frames of an episode it ends with, in small.
    """

    def __init__(self, scene: SceneSpec, script: str | None, frames: FrameChoice = "none") -> None:
        self.script, self._kept = script, frames
        self._env, self._intrinsics = Act2AnswerEnv(scene), scene.intrinsics

    def begin(self, planned: PlannedEpisode, film: bool) -> Answer:
        """Set up an episode. Errors carry a note naming it."""
        self._film, self._frames = film, list[NDArray[np.uint8]]()
        self._planned = planned
        try:
            self._set_up(planned)
            self._recorder = Recorder(self._env)
            self._shoot()
            return self._see() if self.script is None else self._follow_script()
        except ProbeKitError as error:
            raise self._named(error) from None

    def look(self, planned: PlannedEpisode) -> Answer:
        """Set up an episode and show its first frame; nothing on it moves. Errors carry a note naming it."""
        self._planned = planned
        try:
            self._set_up(planned)
            return Seen(self._see(), self._facts, tuple(self._small_frames))
        except ProbeKitError as error:
            raise self._named(error) from None

    def look_swapped(self) -> Seen:
        """What the item's other layout shows in the state that this episode is in; facts: its hash alone."""
        observation, frame = self._env.observe_exchanged()
        return Seen(self._observed(observation), {"first_frame_sha256": frame_sha256(frame)})

    def _set_up(self, planned: PlannedEpisode) -> None:
        options = {"item": planned.episode.item, "layout": planned.episode.layout}
        _, start = self._env.reset(seed=planned.scene_seed, options=options)
        frame = self._env.render()
        self._facts = {
            "first_frame_sha256": frame_sha256(frame),
            **{f"visible_{side}": share for side, share in start["tile_visibility"].items()},
        }
        self._small_frames: list[NDArray[np.uint8]] = []
        self._keep_small()

    def advance(self, actions: Iterable[NDArray[np.float32]]) -> Answer:
        """Carry out actions until they or the episode end."""
        try:
            return self._carry_out(actions) or self._see()
        except ProbeKitError as error:
            raise self._named(error) from None

    def dismiss(self) -> Answer:
        """End the episode without an action: its model was only captured. There is no outcome."""
        return Ending({"outcome": CAPTURE_ONLY, **self._facts}, self._frames, tuple(self._small_frames))

    def tile_masks(self) -> dict[Side, NDArray[np.bool_]]:
        """(H, W) where in the last picture each tile's own picture is seen."""
        return self._env.tile_masks()

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def _follow_script(self) -> Ending:
        mirrored = self.script == "expert-mirrored"
        script = Idle(self._env) if self.script == "idle" else ScriptedExpert(self._env, mirrored)
        script.reset()
        ending = None
        while ending is None:
            ending = self._carry_out([script.act()])
        return ending

    def _carry_out(self, actions: Iterable[NDArray[np.float32]]) -> Ending | None:
        for action in actions:
            if self._kept == "all" and self._env.trial.steps == len(self._small_frames):
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
        if self._kept != "none":
            every = self._kept == "all"
            self._small_frames.append(self._env.render_small(FILM_HEIGHT) if every else shrink(self._env.render()))

    def _see(self) -> Observation:
        return self._observed(self._env.observe())

    def _observed(self, seen: Mapping[str, Any]) -> Observation:
        instruction = self._planned.episode.item.instruction
        return Observation(seen["pixels"]["image"], seen["agent_pos"], instruction, self._intrinsics)

    def _shoot(self) -> None:
        if self._film:
            self._frames.append(self._env.render())

    def _named(self, error: ProbeKitError) -> ProbeKitError:
        episode = self._planned.episode
        error.add_note(f"in episode {episode.episode_id} ({episode.item.instruction!r})")
        return error


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


StageRequest = tuple[str, tuple[Any, ...]]
"""A method of `Stage` and its arguments."""


StageKind = Callable[..., TimedStage]
"""What opens a stage: `Stage`, or the stage of another source. Child processes import it by its name."""


class AskableStage(Protocol):
    """A stage somewhere: asked first, answered later, so that several can work at a time."""

    def ask(self, method: str, *arguments: Any, then: StageRequest | None = None) -> None:
        """Start `Stage.begin`, `Stage.advance`, `Stage.dismiss` or `Stage.look`.

        then: what to start at once where that ends the episode, and only there; its answer is the next one.
        """

    def answer(self) -> Answer:
        """What the last question gave; raises what it raised."""

    def close(self) -> None:
        """Free what it holds."""


class LocalStage:
    """A stage in this process: the work is done when the answer is wanted."""

    def __init__(
        self, source: Any, script: str | None, frames: FrameChoice = "none", kind: StageKind = Stage
    ) -> None:
        """source: where observations come from, for `kind`: a SceneSpec for `Stage`."""
        self._stage = kind(source, script, frames)

    def ask(self, method: str, *arguments: Any, then: StageRequest | None = None) -> None:
        """Remember the question."""
        self._question, self._then = (method, arguments), then

    def answer(self) -> Answer:
        """Do the work."""
        method, arguments = self._question
        answer = self._stage.timed(method, arguments)
        if self._then is not None and isinstance(answer, Ending):
            self._question, self._then = self._then, None
        return answer

    def close(self) -> None:
        """Free the simulator."""
        self._stage.close()
