"""The wire of vla-eval: its harness plays gym-aloha, and its results say what the run says."""

import json
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import MissingExtraError, ObservationError, UsageError
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.hooks import Policy
from probe_kit.runs import open_run
from probe_kit.serve.server import open_server
from probe_kit.serve.vla_eval import read_metrics, read_start
from tests.support.client_environments import client_python, drawing, server_process
from tests.support.served_sessions import Opens, settings

SUPPORT = Path(__file__).parents[1] / "support"
PACKAGES = ("vla-eval==0.8.0", "gym-aloha==0.1.5")


# -- what the harness says ---------------------------------------------------------------------------------------


def test_an_episode_is_named_by_its_task_and_number() -> None:
    task = {"name": "open it", "suite": "libero_goal", "episode_idx": 3, "init": [0, 1]}
    mark = read_start({"task": task, "recording": {"eid": "0a", "sid": "s", "db_path": "/home"}})
    assert (mark.id, mark.group) == ("open it/3", "open it")
    assert mark.columns == {"task": "open it", "suite": "libero_goal", "eid": "0a"}
    assert read_start({"task": {"name": "open it", "episode_idx": 3}}).columns["eid"] == ""


@pytest.mark.parametrize(
    "message", [{}, {"task": 3}, {"task": {"name": "a"}}, {"task": {"name": "a\x07", "episode_idx": 0}}], ids=str
)
def test_a_start_without_task_or_number_is_refused(message: dict[str, Any]) -> None:
    with pytest.raises(ObservationError):
        read_start(message)


def test_numbers_and_truth_values_of_metrics_are_facts_and_others_are_named() -> None:
    metrics = {"success": np.float32(0.5), "reward": 1, "done": True, "text": "a", "lost": float("nan"), "map": {}}
    facts, left_out = read_metrics(metrics)
    assert facts == {"success": True, "reward": 1, "done": True}  # the harness counts bool(success)
    assert left_out == ["'text'", "'lost'", "'map'"]
    assert read_metrics(None) == ({}, [])


def test_the_wire_stands_at_this_machine_alone_and_takes_said_episodes(
    tmp_path: Path, opened: Opens, policy: Policy
) -> None:
    def serve(host: str = "127.0.0.1", token: Path | None = None, **metadata: Any) -> None:
        requested = settings(wire="vla-eval")
        open_server(requested, str(tmp_path / "run"), host, 0, token, metadata, lambda _: None, policy)

    with pytest.raises(UsageError, match="stands at 127"):
        serve("0.0.0.0")
    with pytest.raises(UsageError, match="stands at 127"):
        serve(token=tmp_path / "token")
    with pytest.raises(UsageError, match="--metadata is for clients of openpi"):
        serve(reset_pose=[0])
    with pytest.raises(UsageError, match="--execute does not apply with --wire openpi"):
        opened(execute=2)
    with pytest.raises(UsageError, match="--episodes words does not apply with --wire vla-eval"):
        ServedSettings(wire="vla-eval", rule="words")
    assert ServedSettings(wire="vla-eval", conditions=["none"]).says_episodes
    if find_spec("vla_eval") is None:
        with pytest.raises(MissingExtraError, match="vla_eval"):
            serve()


# -- the harness plays -------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with our packages, the harness and gym-aloha; skipped where these cannot be installed or drawn."""

    draws = "import vla_eval, gym_aloha, gymnasium as g; g.make('gym_aloha/AlohaTransferCube-v0').reset(seed=0)"
    if find_spec("vla_eval") and find_spec("gym_aloha"):
        return Path(sys.executable)
    return client_python(tmp_path_factory, "vla-eval", PACKAGES, draws, with_ours=True)


def environment() -> dict[str, str]:
    return drawing({"PYTHONPATH": str(SUPPORT)})


def served(python: Path, out: Path, port: str = "0") -> AbstractContextManager[tuple[subprocess.Popen[str], str]]:
    keys = ("--camera", "base=images/top", "--state", "states", "--accept-units", "--source", "aloha@1")
    counts = ("--captured-calls", "2", "--execute", "2")
    return server_process(out, "--wire", "vla-eval", "--port", port, *keys, *counts, python=python)


def shard(python: Path, url: str, out: Path, episodes: int, number: int, shards: int) -> subprocess.Popen[bytes]:
    words = [url, str(out), "evaluation", str(episodes), str(number), str(shards)]
    return subprocess.Popen(
        [str(python), "-m", "aloha_benchmark", *words],
        env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def results(python: Path, out: Path) -> dict[str, dict[str, Any]]:
    """The episodes of the harness's own results by their id."""
    words = ["-", str(out), "evaluation", "0", "results", "0"]
    printed = subprocess.run(
        [str(python), "-m", "aloha_benchmark", *words], env=environment(), capture_output=True, check=True
    )
    (benchmark,) = json.loads(printed.stdout.splitlines()[-1])
    return {episode["eid"]: episode for task in benchmark["tasks"] for episode in task["episodes"]}


@pytest.mark.slow
def test_two_shards_play_eight_episodes_whose_outcomes_are_those_of_the_harness(
    harness: Path, tmp_path: Path
) -> None:
    with served(harness, tmp_path / "run") as (server, url):
        shards = [shard(harness, url, tmp_path / "results", 8, number, 2) for number in range(2)]
        assert [each.wait(400) for each in shards] == [0, 0]
    assert server.returncode == 0
    run = open_run(tmp_path / "run")
    episodes = results(harness, tmp_path / "results")
    assert run.sealed
    assert sorted(run.episodes["episode_id"]) == [f"transfer the cube/{number}" for number in range(8)]
    assert {row["eid"] for row in run.episodes.to_dict("records")} == episodes.keys()
    for row in run.episodes.to_dict("records"):
        theirs = episodes[row["eid"]]
        assert (row["outcome"] == "success") == theirs["metrics"]["success"]
        assert row["env.cube"] == theirs["metrics"]["cube"]
        assert row["steps"] == theirs["steps"] == 4
        assert row["episode_id"] == f"{theirs['name']}/{theirs['episode_idx']}"
    assert len({theirs["metrics"]["success"] for theirs in episodes.values()}) == 2, "outcomes differ"
    assert len({theirs["sid"] for theirs in episodes.values()}) == 2, "both shards played"
    assert set(run.episodes["group_id"]) == {"transfer the cube"}
    assert run.control_steps.tolist() == [[0, 2]] * 8
    assert run.settings["execute"] == 2


@pytest.mark.slow
def test_the_rest_of_an_episode_whose_server_was_killed_has_no_row_and_the_next_ones_are_stored(
    harness: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    with served(harness, out) as (server, url):
        player = shard(harness, url, tmp_path / "results", 8, 0, 1)
        until = time.monotonic() + 200
        while len(list(out.glob("commits/*.json"))) < 2 and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(1)  # in the middle of the third or fourth one
        server.kill()
        server.wait(20)
    with served(harness, out, url.rpartition(":")[2]) as (server, again):
        assert again == url
        assert player.wait(400) == 0
    run = open_run(out, allow_partial=True)
    episodes = results(harness, tmp_path / "results")
    failed = {eid for eid, theirs in episodes.items() if theirs.get("failure_reason")}
    assert 1 <= len(failed) <= 2
    stored = set(run.episodes["eid"])
    assert stored.isdisjoint(failed)
    assert stored <= episodes.keys()
    assert len(stored) >= len(episodes) - len(failed) - 1  # the kill may cost one more
    assert run.episodes["episode_id"].is_unique


PLAYS = """
import asyncio, json, sys, urllib.error, urllib.request
import numpy as np
import websockets
from vla_eval.connection import Connection
from vla_eval.protocol.messages import MessageType

url = sys.argv[1]
start = {"task": {"name": "put it", "episode_idx": 0}}
state = np.array([.39, .02, .08, 0, .05, 0, 0, .64])

def sent(number, **changes):
    picture = np.random.default_rng(number).integers(0, 256, (48, 48, 3), np.uint8)
    words = "put the cube on the red shape"
    return {"images": {"top": picture}, "states": state, "task_description": words, **changes}

async def told(connection, message):
    try:
        return {name: np.shape(value) for name, value in (await connection.act(message)).items()}
    except RuntimeError as error:
        return str(error)

async def play():
    lines = []
    async with Connection(url, timeout=30) as connection:
        assert connection.server_info["observation_params"] == {"send_state": True}
        lines.append(await told(connection, sent(0)))
        await connection.start_episode({"task": {"name": "put it"}})
        lines.append(await told(connection, sent(0)))
        await connection.start_episode(start)
        lines.append(await told(connection, sent(0, images={})))
        lines.append(await told(connection, sent(0)))
        await connection.end_episode({"metrics": {"success": True}, "steps": 1})
        lines.append(await told(connection, sent(1)))
        await connection.start_episode({"task": {"name": "put it", "episode_idx": 1}})
        lines.append(await told(connection, sent(1)))
        await connection.start_episode(start)  # the second one was never ended
        lines.append(await told(connection, sent(0)))
    try:
        urllib.request.urlopen(url.replace("ws://", "http://") + "/config?max_batch_size=8")
    except urllib.error.HTTPError as error:
        lines.append(error.code)
    for refused in (b"\\xc1", bytes((16 << 20) + 1)):
        connection = await websockets.connect(url, max_size=None)
        await connection.send(refused)
        try:
            await connection.recv()
        except websockets.ConnectionClosed as closed:
            lines.append(closed.rcvd.code)
    try:
        await websockets.connect(url, origin="http://localhost:1")
    except websockets.InvalidStatus as refused:
        lines.append(refused.response.status_code)
    print(json.dumps(lines))

asyncio.run(play())
"""


@pytest.mark.slow
def test_a_request_outside_of_an_episode_is_an_error_and_the_connection_stays(
    harness: Path, tmp_path: Path
) -> None:
    with served(harness, tmp_path / "run") as (server, url):
        played = subprocess.run(
            [str(harness), "-c", PLAYS, url], env=environment(), capture_output=True, check=False, timeout=200
        )
    assert played.returncode == 0, played.stderr.decode()
    outside, unnamed, blind, first, ended, second, again, *codes = json.loads(played.stdout)
    for line, complaint in (
        (outside, "ObservationError: the observation belongs to no episode"),
        (unnamed, "the episode_idx None"),
        (blind, "the observation has no picture 'images/top'"),
        (ended, "belongs to no episode"),
    ):
        assert complaint in line
        assert "observation_failed: ObservationError" in line
    assert first == second == again == {"actions": [7]}
    assert codes == [400, 1007, 1009, 403]
    run = open_run(tmp_path / "run")
    assert run.episodes[["episode_id", "began", "ended", "outcome"]].to_numpy().tolist() == [
        ["put it/0", "said", "said", "success"],
        ["put it/1", "said", "start", "capture_only"],
        ["put it/0#2", "again", "connection", "capture_only"],
    ]
    assert server.returncode == 0
