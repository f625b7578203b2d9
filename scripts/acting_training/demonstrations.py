"""Disturbed demonstrations on plain tiles; pictures are painted onto the tiles later."""

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from vlm_tiny_training.recorded import Recorded
from vlm_tiny_training.window import model_view

from acting_training.carrying import OPENED, Carrying
from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.env.scene import SIDES
from probe_kit.hooks.families.embedded import CHUNK

NOISE = 0.007
"""Standard deviation, metres, of what is added to an executed action of 4 cm or more."""
FULL_NOISE_FROM = 0.04
KICK, KICK_SHARE = 0.02, 0.2
"""Standard deviation, metres, of a disturbance while the cube is held, and how often there is one."""
DETOUR, DETOUR_SHARE = (0.03, 0.06, 0.03), 0.5
"""Standard deviation, metres, of where an episode is led astray to before it begins, and how often."""
START_JITTER = 0.001
PRESSED = 0.006
"""Metres below the goal to which a disturbance may press the cube; never deeper into the tile."""
LONGEST = 40
LIFTED = 4
"""Actions with the hand open after which an episode ends."""
RESTING = 0.004
RESTING_STRIDE = 3
"""While the hand waits over the tile to be let open, one frame in three is kept."""


@dataclass(frozen=True)
class Demonstrations(Recorded):
    """Every kept frame of every episode, as the policy sees it.

    Attributes:
        pictures: (F, 96, 96, 3) uint8.
        tiles: (F, 2, 96, 96) uint8, share of a pixel that shows the left and the right tile, times 255.
        states: (F, 8) float32.
        chunks: (F, 2, chunk, 7) float32, what leads from this frame to the left and to the right tile.
        side: (F,) int8, 0 left, 1 right, where the episode went.
        first: (F,) bool, whether an episode begins.
    """

    pictures: NDArray[np.uint8]
    tiles: NDArray[np.uint8]
    states: NDArray[np.float32]
    chunks: NDArray[np.float32]
    side: NDArray[np.int8]
    first: NDArray[np.bool_]


def training_scene() -> SceneSpec:
    """Where demonstrations are recorded: the released protocol, the start varied by a millimetre."""
    return SceneSpec.preset("act2answer", start_jitter=START_JITTER, max_steps=LONGEST)


class Recorder:
    """Records twins: two episodes that begin alike, one to each side."""

    def __init__(self) -> None:
        self._env = Act2AnswerEnv(training_scene())

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def twins(self, seed: int) -> Demonstrations | None:
        """Both episodes of one seed; None if one did not end on its tile."""
        left, right = (self._episode(seed, side) for side in (0, 1))
        return None if left is None or right is None else Demonstrations.joined([left, right])

    def _episode(self, seed: int, side: int) -> Demonstrations | None:
        env, rng = self._env, np.random.default_rng([seed, 1])
        env.reset(seed=seed, options={"layout": "original" if side == 0 else "swapped"})
        ways = [Carrying.to(env, name) for name in SIDES]
        detour = rng.normal(0, DETOUR) if rng.random() < DETOUR_SHARE else np.zeros(3)
        recorded, lifted, resting = [], 0, 0
        while lifted < LIFTED and env.trial.steps < LONGEST:
            position, opened = env.trial.controller.target.position, env.scene.arm.opening() > OPENED
            action = ways[side].action(position, opened)
            rests = not opened and float(np.linalg.norm(action[:3])) < RESTING
            resting = resting + 1 if rests else 0
            if resting % RESTING_STRIDE == (1 if rests else 0):
                recorded.append(
                    (*self._observation(), np.stack([way.ahead(position, opened, CHUNK) for way in ways]))
                )
            lifted += opened
            env.advance(self._disturbed(action, ways[side], position, opened, detour, rng))
            detour = np.zeros(3)
        if not lifted or env.outcome().zone != "correct" or env.outcome().is_grasped:
            return None
        columns = [np.array(column) for column in zip(*recorded, strict=True)]
        return Demonstrations(*columns, np.full(len(recorded), side, np.int8), np.arange(len(recorded)) == 0)

    def _disturbed(
        self,
        action: NDArray[np.float64],
        way: Carrying,
        position: NDArray[np.float64],
        opened: bool,
        detour: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> NDArray[np.float64]:
        """The action with noise that dies out where it is short, and now and then a kick."""
        noise = NOISE * min(1.0, float(np.linalg.norm(action[:3])) / FULL_NOISE_FROM) * rng.standard_normal(3)
        if not opened and rng.random() < KICK_SHARE:
            noise += KICK * rng.standard_normal(3)
        shift = action[:3] + noise + detour
        shift[2] = max(shift[2], way.goal[2] - PRESSED - position[2])
        return np.concatenate([shift, action[3:]])

    def _observation(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
        scene = self._env.scene
        frame = scene.frame()
        tiles = np.stack([model_view(255 * np.uint8(frame.bodies == scene.quads[name])) for name in SIDES])
        state = np.array([*scene.arm.tool_state(), 0.0, scene.arm.opening()], np.float32)
        return model_view(frame.picture), tiles, state


def record(path: Path, seeds: range, processes: int, report: Callable[[str], None]) -> Demonstrations:
    """A twin per seed, kept in `path`; recorded by several processes at once, in the order of the seeds."""
    if path.is_file():
        return Demonstrations.read(path)
    jobs = [(seeds[number::processes], report) for number in range(processes)]
    with get_context("fork").Pool(processes) as pool:
        twins_by_seed = {seed: twins for part in pool.starmap(_recorded, jobs, 1) for seed, twins in part}
    demonstrations = Demonstrations.joined([twins for seed in seeds if (twins := twins_by_seed[seed]) is not None])
    demonstrations.save(path)
    return demonstrations


def _recorded(seeds: range, report: Callable[[str], None]) -> list[tuple[int, Demonstrations | None]]:
    recorder, recorded = Recorder(), []
    for seed in seeds:
        recorded.append((seed, recorder.twins(seed)))
        report(f"demonstrations of seed {seed}: {'kept' if recorded[-1][1] else 'not on its tile'}")
    recorder.close()
    return recorded
