"""How fast the environment is, against a naive use of the same simulator, and what its pictures look like.

    python benchmarks/env.py speed                    # episodes per second, ms per frame, gain of a second core
    python benchmarks/env.py sheet docs/scenes.png    # every preset, arm, light, tile size and rendering at 224 px

The naive rival loads the scene anew for every episode and draws the whole picture after every action. Ours
restores a saved state, draws a picture every fifth action and lays robot, cube and tiles over the cached table.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
from PIL import Image, ImageDraw

from probe_kit._system.types import PictureArray
from probe_kit.env import Act2AnswerEnv, SceneSpec, ScriptedExpert
from probe_kit.env.scene import FLOOR_COLOR, INVISIBLE, TABLE_COLOR, Scene

SPEC = SceneSpec(start_jitter=0.02, start_jitter_yaw=1.5, early_stop=True)
OBSERVE_EVERY = 5
CELL = 224


class ExpertEnv(Act2AnswerEnv):
    """The environment with a method that plays expert episodes, for worker processes."""

    def play(self, count: int, first_seed: int = 0) -> int:
        """Play `count` episodes with an observation every fifth action; returns how many succeeded."""
        successes = 0
        for seed in range(first_seed, first_seed + count):
            self.reset(seed=seed)
            expert = ScriptedExpert(self)
            expert.reset()
            while not self.trial.over:
                self.advance(expert.act())
                if self.trial.steps % OBSERVE_EVERY == 0:
                    self.observe()
            successes += self.outcome().is_success
        return successes

    def play_timed(self, count: int) -> float:
        """Play `count` episodes; returns the CPU seconds they took in this process."""
        start = time.process_time()
        self.play(count)
        return time.process_time() - start


def naive_picture(scene: Scene) -> PictureArray:
    """The whole scene drawn in one go."""
    for body, color in ((scene.table, TABLE_COLOR), (scene.floor, FLOOR_COLOR)):
        scene.client.changeVisualShape(body, -1, rgbaColor=color)
    picture = scene.camera.render(scene.client, scene.spec.light, scene.spec.light_level).rgb
    for body in (scene.table, scene.floor):
        scene.client.changeVisualShape(body, -1, rgbaColor=INVISIBLE)
    return picture


def play_naively(count: int) -> int:
    """Play `count` episodes, each in a scene loaded for it, drawing after every action."""
    successes = 0
    for seed in range(count):
        env = Act2AnswerEnv(SPEC)
        env.reset(seed=seed)
        expert = ScriptedExpert(env)
        expert.reset()
        while not env.trial.over:
            env.advance(expert.act())
            naive_picture(env.scene)
        successes += env.outcome().is_success
        env.close()
    return successes


def seconds(work: Callable[[], object], clock: Callable[[], float], repeats: int = 3) -> float:
    """The shortest of some runs; other load on the machine only ever makes it longer."""
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)


def speed(episodes: int) -> None:
    """Print the comparison. One core in CPU seconds, the second core in wall seconds."""
    env = ExpertEnv(SPEC)
    if env.play(episodes) != episodes or play_naively(2) != 2:
        raise SystemExit(
            "an expert episode failed, so these speeds mean nothing; run the tests of the environment"
        )
    frames = [seconds(lambda draw=draw: draw(env), time.process_time, 20) for draw in (
        lambda env: naive_picture(env.scene), lambda env: env.scene.frame().picture)]  # fmt: skip
    naive = 2 / seconds(lambda: play_naively(2), time.process_time)
    ours = episodes / seconds(lambda: env.play(episodes), time.process_time)
    env.close()
    print(f"picture 640x480   naive {1e3 * frames[0]:6.1f} ms   ours {1e3 * frames[1]:6.1f} ms")
    print(f"expert episodes   naive {naive:6.2f} /s   ours {ours:6.2f} /s   {ours / naive:.1f} times, one core")
    (single, one_cpu), (two, two_cpu) = (workers(count, episodes) for count in (1, 2))
    print(f"worker processes  one   {single:6.2f} /s   two  {two:6.2f} /s   {two / single:.2f} times, wall clock")
    print(f"CPU per episode   one   {1e3 * one_cpu:6.0f} ms   two  {1e3 * two_cpu:6.0f} ms   "
          f"{2 * one_cpu / two_cpu:.2f} times on two idle cores")  # fmt: skip


def workers(count: int, episodes: int) -> tuple[float, float]:
    """Episodes per second of wall clock and CPU seconds per episode of `count` processes playing at once."""
    envs = gym.vector.AsyncVectorEnv([lambda: ExpertEnv(SPEC)] * count, context="forkserver")
    envs.call("play", 1)
    cpu: list[float] = []
    wall = seconds(lambda: cpu.append(max(envs.call("play_timed", episodes))), time.perf_counter)
    envs.close()
    return count * episodes / wall, min(cpu) / episodes


def label(text: str, color: str) -> Image.Image:
    """A picture with two large characters."""
    picture = Image.new("RGB", (256, 256), color)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((3, 3, 252, 252), outline="black", width=5)
    draw.text((128, 128), text, fill="black", font_size=150, anchor="mm")
    return picture


def sheet(path: Path) -> None:
    """Write the first frame of every kind of scene, as a policy sees it: squeezed to 224 x 224."""
    cells = {}
    for preset in ("bridge", "frontal", "vl-think"):
        for rendering in ("raw", "visual-matching"):
            cells[f"{preset}, {rendering}"] = SceneSpec.preset(preset, rendering=rendering)
    for level in (0.7, 1.3):
        cells[f"light {level:.0%}"] = SceneSpec(light_level=level)
    for preset in ("bridge", "frontal", "vl-think"):
        cells[f"{preset}, widowx"] = SceneSpec.preset(preset, arm="widowx")
    for arm in ("widowx", "panda"):
        cells[f"act2answer, {arm}"] = SceneSpec.preset("act2answer", arm=arm)
    for side in (0.1162, 0.2033):
        cells[f"act2answer, tile {side / 0.1452:.0%}"] = SceneSpec.preset("act2answer", tile_side=side)
    columns = 4
    rows = -(-len(cells) // columns)
    board = Image.new("RGB", (columns * (CELL + 8), rows * (CELL + 26)), "white")
    for i, (title, spec) in enumerate(cells.items()):
        corner = (i % columns * (CELL + 8) + 4, i // columns * (CELL + 26) + 22)
        board.paste(first_frame(spec), corner)
        ImageDraw.Draw(board).text((corner[0], corner[1] - 18), title, fill="black", font_size=13)
    board.save(path)


def first_frame(spec: SceneSpec) -> Image.Image:
    """What the camera sees before the first action."""
    scene = Scene(spec)
    pictures = {"left": label("7A", "#ffee77"), "right": label("R2", "#99e5ff")}
    scene.reset(pictures, (*spec.cube_xy, spec.cube_start_z), spec.cube_yaw)
    if spec.closing_steps:
        scene.close_hand(spec.closing_steps)
    picture = scene.frame().picture
    scene.close()
    return Image.fromarray(picture).resize((CELL, CELL), Image.Resampling.LANCZOS)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("speed").add_argument("--episodes", type=int, default=10)
    commands.add_parser("sheet").add_argument("path", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "speed":
        speed(arguments.episodes)
    else:
        sheet(arguments.path)


if __name__ == "__main__":
    main()
