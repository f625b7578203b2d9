"""The real openpi-client, in an environment of its own, which cannot share ours: it requires numpy below 2."""

import json
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from probe_kit.runs import open_run
from tests.support.client_environments import client_python, server_process

pytestmark = pytest.mark.slow
CLIENT = ("openpi-client==0.1.2", "numpy<2", "typing_extensions")
PLAYS = """
import json, sys
import numpy as np
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.websocket_client_policy import WebsocketClientPolicy

address, first, last = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
policy = WebsocketClientPolicy(address, None)
assert policy.get_server_metadata()["probe_kit"]["mark"] == "probe_kit/episode"
broker = ActionChunkBroker(policy, action_horizon=5)
sent = {}
for episode in range(first, last):
    broker.reset()
    rng = np.random.default_rng(episode)
    for step in range(10):  # two inferences
        spread = np.array([.03, .1, .03, 0, 0, 0, 0, .1])
        state = np.array([.39, .02, .08, 0, .05, 0, 0, .64]) + rng.normal(size=8) * spread
        observation = {
            "observation/image": rng.integers(0, 256, (64, 64, 3), np.uint8), "observation/state": state,
            "prompt": ["put the cube on the red shape", "put the cube on the blue shape"][episode % 2],
            "probe_kit/episode": {"id": f"task{episode % 2}/{episode}", "group": f"g{episode // 2}", "step": step},
        }
        action = broker.infer(observation)["actions"]
        if step % 5 == 0:
            sent.setdefault(f"task{episode % 2}/{episode}", []).append(np.asarray(action, np.float32).tolist())
    policy.infer({"probe_kit/episode": {"end": True, "facts": {"success": episode % 3 == 0}}})
print(json.dumps(sent))
"""


@pytest.fixture(scope="session")
def client(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with the client; the test is skipped where it cannot be installed."""
    return client_python(tmp_path_factory, "openpi-client", CLIENT, "import openpi_client")


def probe_kit(*words: str, codes: tuple[int, ...] = (0,)) -> str:
    ended = subprocess.run(
        [sys.executable, "-m", "probe_kit", *words],
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=600,
    )
    assert ended.returncode in codes, ended.stderr
    return ended.stdout


def served(out: Path, *options: str) -> AbstractContextManager[tuple[subprocess.Popen[str], str]]:
    keys = ("--camera", "base=observation/image", "--state", "observation/state")
    return server_process(out, "--port", "0", *keys, "--source", "noise@1", *options)


def play(python: Path, address: str, first: int, last: int) -> dict[str, list[list[float]]]:
    ended = subprocess.run(
        [python, "-c", PLAYS, address, str(first), str(last)],
        capture_output=True, encoding="utf-8", check=False, timeout=400,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    sent: dict[str, list[list[float]]] = json.loads(ended.stdout)
    return sent


def test_twenty_episodes_are_played_stored_probed_explained_and_exported(client: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with served(out, "--captured-calls", "2") as (server, address):
        sent = play(client, f"{address}/arm-1", 0, 20)
    assert server.returncode == 0
    run = open_run(out)
    assert run.sealed
    assert len(run.episodes) == 20
    assert run.inputs is not None
    for row, name in enumerate(run.episodes["episode_id"]):
        stored = run.inputs.row("prediction", row)[:, 0]
        assert stored.tolist() == sent[name]
    assert set(run.episodes["client"]) == {"arm-1"}
    assert run.control_steps.tolist() == [[0, 5]] * 20
    where = str(out)
    assert "every byte checked" in probe_kit("run", "verify", "--deep", where)
    assert "env.success" in probe_kit("targets", where)
    probe_kit("train", where, "--target", "env.success", "--permutations", "20")
    assert "env.success" in probe_kit("retention", where, "--target", "env.success")
    probe_kit("intervene", where, "--kind", "interchange", "--vary", "picture", "--items", "6")
    verdict = probe_kit("diagnose", where, "--frames", "6", codes=(0, 1))  # noise is not sure to move an action
    assert "picture" in verdict
    probe_kit("view", where, "--export", str(tmp_path / "page"))
    probe_kit("run", "export", where, "--format", "h5")
    assert "began: said 20; ended: said 20" in probe_kit("run", "show", where)


KILLS = 30


def test_a_server_that_is_killed_at_any_moment_loses_its_open_episode_alone(client: Path, tmp_path: Path) -> None:
    """Each server plays up to 20 episodes of the same ids until it is killed; the same command continues."""
    out, committed, moments = tmp_path / "run", dict[str, bytes](), np.random.default_rng(0)
    for attempt in range(KILLS):
        with served(out, "--captured-calls", "1") as (server, address):
            player = subprocess.Popen(
                [client, "-c", PLAYS, address, "0", "20"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            time.sleep(moments.uniform(0.5, 4))  # from before the first observation to after some episodes
            server.kill()
            player.wait(60)
        now = {path.name: path.read_bytes() for path in out.glob("commits/*.json")}
        assert committed.items() <= now.items(), f"kill {attempt} changed what was committed"
        committed = now
    with served(out, "--captured-calls", "1") as (_, address):
        play(client, address, 0, 2)
    run = open_run(out, allow_partial=True)
    assert run.episodes["episode_id"].is_unique
    assert len(run.episodes) == len(committed) + 2
    assert set(run.episodes["item_id"]) <= {f"task{number % 2}/{number}" for number in range(20)}
    assert len(run.failed) <= KILLS
    assert all(reason.startswith("the server ended before its commit") for reason in run.failed.values())
    assert "every byte checked" in probe_kit("run", "verify", "--deep", str(out))
