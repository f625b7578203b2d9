"""A client that names no episode: a session of gym-aloha over one connection of the real openpi-client."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from probe_kit.runs import open_run
from tests.support.client_environments import client_python, drawing, server_process

pytestmark = pytest.mark.slow
PACKAGES = ("gym-aloha==0.1.5", "openpi-client==0.1.2", "numpy<2", "typing_extensions")
EPISODES = 50
PLAYS = """
import json, sys
import gym_aloha, gymnasium
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

policy = WebsocketClientPolicy(sys.argv[1] + "/aloha", None)
env = gymnasium.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos")
counts, refused = [], 0
for episode in range(int(sys.argv[2])):
    seen, _ = env.reset(seed=episode)
    start, way = seen["agent_pos"].copy(), np.random.default_rng(episode).normal(size=14)
    counts.append(7 + episode % 2)
    for moved in range(counts[-1]):
        picture = np.ascontiguousarray(seen["pixels"]["top"][::4, ::4])
        words = "put the cube on the red shape"
        sent = {"observation/image": picture, "observation/state": seen["agent_pos"][:8], "prompt": words}
        try:
            actions = policy.infer(sent)["actions"]
        except RuntimeError as error:
            assert "says no episode" in str(error), error
            refused += 1
            break
        target = start + 0.12 * (moved + 1) * way / np.linalg.norm(way[:6])  # smooth, as a replayed reach
        if sys.argv[3] == "jerky":  # the actions of a policy that knows nothing of this robot, times five
            target[:7] = 5 * actions[0][:7]
        seen = env.step(np.clip(target, -1, 1).astype(np.float32))[0]
print(json.dumps([counts, refused]))
"""


@pytest.fixture(scope="session")
def aloha(tmp_path_factory: pytest.TempPathFactory) -> Path:
    draws = (
        "import openpi_client, gym_aloha, gymnasium as g; g.make('gym_aloha/AlohaTransferCube-v0').reset(seed=0)"
    )
    return client_python(tmp_path_factory, "unmarked-aloha", PACKAGES, draws)


def play(python: Path, out: Path, episodes: int, motion: str, *options: str) -> tuple[list[int], int]:
    keys = ("--camera", "base=observation/image", "--state", "observation/state", "--accept-units")
    with server_process(out, "--port", "0", *keys, "--captured-calls", "1", *options) as (server, address):
        played = subprocess.run(
            [str(python), "-c", PLAYS, address, str(episodes), motion],
            env=drawing(), capture_output=True, check=False, timeout=560,
        )  # fmt: skip
    assert played.returncode == 0, played.stderr.decode()
    assert server.returncode == 0
    counts, refused = json.loads(played.stdout.splitlines()[-1])
    return counts, refused


@pytest.mark.parametrize("motion", ["smooth", "jerky"])
def test_no_row_holds_two_episodes_and_all_rows_are_one_group(aloha: Path, tmp_path: Path, motion: str) -> None:
    counts, refused = play(aloha, tmp_path / "run", EPISODES, motion)
    assert (len(counts), refused) == (EPISODES, 0)
    run = open_run(tmp_path / "run")
    ends = np.cumsum(run.episodes["inferences"]).tolist()
    assert ends[-1] == sum(counts)
    missed = set(np.cumsum(counts).tolist()) - set(ends)
    extra = set(ends) - set(np.cumsum(counts).tolist())
    assert (missed, extra) == (set(), set()), "every end of an episode is the end of a row, and nothing else is"
    assert set(run.episodes["group_id"]) == {"aloha"}
    assert not run.episodes["marked"].any()


def test_with_said_episodes_nothing_of_such_a_client_is_stored(aloha: Path, tmp_path: Path) -> None:
    counts, refused = play(aloha, tmp_path / "run", 3, "smooth", "--episodes", "said")
    assert refused == len(counts) == 3
    assert not (tmp_path / "run" / "commits").exists()
