"""The environment: two pictures on a table, a cube, an arm, and an instruction that names one picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from probe_kit._system.counting import plural
from probe_kit._system.types import Matrix, PictureArray
from probe_kit.env.arm import DeltaController, check_action
from probe_kit.env.scene import SIDES, Scene
from probe_kit.env.scoring import LED_TO, REST_SPEED, Ending, Outcome, Trajectory, distance, zone
from probe_kit.env.simulation import LayeredFrame
from probe_kit.env.spec import XY, SceneSpec
from probe_kit.errors import EpisodeOverError, SceneError
from probe_kit.suite.items import LAYOUTS, Episode, Item, Layout, Side, other_side


@dataclass(frozen=True)
class Question:
    """An instruction with the picture of each side in one layout.

    Attributes:
        name: Name of the episode, `<item_id>:o` or `<item_id>:s`.
        pictures: RGB images by the side on which they lie *in this layout*.
        side_correct: Side of the correct picture, in this layout too.
    """

    name: str
    instruction: str
    pictures: Mapping[Side, Image.Image]
    side_correct: Side
    layout: Layout

    @classmethod
    def from_item(cls, item: Item, layout: Layout) -> Self:
        """Make the question of an item; an item without hashes is not checked.

        Raises:
            SuiteError: If a picture is missing or broken, or has other pixels than the item says.
        """
        from probe_kit.suite.pictures import load_picture

        episode = Episode(item, _check_layout(layout))
        left, right = (load_picture(episode.picture(side), episode.pixels_sha256(side) or None) for side in SIDES)
        return cls(
            episode.episode_id, item.instruction, {"left": left, "right": right}, episode.side_correct, layout
        )

    @classmethod
    def built_in(cls, layout: Layout = "original") -> Self:
        """Return a question with two plain pictures, without a suite: blue is correct, orange is wrong."""
        side: Side = "left" if _check_layout(layout) == "original" else "right"
        blue, orange = (Image.new("RGB", (64, 64), color) for color in ("royalblue", "darkorange"))
        pictures = {side: blue, other_side(side): orange}
        return cls(f"built-in:{layout[0]}", "Put the cube on the blue picture", pictures, side, layout)


def _check_layout(layout: Layout) -> Layout:
    if layout not in LAYOUTS:
        raise SceneError(f"layout {layout!r} does not exist; expected one of {', '.join(LAYOUTS)}.")
    return layout


# -- the trial ------------------------------------------------------------------------------------------------

FALLEN_BELOW = -0.05
"""Height of the cube, in metres, at which it has left the table."""
REST_STEPS = 5
"""Number of actions for which the cube must lie still, once released, for an early stop."""


class Trial:
    """An episode of one question, started in a scene that was just reset.

    The scene knows arm, cube and tiles; the trial knows the question, and by Act2Answer's rules when it is over.
    It is not called an episode, which is the planned question with its layout (`suite.items.Episode`).

    `executed` is the last action (7,) as executed, after the limits: no motion where the arm could not follow, and
    the real command of the gripper. It is None before the first action.
    """

    def __init__(self, scene: Scene, question: Question) -> None:
        self.scene = scene
        self.question = question
        self.controller = DeltaController(scene.arm, scene.spec.limits, scene.home_q, scene.spec.euler)
        self.executed: Matrix | None = None
        self.steps = 0
        self.clipped = 0
        self.ik_error = 0.0
        self.ending: Ending | None = None
        self.stopped_early = False
        self._start = self._cube_xy()
        self._was_grasped = scene.spec.start_grasped
        self._steps_at_rest = 0

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.stopped_early or self.ending is not None

    def advance(self, action: Matrix) -> None:
        """Execute one checked action (7,)."""
        move = self.controller.command(action)
        opening = 0.0 if self.steps < self.scene.spec.forced_closed else move.opening
        finite = self.scene.advance(move.q_from, move.q_to, opening)
        self.executed = np.concatenate([move.shift, move.turn, [opening]])
        self.steps += 1
        self.clipped += move.clipped
        self.ik_error = move.ik_error
        self.ending = self._find_ending(finite)
        self.stopped_early = self.scene.spec.early_stop and self.ending is None and self._came_to_rest()

    def outcome(self) -> Outcome:
        """Return the record of the episode at this moment."""
        scene, question = self.scene, self.question
        xy = self._cube_xy()
        to_correct = distance(xy, scene.tile_xy(question.side_correct))
        to_wrong = distance(xy, scene.tile_xy(other_side(question.side_correct)))
        return Outcome(
            zone=zone(to_correct, to_wrong, scene.spec.zone_radius),
            layout=question.layout,
            side_correct=question.side_correct,
            cube_xy=xy,
            cube_z=float(scene.cube_state().position[2]),
            distance_correct=to_correct,
            distance_wrong=to_wrong,
            epsilon=scene.spec.zone_radius,
            cube_moved=distance(xy, self._start) > scene.spec.moved,
            on_tile=scene.is_on_tile(),
            is_grasped=scene.is_grasped(),
            steps=self.steps,
            clipped=self.clipped,
            truncation_reason=self.ending,
        )

    def _find_ending(self, finite: bool) -> Ending | None:
        if not finite:
            return "non_finite"
        if self.scene.cube_state().position[2] < FALLEN_BELOW:
            return "cube_fell"
        return "max_steps" if self.steps >= self.scene.spec.max_steps else None

    def _came_to_rest(self) -> bool:
        """Whether the cube was in the hand, was released and has been still since for long enough."""
        grasped = self.scene.is_grasped()
        self._was_grasped |= grasped
        still = not grasped and self.scene.cube_state().speed < REST_SPEED
        self._steps_at_rest = self._steps_at_rest + 1 if self._was_grasped and still else 0
        return self._steps_at_rest >= REST_STEPS

    def _cube_xy(self) -> XY:
        x, y, _ = self.scene.cube_state().position
        return (float(x), float(y))


# -- the environment ------------------------------------------------------------------------------------------

Observation = dict[str, Any]
Info = dict[str, Any]
LARGEST_SHIFT, LARGEST_TURN = 1.0, float(np.pi)
"""Bounds of the action space, in metres and radians, where the scene limits no action."""


class Act2AnswerEnv(gym.Env[Observation, NDArray[np.float32]]):  # type: ignore[misc]
    """The environment: answer a question by putting the cube on one of two pictures.

    Observation: `pixels.image` (H, W, 3) uint8, and `agent_pos` (8,) float32. The latter starts with x, y, z of
    the tool in metres, and roll, pitch, yaw relative to pointing down in radians. Then come a zero that Bridge
    policies expect, and the opening of the gripper (1 open, 0 closed).

    Action (7,): xyz delta in metres and roll-pitch-yaw delta in radians along the fixed world axes, added to the
    last commanded pose, and the gripper. A gripper value above 0.5 opens it, any other closes it. One action takes
    0.2 s.

    Reward: 1.0 with the last action if the cube lies in the correct zone, otherwise 0.0.

    Reset options: `item` (an Item; without it two plain pictures) and `layout` ("original" or "swapped").

    The episode is truncated after `max_steps`, when the cube falls off the table or when the simulator breaks. It
    terminates only with `SceneSpec.early_stop`. One process can hold many environments, but the simulator holds
    Python's lock while it works: run in parallel with processes, not with threads.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, spec: SceneSpec | None = None, render_mode: str | None = "rgb_array") -> None:
        if render_mode not in (None, "rgb_array"):
            raise SceneError(f"render mode {render_mode!r} does not exist; use 'rgb_array'.")
        spec = spec or SceneSpec()
        self.scene_spec = spec
        self.render_mode = render_mode
        limits = spec.limits
        shift = LARGEST_SHIFT if limits.translation is None else limits.translation
        turn = LARGEST_TURN if limits.rotation is None else limits.rotation
        largest = [shift] * 3 + [turn] * 3
        self.action_space = spaces.Box(
            np.array([*np.negative(largest), 0.0], np.float32), np.array([*largest, 1.0], np.float32)
        )
        image = spaces.Box(0, 255, (*spec.picture_shape, 3), np.uint8)
        self.observation_space = spaces.Dict(
            {"pixels": spaces.Dict({"image": image}), "agent_pos": spaces.Box(-10.0, 10.0, (8,), np.float32)}
        )
        self._question = Question.built_in()
        self._scene: Scene | None = None
        self._trial: Trial | None = None
        self._frame: LayeredFrame | None = None
        self._closed = False

    # -- gymnasium ---------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Start an episode; `info["tile_visibility"]` is the share of each picture that the camera sees.

        Raises:
            SuiteError: For a missing or broken picture, before anything moved.
            SceneError: For an unknown option, before anything moved.
            EpisodeOverError: After `close`.
        """
        super().reset(seed=seed)
        if self._closed:
            raise EpisodeOverError("this environment was closed; make a new one.")
        self._question = _question(options or {})
        if self._scene is None:
            self._scene = Scene(self.scene_spec)
        self._trial = self._start(self._scene)
        observation = self.observe()
        return observation, self._info() | {"tile_visibility": self.scene.tile_visibility(self._current_frame())}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, Info]:
        """Execute one action (7,) and observe: `advance` and then `observe`."""
        reward, terminated, truncated, info = self.advance(action)
        return self.observe(), reward, terminated, truncated, info

    def render(self) -> PictureArray:
        """Return the picture (H, W, 3) uint8 of the scene now, as rendered."""
        # What a caller paints into it must not be what the next one sees.
        return self._current_frame().picture.copy()

    def render_small(self, height: int) -> PictureArray:
        """Return a picture (height, w, 3) uint8 of the scene now, for films and not for models.

        It is shrunk from that of `render` where that was drawn since the last action. Else it is drawn at this
        height. That takes an eighth of the time at a third of the height, and gives less smooth edges.
        """
        if self._frame is None:
            return self.scene.small_picture(height)
        size = (round(self.scene_spec.camera.width * height / self.scene_spec.camera.height), height)
        return np.asarray(Image.fromarray(self.render()).resize(size, Image.Resampling.BOX))

    def close(self) -> None:
        """Free the simulator; a second call does nothing."""
        if self._scene is not None:
            self._scene.close()
        self._scene, self._trial, self._closed = None, None, True

    # -- cheap stepping ----------------------------------------------------------------------------------

    def advance(self, action: ArrayLike) -> tuple[float, bool, bool, Info]:
        """Execute one action (7,) without drawing a picture: reward, terminated, truncated, info.

        A policy that executes a chunk of actions blindly needs a picture only before the next chunk, and drawing
        is most of the work.

        Raises:
            ActionError: For a bad action, with nothing moved.
            EpisodeOverError: Before `reset` or after the end.
        """
        trial = self.trial
        if trial.over:
            raise EpisodeOverError(
                f"the episode ended after {plural(trial.steps, 'step')}; call `reset` to start another."
            )
        trial.advance(check_action(action))
        self._frame = None
        info = self._info()
        return float(info["is_success"]), trial.stopped_early, trial.ending is not None, info

    def observe(self, number: int | None = None) -> Observation:
        """Return the observation now; draw the picture unless it was drawn since the last action.

        Args:
            number: The number of the observation in an episode that is played again, which decides the last bit of
                some colours; None for the next one.
        """
        if number is not None:
            self._frame = self.scene.frame(number)
        picture, size = self.render(), self.scene_spec.picture_size
        if size is not None:
            picture = np.array(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))
        arm = self.scene.arm
        agent_pos = np.concatenate([arm.tool_state(), [0.0, arm.opening()]]).astype(np.float32)
        return {"pixels": {"image": picture}, "agent_pos": agent_pos}

    def observe_exchanged(self) -> tuple[Observation, PictureArray]:
        """Return the observation with the two pictures in each other's place, and its picture as rendered.

        It shows the other layout of the item in this very state; the episode is unchanged.
        """
        before = self._current_frame()
        try:
            with self.scene.exchanged():
                self._frame = None
                return self.observe(), self.render()
        finally:
            self._frame = before

    def outcome(self) -> Outcome:
        """Return the record of the episode so far.

        Raises:
            EpisodeOverError: Before the first action.
        """
        if self.trial.steps == 0:
            raise EpisodeOverError("no action was executed yet, so there is no outcome; call `step` first.")
        return self.trial.outcome()

    # -- what experts and tools may look at, and policies may not ----------------------------------------

    @property
    def scene(self) -> Scene:
        """The simulated scene.

        Raises:
            EpisodeOverError: Before the first `reset`, or after `close`.
        """
        return self.trial.scene

    def tile_masks(self) -> dict[Side, NDArray[np.bool_]]:
        """Return masks (H, W) of where each tile's picture is seen in `observe`'s picture.

        Where that picture was shrunk, a pixel counts if any of it shows the tile's picture.
        """
        masks, size = self.scene.tile_masks(self._current_frame()), self.scene_spec.picture_size
        if size is None:
            return masks
        shrunk = {side: Image.fromarray(mask.astype(np.float32)) for side, mask in masks.items()}
        return {side: np.asarray(mask.resize(size, Image.Resampling.BOX)) > 0 for side, mask in shrunk.items()}

    @property
    def trial(self) -> Trial:
        """The running or finished episode.

        Raises:
            EpisodeOverError: Before `reset` or after `close`.
        """
        if self._trial is None:
            raise EpisodeOverError("there is no episode; call `reset` first (and not after `close`).")
        return self._trial

    @property
    def question(self) -> Question:
        """The question of the current episode."""
        return self._question

    # -- what lerobot reads ------------------------------------------------------------------------------

    @property
    def task_description(self) -> str:
        """The instruction of the current episode."""
        return self._question.instruction

    @property
    def task(self) -> str:
        """The name of the current episode, `<item_id>:o` or `<item_id>:s`."""
        return self._question.name

    @property
    def _max_episode_steps(self) -> int:
        return self.scene_spec.max_steps

    # -- inside ------------------------------------------------------------------------------------------

    def _start(self, scene: Scene) -> Trial:
        """Lay out the question; the start of the cube is drawn from the seed of the episode."""
        spec = self.scene_spec
        xy = np.array(spec.cube_xy) + self.np_random.uniform(-spec.start_jitter, spec.start_jitter, 2)
        yaw = spec.cube_yaw + self.np_random.uniform(-spec.start_jitter_yaw, spec.start_jitter_yaw)
        scene.reset(self._question.pictures, (float(xy[0]), float(xy[1]), spec.cube_start_z), float(yaw))
        if spec.closing_steps:
            scene.close_hand(spec.closing_steps)
        elif spec.start_grasped:
            scene.put_cube_in_hand()
        self._frame = None
        return Trial(scene, self._question)

    def _current_frame(self) -> LayeredFrame:
        scene = self.scene
        if self._frame is None:
            self._frame = scene.frame()
        return self._frame

    def _info(self) -> Info:
        trial, scene = self.trial, self.scene
        record = trial.outcome()
        return {
            "outcome": record.zone if trial.over else None,
            "is_success": trial.over and record.is_success,
            "cube_xy": np.array(record.cube_xy),
            "cube_z": record.cube_z,
            "distance_correct": record.distance_correct,
            "distance_wrong": record.distance_wrong,
            "tile_xy_correct": np.array(scene.tile_xy(record.side_correct)),
            "tile_xy_wrong": np.array(scene.tile_xy(other_side(record.side_correct))),
            "side_correct": record.side_correct,
            "side_placed": record.side_placed,
            "layout": record.layout,
            "is_grasped": record.is_grasped,
            "cube_moved": record.cube_moved,
            "on_tile": record.on_tile,
            "steps": record.steps,
            "clipped": record.clipped,
            "ik_error": trial.ik_error,
            "truncation_reason": record.truncation_reason,
        }


def _question(options: dict[str, Any]) -> Question:
    unknown = sorted(set(options) - {"item", "layout"})
    if unknown:
        raise SceneError(f"reset has no option {unknown[0]!r}; it takes 'item' and 'layout'.")
    layout = options.get("layout", "original")
    item = options.get("item")
    if item is None:
        return Question.built_in(layout)
    if not isinstance(item, Item):
        raise SceneError(f"reset option 'item' is a {type(item).__name__}; expected an Item of a suite.")
    return Question.from_item(item, layout)


# -- the recorder ---------------------------------------------------------------------------------------------


class Recorder:
    """A recorder of an environment's state, now and after every action; it changes nothing in the simulator.

    Args:
        env: An Act2AnswerEnv that was just reset, wrapped or not.
    """

    def __init__(self, env: Act2AnswerEnv) -> None:
        self._env: Act2AnswerEnv = env.unwrapped
        self._frames = [np.concatenate([_state(self._env.scene), np.full(LED_TO, np.nan)])]

    def note(self, commanded: ArrayLike) -> None:
        """Record the state after an action (7,) was executed."""
        trial = self._env.trial
        assert trial.executed is not None
        command = np.asarray(commanded, np.float64)
        self._frames.append(np.concatenate([_state(trial.scene), command, trial.executed, [trial.ik_error]]))

    def trajectory(self) -> Trajectory:
        """Return the trajectory up to the last noted action."""
        return Trajectory.of_frames(np.asarray(self._frames, np.float32))


def _state(scene: Scene) -> Matrix:
    """Return the state part of a frame; see `scoring.STATE`."""
    cube, tiles = scene.cube_state(), [scene.tile_state(side) for side in SIDES]
    return np.array(
        [
            *scene.arm.tool_state(),
            scene.arm.opening(),
            *cube.position,
            *cube.quaternion,
            cube.speed,
            *(value for tile in tiles for value in (*tile.position, *tile.quaternion)),
            *_finger_forces(scene),
            scene.is_grasped(),
            *(scene.touches_tile(side) for side in SIDES),
        ],
        np.float64,
    )


def _finger_forces(scene: Scene) -> list[float]:
    """Return the newtons with which each finger presses on the cube, summed over the points of contact."""
    contacts = scene.client.getContactPoints(bodyA=scene.arm.body, bodyB=scene.cube)
    return [sum(contact[9] for contact in contacts if contact[3] == finger) for finger in scene.arm.model.fingers]
