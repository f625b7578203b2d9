#!/usr/bin/env bash
# lerobot 0.6.1. lerobot_eval.rollout resets a vector environment at the start of each episode, and an EnvConfig makes that environment with
# Gymnasium's AutoresetMode.SAME_STEP, which has reset it already at the end of the episode before. An environment that takes its next stored start
# state at every reset, as benchmarks with a fixed list of start states do, is therefore evaluated on every second one.
# Seen: AutoresetMode.SAME_STEP; start states that were played in four episodes: [0, 2, 4, 6]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" lerobot[dataset]==0.6.1
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet lerobot[dataset]==0.6.1
fi
export HF_HUB_OFFLINE=1
cd "$folder"
cat >look.py <<'LOOK'
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import rollout

played = []


class Shelf(gym.Env):
    """Takes the next start state at every reset; an episode ends after three steps."""

    observation_space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(-1, 1, (2,), np.float32)})
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    task_description = task = "put it on the shelf"
    _max_episode_steps = 5
    start = -1
    steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start, self.steps = self.start + 1, 0
        return {"agent_pos": np.zeros(2, np.float32)}, {"is_success": False}

    def step(self, action):
        self.steps += 1
        if self.steps == 1:
            played.append(self.start)
        return {"agent_pos": np.zeros(2, np.float32)}, 0.0, self.steps == 3, False, {"is_success": False}


gym.register("gymnasium/Shelf-v0", Shelf)


@EnvConfig.register_subclass("shelf")
@dataclass
class ShelfConfig(EnvConfig):
    task: str = "Shelf-v0"
    fps: int = 10
    features: dict = field(default_factory=dict)
    package_name = "gymnasium"
    gym_id = "gymnasium/Shelf-v0"
    gym_kwargs = {}


class Still(torch.nn.Module):
    """A policy that never moves."""

    def reset(self):
        pass

    def select_action(self, batch):
        return torch.zeros(1, 2)


def unchanged(batch):
    return batch


shelf = ShelfConfig().create_envs(n_envs=1)["shelf"][0]
for _ in range(4):
    rollout(shelf, Still(), unchanged, unchanged, unchanged, unchanged)
print(f"{shelf.metadata['autoreset_mode']}; start states that were played in four episodes: {played}")
raise SystemExit(played != [0, 2, 4, 6])
LOOK
env/bin/python look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
