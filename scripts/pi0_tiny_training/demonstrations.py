"""Noisy demonstrations of the scripted expert on plain tiles; pictures are painted onto the tiles later."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from vlm_tiny_training.recorded import Recorded

from pi0_tiny_training.window import seen_by_policy
from probe_kit.env import Act2AnswerEnv, SceneSpec, ScriptedExpert
from probe_kit.env.scene import SIDES
from probe_kit.models.pi0_tiny import CHUNK, IDLE_DIMS

NOISE = 0.007
"""Standard deviation, metres, of what is added to an executed action of 4 cm or more."""
FULL_NOISE_FROM = 0.04
TOLERANCE = 0.004
GRASP_HEIGHT = 0.022
KICK = 0.010
"""Standard deviation, metres, of a kick: a disturbance right beside a way-point, which the expert then mends."""
KICK_SHARE = 0.2
LONGEST = 60
IDLE_STEPS = 4
"""Idle actions after which a recording ends; more than the expert waits for the cube to settle."""


@dataclass(frozen=True)
class Demonstrations(Recorded):
    """Every frame of every episode, as the policy sees it.

    pictures: (F, 96, 96, 3) uint8. tiles: (F, 2, 96, 96) uint8, share of a pixel that shows the left and the
    right tile, times 255. states: (F, 8) float32. chunks: (F, chunk, 7) float32, clean actions from this frame
    on. side: (F,) int8, 0 left, 1 right. deciding: (F,) bool, whether the chunk gives the side away and the
    state does not.
    """

    pictures: NDArray[np.uint8]
    tiles: NDArray[np.uint8]
    states: NDArray[np.float32]
    chunks: NDArray[np.float32]
    side: NDArray[np.int8]
    deciding: NDArray[np.bool_]


@dataclass(frozen=True)
class Recording:
    """What to record: a twin per seed.

    start_grasped: begin with the cube in the hand. start_jitter: of the cube on the table, metres.
    misled: share of twins that begin with an empty, closed hand somewhere above the cube, as after a failed
    grasp. kicked: disturb a share of the actions by a kick.
    """

    seeds: range
    start_grasped: bool = False
    start_jitter: float = 0.0
    misled: float = 0.0
    kicked: bool = False


class Recorder:
    """Records twins: two episodes with the same jitter, one to each side, equal until they part."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._env = Act2AnswerEnv(
            SceneSpec(start_grasped=recording.start_grasped, start_jitter=recording.start_jitter, max_steps=100)
        )

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def twins(self, seed: int) -> Demonstrations | None:
        """Both episodes of one seed; None if the expert failed in one."""
        left, right = (self._episode(seed, side) for side in (0, 1))
        if left is None or right is None:
            return None
        together = min(len(left.chunks), len(right.chunks))
        apart = np.any(left.chunks[:together, 0] != right.chunks[:together, 0], axis=1)
        parting = int(apart.argmax())
        for twin in (left, right):
            twin.deciding[max(0, parting - CHUNK + 2) : parting + 1] = True
        return Demonstrations.joined([left, right])

    def _episode(self, seed: int, side: int) -> Demonstrations | None:
        env = self._env
        env.reset(seed=seed, options={"layout": "original" if side == 0 else "swapped"})
        rng = np.random.default_rng([seed, 1])
        if np.random.default_rng([seed, 2]).random() < self._recording.misled:
            self._close_above_cube(rng)
        expert = ScriptedExpert(env, grasp_height=GRASP_HEIGHT, tolerance=TOLERANCE)
        expert.reset()
        scene, arm = env.scene, env.scene.arm
        pictures, tiles, states, actions = [], [], [], []
        while len(actions) < LONGEST and not _at_rest(actions[-IDLE_STEPS:]):
            frame = scene.frame()
            pictures.append(seen_by_policy(scene.picture(frame)))
            tiles.append([seen_by_policy(255 * np.uint8(frame.bodies == scene.quads[name])) for name in SIDES])
            states.append(np.array([*arm.tool_state(), 0.0, arm.opening()], np.float32))
            actions.append(expert.act())
            env.advance(_disturbed(actions[-1], rng, self._recording.kicked))
        if env.outcome().zone != "correct":
            return None
        return _frames(np.array(pictures), np.array(tiles), np.array(states), np.array(actions), side)

    def _close_above_cube(self, rng: np.random.Generator) -> None:
        """Move the closed hand to a random place above the cube, without touching it."""
        cube = self._env.scene.cube_state().position
        goal = np.array([*(cube[:2] + rng.normal(0, 0.02, 2)), rng.uniform(0.06, 0.13)])
        for _ in range(4):
            shift = np.clip(goal - self._env.trial.controller.target.position, -0.05, 0.05)
            self._env.advance(np.array([*shift, 0, 0, 0, 0.0]))


def _disturbed(action: NDArray[np.float32], rng: np.random.Generator, kicked: bool) -> NDArray[np.float64]:
    """The action with noise that dies out near a way-point, and now and then a kick that does not."""
    noise = NOISE * min(1.0, float(np.linalg.norm(action[:3])) / FULL_NOISE_FROM) * rng.standard_normal(3)
    if kicked and rng.random() < KICK_SHARE and action[:3].any():
        noise += KICK * rng.standard_normal(3)
    return np.concatenate([action[:3] + noise, action[3:]]).astype(np.float64)


def _at_rest(actions: list[NDArray[np.float32]]) -> bool:
    return len(actions) == IDLE_STEPS and all(not action[:6].any() and action[6] > 0.5 for action in actions)


def _frames(
    pictures: NDArray[np.uint8],
    tiles: NDArray[np.uint8],
    states: NDArray[np.float32],
    actions: NDArray[np.float32],
    side: int,
) -> Demonstrations:
    length = len(actions)
    rest = np.zeros((CHUNK, actions.shape[1]), np.float32)
    rest[:, 6] = 1.0
    padded = np.concatenate([actions, rest])
    chunks = np.stack([padded[k : k + CHUNK] for k in range(length)])
    chunks[..., list(IDLE_DIMS)] = 0.0
    return Demonstrations(pictures, tiles, states, chunks, np.full(length, side, np.int8), np.zeros(length, bool))


def record(path: Path, recordings: Sequence[Recording], report: Callable[[str], None]) -> Demonstrations:
    """All twins of some recordings, kept in `path`."""
    if path.is_file():
        return Demonstrations.read(path)
    parts = []
    for recording in recordings:
        recorder = Recorder(recording)
        for number, seed in enumerate(recording.seeds):
            twins = recorder.twins(seed)
            parts += [twins] if twins else []
            report(f"{path.stem} {number + 1}/{len(recording.seeds)}, kept {len(parts)} in all")
        recorder.close()
    demonstrations = Demonstrations.joined(parts)
    demonstrations.save(path)
    return demonstrations
