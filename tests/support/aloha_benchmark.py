"""A benchmark of the harness vla-eval around gym-aloha: what a user of that harness writes.

It runs in an environment with vla-eval and gym-aloha, and without probe_kit.
"""

import json
import sys
from pathlib import Path
from typing import Any

import anyio
import gym_aloha  # type: ignore[import-not-found]  # noqa: F401 - registers the environments
import gymnasium
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult  # type: ignore[import-not-found]
from vla_eval.orchestrator import Orchestrator  # type: ignore[import-not-found]
from vla_eval.results.export import export_eval  # type: ignore[import-not-found]

CUBE = 16
"""The position of the cube's first coordinate, in metres, among those of MuJoCo."""


class Aloha(StepBenchmark):  # type: ignore[misc]
    """Transfer of a cube; the policy has an arm of seven numbers, and the other arm rests."""

    def __init__(self, send_state: bool = False) -> None:
        super().__init__()
        self.send_state = send_state
        self.env = gymnasium.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos")

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "transfer the cube", "suite": "aloha"}]

    def reset(self, task: dict[str, Any]) -> Any:
        return self.env.reset(seed=task["episode_idx"])[0]

    def step(self, action: dict[str, Any]) -> StepResult:
        arm = np.asarray(action["actions"])
        assert arm.shape == (7,), arm.shape
        moved = np.concatenate([np.clip(arm, -1, 1), np.zeros(7)]).astype(np.float32)
        obs, reward, done, _, info = self.env.step(moved)
        return StepResult(obs, float(reward), bool(done), info)

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        del task
        picture = np.ascontiguousarray(raw_obs["pixels"]["top"][::4, ::4])
        state = {"states": raw_obs["agent_pos"][:8]} if self.send_state else {}
        return {"images": {"top": picture}, "task_description": "put the cube on the red shape", **state}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Success is where the cube lies: a random policy never transfers one, and outcomes shall differ."""
        cube = float(self.env.unwrapped._env.physics.data.qpos[CUBE])
        return {"success": cube > 0.1, "cube": cube, "reward": step_result.reward, "notes": "text is no metric"}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": 4}

    def cleanup(self) -> None:
        self.env.close()


def play(url: str, out: str, evaluation: str, episodes: int, shard: int, shards: int) -> None:
    """Play one shard of an evaluation."""
    entry = {"benchmark": f"{Path(__file__).stem}:Aloha", "episodes_per_task": episodes, "name": "aloha"}
    config = {"server": {"url": url, "timeout": 60}, "output_dir": out, "benchmarks": [entry]}
    anyio.run(Orchestrator(config, shard_id=shard, num_shards=shards, eval_id=evaluation).run)


if __name__ == "__main__":
    url, out, evaluation, episodes, shard, shards = sys.argv[1:]
    if shard == "results":
        print(json.dumps(export_eval(Path(out), evaluation)))
    else:
        play(url, out, evaluation, int(episodes), int(shard), int(shards))
