"""What serving costs: requests with and without capture, adding an episode, and opening a long run.

    python benchmarks/serve.py [--requests 200] [--episodes 2000] [--wide LAYERS] [--only adding requests clients]

Requests alternate between captured and plain ones of one process, behind one socket; the median of their ratios is
printed, of wall time and of the processor time of the process, which other jobs of the machine change less.
"""

import argparse
import asyncio
import statistics
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from capture_subjects import FULL, WRITERS, written
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection, connect

from probe_kit.extract import ExtractSettings
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.hooks import Policy, load_policy
from probe_kit.runs import open_run
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.serve.codec import pack, unpack
from probe_kit.serve.server import Server, open_server

MARK = "probe_kit/episode"
PARTS, KEPT = ("adding", "requests", "clients"), ("small", "full")
WORDS = "put the cube on the red shape"


@contextmanager
def serving(server: Server) -> Iterator[str]:
    """Serve on a thread while the body runs."""
    ready = threading.Event()
    loops: list[asyncio.AbstractEventLoop] = []

    def began() -> None:
        loops.append(asyncio.get_running_loop())
        ready.set()

    thread = threading.Thread(target=server.serve, args=(None, began, print))
    thread.start()
    ready.wait()
    try:
        yield server.address
    finally:
        loops[0].call_soon_threadsafe(server.stop.set)
        thread.join()


def ask(client: ClientConnection, message: dict[str, Any]) -> tuple[float, float]:
    """Return the milliseconds of a request, of the clock and of the processor of client and server."""
    content, began, worked = pack(message), perf_counter(), process_time()
    client.send(content)
    answer = client.recv()
    took = 1000 * (perf_counter() - began), 1000 * (process_time() - worked)
    assert not isinstance(answer, str), answer
    assert "actions" in unpack(answer)
    return took


@dataclass(frozen=True)
class Served:
    """What is served, and what its clients send.

    Attributes:
        cameras: The cameras that get a picture of noise, 224 x 224.
        state: The state, near that of training.
        policy: The loaded policy.
        settings: Its settings but those of the source.
    """

    cameras: tuple[str, ...]
    state: NDArray[np.float64]
    policy: Policy
    settings: dict[str, Any]

    def server(self, out: Path, **choices: Any) -> Server:
        """Return a server; every second inference of an episode is captured, up to 8."""
        cameras = {camera: f"observation/{camera}" for camera in self.cameras}
        options = {"state": "observation/state", "source_name": "bench", "every": 2} | choices
        source = ServedSettings(cameras=cameras, **options)
        settings = ExtractSettings(**self.settings, source=source, captured_calls=8, accept_units=True)
        return open_server(settings, str(out), "127.0.0.1", 0, None, {}, lambda _: None, self.policy)

    def observation(self, number: int) -> dict[str, Any]:
        """Return the observation of a number."""
        rng = np.random.default_rng(number)
        pictures = {f"observation/{name}": rng.integers(0, 256, (224, 224, 3), np.uint8) for name in self.cameras}
        return {**pictures, "observation/state": self.state, "prompt": WORDS}


def tiny() -> Served:
    """Return pi0-tiny, the worst case: 44 sites on 0.8 M parameters."""
    state = np.array([0.39, 0.02, 0.08, 0, 0.05, 0, 0, 0.64])
    policy = load_policy("pi0-tiny")
    return Served(policy.card.cameras[:1], state, policy, {"model": "pi0-tiny"})


def wide(folder: Path, layers: int) -> Served:
    """Return golden π0's files at the released width, with so many layers in each network and random weights."""
    parts = {"vlm": {"depth": layers}, "expert": {"depth": layers}, "vision": {"layers": layers}}
    sizes = {name: {**values, **parts.get(name, {})} for name, values in FULL["pi0"]["dims.json"].items()}
    files = written("pi0", folder / "files", {"pi0": {**FULL["pi0"], "dims.json": sizes}})
    options = {**WRITERS["pi0"][1], "statistics": "none"}
    policy = load_policy("pi0", str(files), "cpu", None, random_weights=True, **options)
    assert policy.state_numbers is not None
    requested = {"checkpoint": str(files), "random_weights": True, "options": options, "device": "cpu"}
    return Served(policy.card.cameras, np.zeros(policy.state_numbers), policy, {"model": "pi0", **requested})


def play(client: ClientConnection, served: Served, name: str, inferences: int = 16) -> list[tuple[float, float]]:
    """Return the milliseconds of the requests of one episode, with that of its end."""
    number = int(name.rpartition("/")[2])
    took = [ask(client, {**served.observation(number), MARK: {"id": name}}) for _ in range(inferences)]
    return [*took, ask(client, {MARK: {"end": True}})]


def requests(folder: Path, served: Served, count: int, keep: str) -> None:
    """Print the ratio of captured to plain requests: inferences 0, 2, 4 … of an episode are captured."""
    server = served.server(folder / f"requests-{keep}", keep=keep)
    pairs = list[tuple[tuple[float, float], tuple[float, float]]]()
    ends, after_end = list[float](), list[float]()
    with serving(server) as address, connect(address, compression=None, max_size=None) as client:
        client.recv()
        for episode in range(-(-count // 8) + 1):
            *took, end = play(client, served, f"e/{episode}")
            if episode:  # the first one is checked and proved
                pairs += list(zip(took[::2], took[1::2], strict=True))
                ends.append(end[0])
                after_end.append(took[0][0] - statistics.median(wall for wall, _ in took[2::2]))
    server.close()
    wall, processor = (
        statistics.median(captured[clock] / plain[clock] for captured, plain in pairs) for clock in (0, 1)
    )
    plain_wall, plain_processor = (statistics.median(plain[clock] for _, plain in pairs) for clock in (0, 1))
    print(
        f"--keep {keep}: {len(pairs)} pairs, plain {plain_wall:.1f} ms, captured / plain {wall:.3f}; of the "
        f"processor {plain_processor:.1f} ms, {processor:.3f}"
    )
    print(
        f"  an end (socket, codec and queue without the model) {statistics.median(ends):.2f} ms; the first "
        f"request after one, while it is written, {statistics.median(after_end):+.2f} ms"
    )


def clients(folder: Path, served: Served, count: int) -> None:
    """Print the ratio of the time of three clients at once to that of the same episodes one after another."""
    ratios, worked = list[float](), list[float]()
    for block in range(max(3, count // 48)):
        server = served.server(folder / f"clients-{block}")
        with serving(server) as address, ExitStack() as stack:
            three = [stack.enter_context(connect(address, compression=None, max_size=None)) for _ in range(3)]
            for client in three:
                client.recv()
            play(three[0], served, "first/0", 2)
            began, before = perf_counter(), process_time()
            for number, client in enumerate(three):
                play(client, served, f"one-by-one/{number}")
            alone, began = perf_counter() - began, perf_counter()
            alone_work, before = process_time() - before, process_time()
            threads = [
                threading.Thread(target=play, args=(client, served, f"at-once/{number}"))
                for number, client in enumerate(three)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            ratios.append((perf_counter() - began) / alone)
            worked.append((process_time() - before) / alone_work)
        server.close()
    print(
        f"three clients at once / one after another: {statistics.median(ratios):.3f}, of the processor "
        f"{statistics.median(worked):.3f} ({len(ratios)} blocks)"
    )


def adding(folder: Path, episodes: int) -> None:
    """Print the milliseconds of adding an episode early and late, and the seconds of opening the run."""
    location = locate(folder / "added")
    inputs = {"prediction": [16, 7], "state": [8]}
    settings: dict[str, Any] = {
        "model": "none", "captured_calls": 8, "tokens": "pooled", "codec": "zstd", "random_weights": False,
        "weights_sha256": "0" * 64, "seed": 0, "capture_only": True,
        "dataset": {
            "kind": "served", "meta_blake2b": "0" * 32, "cameras": [], "inputs": inputs, "columns": [],
            "names": {},
        },
    }  # fmt: skip
    selection = {"recording": {"name": "bench", "episodes": []}}
    writer = RunWriter(location, Plan((), (), 0, {}, selection), settings)
    writer.begin()
    values = {"prediction": np.zeros((8, 16, 7), np.float32), "state": np.zeros((8, 8), np.float32)}
    took, worked = list[float](), list[float]()
    for number in range(episodes):
        columns = {
            "episode_id": f"task/{number}", "item_id": f"task/{number}", "category": "all", "group_id": "task",
            "instruction": "put it there", "content_blake2b": "0" * 32, "source_episode": number, "first_frame": 0,
            "frame_step": 1, "frames": 8, "policy_seed": number, "recorded_frames": 8,
        }  # fmt: skip
        began, before = perf_counter(), process_time()
        row = writer.add(Row(-1, columns))
        took.append(perf_counter() - began)
        worked.append(process_time() - before)
        record = EpisodeRecord(row, {"outcome": "success"}, {}, [{}] * 8, control_steps=range(8), inputs=values)
        writer.write(replace(record))
    tail = max(1, min(200, episodes // 4))
    parts = [
        1000 * statistics.median(times)
        for all_times in (took, worked)
        for times in (all_times[:tail], all_times[-tail:])
    ]
    began, before = perf_counter(), process_time()
    opened = open_run(location)
    print(
        "adding an episode: {:.2f} ms at the first {tail}, {:.2f} ms at the last of {episodes}; of the processor "
        "{:.2f} and {:.2f} ms".format(*parts, tail=tail, episodes=episodes)
    )
    print(
        f"opening {len(opened.episodes)} episodes: {perf_counter() - began:.2f} s, "
        f"{process_time() - before:.2f} s of the processor"
    )


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=200, help="pairs of requests")
    parser.add_argument("--episodes", type=int, default=2000, help="episodes of the long run")
    parser.add_argument(
        "--wide",
        type=int,
        metavar="LAYERS",
        help="serve π0's shapes at real width, with so many layers",
    )
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts that are run")
    parser.add_argument("--keep", nargs="+", choices=KEPT, default=KEPT, help="how pictures are stored")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "adding" in arguments.only and arguments.episodes:
            adding(folder, arguments.episodes)
        if not {"requests", "clients"} & set(arguments.only):
            return
        served = tiny() if arguments.wide is None else wide(folder, arguments.wide)
        print(f"{served.policy.card.family}: {served.policy.card.parameters / 1e6:.1f} M parameters")
        for keep in arguments.keep if "requests" in arguments.only else ():
            requests(folder, served, arguments.requests, keep)
        if "clients" in arguments.only:
            clients(folder, served, arguments.requests)


if __name__ == "__main__":
    main()
