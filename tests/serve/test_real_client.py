"""The real openpi-client, in an environment of its own, which cannot share ours: it requires numpy below 2."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect

from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.hooks import Policy, load_policy
from probe_kit.intervene.frame_session import Frames
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run, open_run
from tests.support.client_environments import ROOT, client_python, server_process
from tests.support.served_sessions import Opens, serving

pytestmark = pytest.mark.slow
CLIENT = ("openpi-client==0.1.2", "numpy<2", "typing_extensions")
PLAYS = """
import json, sys
import numpy as np
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.websocket_client_policy import WebsocketClientPolicy

address, first, last, sends = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), json.loads(sys.argv[4])
policy = WebsocketClientPolicy(address, None)
assert policy.get_server_metadata()["probe_kit"]["mark"] == "probe_kit/episode"
broker = ActionChunkBroker(policy, action_horizon=5)
sent = {}
for episode in range(first, last):
    broker.reset()
    rng = np.random.default_rng(episode)
    for step in range(10):  # two inferences
        state = np.array(sends["state"]) + rng.normal(size=8) * np.array(sends["spread"])
        observation = {
            **{key: rng.integers(0, 256, (64, 64, 3), np.uint8) for key in sends["pictures"]},
            "observation/state": state, "prompt": sends["words"][episode % 2],
            "probe_kit/episode": {"id": f"task{episode % 2}/{episode}", "group": f"g{episode // 2}", "step": step},
        }
        action = broker.infer(observation)["actions"]
        if step % 5 == 0:
            sent.setdefault(f"task{episode % 2}/{episode}", []).append(np.asarray(action, np.float32).tolist())
    policy.infer({"probe_kit/episode": {"end": True, "facts": {"success": episode % 3 == 0}}})
print(json.dumps(sent))
"""


@dataclass(frozen=True)
class Served:
    """A model, the keys of its cameras, and what a client sends it: states near those of its training."""

    name: str
    checkpoint: Path | None
    cameras: dict[str, str]
    state: tuple[float, ...]
    spread: tuple[float, ...]
    words: tuple[str, str]

    @property
    def options(self) -> tuple[str, ...]:
        """The options that choose the model and its inputs."""
        checkpoint = () if self.checkpoint is None else ("--checkpoint", str(self.checkpoint))
        cameras = (word for camera, key in self.cameras.items() for word in ("--camera", f"{camera}={key}"))
        return ("--model", self.name, *checkpoint, *cameras, "--state", "observation/state")

    @property
    def sends(self) -> str:
        """The arguments of the client: what it sends."""
        parts = {"state": self.state, "spread": self.spread, "words": self.words}
        return json.dumps({**parts, "pictures": list(self.cameras.values())})

    def load(self) -> Policy:
        """The policy, without a server."""
        checkpoint = None if self.checkpoint is None else str(self.checkpoint)
        return load_policy(self.name, checkpoint).with_cameras(list(self.cameras))


FRONT, WRIST = "observation/image", "observation/wrist_image"
TINY = Served(
    "pi0-tiny", None, {"base": FRONT}, (0.39, 0.02, 0.08, 0, 0.05, 0, 0, 0.64), (0.03, 0.1, 0.03, 0, 0, 0, 0, 0.1),
    ("put the cube on the red shape", "put the cube on the blue shape"),
)  # fmt: skip


@pytest.fixture(params=["pi0-tiny", "golden pi0"])
def model(request: pytest.FixtureRequest, golden_pi0: Path) -> Served:
    """The embedded model, and the reference of π0 with its two cameras."""
    if request.param == "pi0-tiny":
        return TINY
    words = ("put the red cube on the tray", "open the drawer")
    checkpoint = golden_pi0 / "checkpoint"
    return Served("pi0", checkpoint, {"top": FRONT, "wrist": WRIST}, (0.0,) * 8, (0.5,) * 8, words)


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
        timeout=1800,
    )
    assert ended.returncode in codes, ended.stderr
    return ended.stdout


def play(python: Path, address: str, first: int, last: int, model: Served) -> dict[str, list[list[float]]]:
    ended = subprocess.run(
        [python, "-c", PLAYS, address, str(first), str(last), model.sends],
        capture_output=True, encoding="utf-8", check=False, timeout=400,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    sent: dict[str, list[list[float]]] = json.loads(ended.stdout)
    return sent


def test_twenty_episodes_are_played_stored_probed_explained_and_exported(
    client: Path, tmp_path: Path, model: Served
) -> None:
    out = tmp_path / "run"
    options = ("--port", "0", "--source", "noise@1", "--captured-calls", "2", "--device", "cpu")
    with server_process(out, *options, *model.options) as (server, address):
        sent = play(client, f"{address}/arm-1", 0, 20, model)
    assert server.returncode == 0
    run = open_run(out)
    assert run.sealed
    assert len(run.episodes) == 20
    assert set(run.episodes["client"]) == {"arm-1"}
    assert run.control_steps.tolist() == [[0, 5]] * 20
    check_actions(run, sent, model.load())
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


def check_actions(run: Run, sent: dict[str, list[list[float]]], policy: Policy) -> None:
    """Compare what the client got with what the run stores, and with the same policy without capture or server."""
    assert run.inputs is not None
    for row, name in enumerate(run.episodes["episode_id"]):
        assert run.inputs.row("prediction", row)[:, 0].tolist() == sent[name]
    frames = Frames(run, ReplayFiles())
    assert len(frames.index) == 40
    with torch_threads(1):  # as a server of a small policy infers
        for frame in frames.index:
            assert frame.stored is not None
            assert policy.predict([frame.observation], [frame.seed])[0].tobytes() == frame.stored.tobytes()


FAULTS = """
import json, sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

address = sys.argv[1]
usual = np.array([0.39, 0.02, 0.08, 0, 0.05, 0, 0, 0.64])
right = {
    "observation/image": np.zeros((48, 48, 3), np.uint8), "observation/state": usual,
    "prompt": "put the cube on the red shape", "probe_kit/episode": {"id": "a"},
}
mark = "probe_kit/episode"
wrong = {
    "units": {**right, "observation/state": usual + 90, mark: {"id": "b"}},
    "camera": {key: value for key, value in right.items() if "image" not in key},
    "state": {key: value for key, value in right.items() if "state" not in key},
    "words": {key: value for key, value in right.items() if key != "prompt"},
    "size": {**right, "observation/image": np.zeros((24, 24, 3), np.uint8)},
    "dtype": {**right, "observation/image": np.zeros((48, 48, 3), np.float32)},
    "finite": {**right, "observation/state": usual * np.nan},
    "unmarked": {key: value for key, value in right.items() if key != mark},
    "mark": {**right, mark: {"name": "a"}},
    "end": {**right, mark: {"end": True}},
    "text": {**right, "observation/state": np.array(["a"] * 8)},
}
policy = WebsocketClientPolicy(address, None)
policy.infer(right)
lines = {}
for name, sent in wrong.items():
    try:
        policy.infer(sent)
    except RuntimeError as error:
        lines[name] = str(error).splitlines()[1:]  # its own first line says that the server refused
    assert policy.infer(right)["actions"].shape[0] > 1, name
try:
    policy.infer({**right, "observation/image": np.zeros((2400, 2400, 3), np.uint8)})
except Exception as error:
    lines["16 MiB"] = [str(error)]
print(json.dumps(lines))
"""


def test_every_fault_of_an_observation_is_a_line_and_the_next_one_is_answered(client: Path, opened: Opens) -> None:
    server = opened(captured_calls=1, rule="said")
    with serving(server) as address:
        played = subprocess.run(
            [client, "-c", FAULTS, address], capture_output=True, encoding="utf-8", check=False, timeout=300
        )
    assert played.returncode == 0, played.stderr
    lines = json.loads(played.stdout)
    expected = {
        "units": "other units or another robot", "camera": "no picture", "state": "no state", "words": "no words",
        "size": "the run stores pictures", "dtype": "float32 (48, 48, 3)", "finite": "NaN or infinity",
        "unmarked": "says no episode", "mark": "has the entry", "end": "beside an observation",
        "text": "has the type", "16 MiB": "1009",
    }  # fmt: skip
    assert lines.keys() == expected.keys()
    for name, complaint in expected.items():
        assert len(lines[name]) == 1, name
        assert complaint in lines[name][0], name
    assert server.session.refused >= len(expected) - 5
    run = server.close()
    assert run is not None
    assert run.episodes["episode_id"].tolist() == ["a"]


def test_a_model_that_takes_a_minute_answers_and_others_are_greeted_meanwhile(
    client: Path, opened: Opens, policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client's library gives a server up that answers no ping for 40 seconds."""
    server, predict, begun = opened(captured_calls=1), type(policy).predict, threading.Event()

    def slow(self: Policy, observations: Any, seeds: Any) -> Any:
        if not begun.is_set():
            begun.set()
            time.sleep(60)
        return predict(self, observations, seeds)

    monkeypatch.setattr(type(policy), "predict", slow)
    with serving(server) as address:
        player = subprocess.Popen([client, "-c", PLAYS, address, "0", "1", TINY.sends], stdout=subprocess.PIPE)
        assert begun.wait(60)
        began = time.monotonic()
        with connect(address) as second:
            second.recv(20)
        assert time.monotonic() - began < 1
        assert player.wait(200) == 0
    run = server.close()
    assert run is not None
    assert run.episodes[["episode_id", "inferences"]].to_numpy().tolist() == [["task0/0", 2]]


KILLS, EPISODES = 30, 20
LIVES = """
import os, sys
from probe_kit.hooks import load_policy
from probe_kit.serve.server import open_server
from tests.support.served_sessions import settings

policy = load_policy("pi0-tiny")
for line in sys.stdin:
    if (child := os.fork()) == 0:
        # Nothing of the parent but its policy is used: files and sockets are those of a server that starts.
        report = lambda line: None
        server = open_server(settings(captured_calls=1), sys.argv[1], "127.0.0.1", 0, None, {}, report, policy)
        server.serve(None, lambda: print(server.address, flush=True), print)
        server.close()
        os._exit(0)
    print(child, flush=True)
    os.waitpid(child, 0)
    print("ended", flush=True)
"""
PLAYS_ON = """
import contextlib, io, sys
plays = compile(sys.argv[1], "plays", "exec")
for line in sys.stdin:
    sys.argv[1:] = [line.strip(), "0", "20", sys.argv[-1]]
    with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
        exec(plays, {})
    print("over", flush=True)
"""


@contextmanager
def lines_of(*command: str | Path) -> Iterator[subprocess.Popen[str]]:
    """A process that reads and writes lines until the body ends."""
    process = subprocess.Popen(
        [str(word) for word in command],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8",
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        cwd=ROOT,
    )  # fmt: skip
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(60)


def read(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def tell(process: subprocess.Popen[str], line: str = "") -> None:
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


def time_of_commits(out: Path, count: int) -> float:
    """Wait for so many commits, and return the seconds that they took: a machine may be busy."""
    began = time.monotonic()
    while len(list(out.glob("commits/*.json"))) < count:
        assert time.monotonic() - began < 200
        time.sleep(0.01)
    return time.monotonic() - began


def test_a_server_that_is_killed_at_any_moment_loses_its_open_episode_alone(client: Path, tmp_path: Path) -> None:
    """Each server plays up to 20 episodes of the same ids until kill -9; the next one continues the run.

    One process has imported all and loaded the policy; each server is a fork of it, which makes 30 kills cheap.
    """
    out, moments, longest = tmp_path / "run", np.random.default_rng(0), 0.0
    committed, failed = dict[str, bytes](), set[str]()
    grown = []
    with (
        lines_of(sys.executable, "-c", LIVES, out) as lives,
        lines_of(client, "-c", PLAYS_ON, PLAYS, TINY.sends) as player,
    ):
        for attempt in range(KILLS):
            tell(lives)
            server, address = int(read(lives)), read(lives)
            failed_now = {path.name for path in out.glob("failed/*.json")}
            assert failed <= failed_now
            assert len(failed_now - failed) <= 1, f"the kill before attempt {attempt} failed more than one episode"
            tell(player, address)
            if attempt:
                time.sleep(moments.uniform(0, longest))  # from before the first observation to after some episodes
            else:
                longest = time_of_commits(out, 4)
            os.kill(server, signal.SIGKILL)
            assert read(lives) == "ended"
            assert read(player) == "over"
            now = {path.name: path.read_bytes() for path in out.glob("commits/*.json")}
            assert committed.items() <= now.items(), f"kill {attempt} changed what was committed"
            grown.append(len(now) - len(committed))
            committed, failed = now, failed_now
        tell(lives)
        server, address = int(read(lives)), read(lives)
        play(client, address, 0, 2, TINY)
        os.kill(server, signal.SIGINT)
        assert read(lives) == "ended"
    assert sum(count > 0 for count in grown) > KILLS / 4, "servers were killed while they played"
    run = open_run(out, allow_partial=True)
    assert run.episodes["episode_id"].is_unique
    assert len(run.episodes) == len(committed) + 2
    assert set(run.episodes["item_id"]) <= {f"task{number % 2}/{number}" for number in range(EPISODES)}
    assert all(reason.startswith("the server ended before its commit") for reason in run.failed.values())
    assert len(run.episodes) + len(run.failed) == run.planned
    print(f"{KILLS} kills: {len(committed)} episodes committed before, {len(run.failed)} failed records")
    assert "every byte checked" in probe_kit("run", "verify", "--deep", str(out))
