"""What serving costs: requests with and without capture, adding an episode, and opening a long run.

    python benchmarks/serve.py [--requests 200] [--episodes 2000] [--checkpoint DIR]

Requests alternate between captured and plain ones of one process, behind one socket; the median of their ratios is
printed. A quiet machine is assumed.
"""

import argparse
import asyncio
import statistics
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect

from probe_kit.extract import ExtractSettings
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.runs import open_run
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.serve.codec import pack, unpack
from probe_kit.serve.server import Server, open_server

MARK = "probe_kit/episode"


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


def ask(client: ClientConnection, message: dict[str, Any]) -> float:
    """Return the milliseconds of a request."""
    content, began = pack(message), perf_counter()
    client.send(content)
    answer = client.recv()
    took = 1000 * (perf_counter() - began)
    assert not isinstance(answer, str), answer
    assert "actions" in unpack(answer)
    return took


def requests(folder: Path, family: str, checkpoint: str | None, count: int) -> None:
    """Print the ratio of captured to plain requests: inferences 0, 2, 4 … of an episode are captured."""
    source = ServedSettings(
        cameras={} if checkpoint else {"base": "observation/image"},
        state="observation/state",
        source_name="bench",
        every=2,
    )
    settings = ExtractSettings(family, checkpoint, source=source, captured_calls=8)
    server = open_server(settings, str(folder / "requests"), "127.0.0.1", 0, None, {}, lambda _: None)
    state = np.array([0.39, 0.02, 0.08, 0, 0.05, 0, 0, 0.64])
    rng = np.random.default_rng(0)
    pairs, socket_only = [], []
    with serving(server) as address, connect(address, compression=None, max_size=None) as client:
        client.recv()
        for episode in range(-(-count // 8) + 1):
            picture = rng.integers(0, 256, (224, 224, 3), np.uint8)
            sent = {
                "observation/image": picture,
                "observation/state": state,
                "prompt": "put the cube on the red shape",
            }
            took = [ask(client, {**sent, MARK: {"id": f"e/{episode}"}}) for _ in range(16)]
            pairs += list(zip(took[::2], took[1::2], strict=True)) if episode else []
            socket_only.append(ask(client, {MARK: {"end": True}}))
    server.close()
    ratio = statistics.median(captured / plain for captured, plain in pairs)
    plain = statistics.median(plain for _, plain in pairs)
    print(f"{family}: {len(pairs)} pairs, plain {plain:.1f} ms, captured / plain {ratio:.3f}")
    print(f"an end (socket, codec and queue without the model): {statistics.median(socket_only):.2f} ms")


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
    took = []
    for number in range(episodes):
        columns = {
            "episode_id": f"task/{number}", "item_id": f"task/{number}", "category": "all", "group_id": "task",
            "instruction": "put it there", "content_blake2b": "0" * 32, "source_episode": number, "first_frame": 0,
            "frame_step": 1, "frames": 8, "policy_seed": number, "recorded_frames": 8,
        }  # fmt: skip
        began = perf_counter()
        row = writer.add(Row(-1, columns))
        took.append(perf_counter() - began)
        record = EpisodeRecord(row, {"outcome": "success"}, {}, [{}] * 8, control_steps=range(8), inputs=values)
        writer.write(replace(record))
    tail = max(1, min(200, episodes // 4))
    early, late = (1000 * statistics.median(part) for part in (took[:tail], took[-tail:]))
    began, worked = perf_counter(), process_time()
    opened = open_run(location)
    print(
        f"adding an episode: {early:.2f} ms at the first {tail}, {late:.2f} ms at the last of {episodes}; "
        f"opening {len(opened.episodes)} episodes: {perf_counter() - began:.2f} s, "
        f"{process_time() - worked:.2f} s of the processor"
    )


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=200, help="pairs of requests")
    parser.add_argument("--episodes", type=int, default=2000, help="episodes of the long run")
    parser.add_argument("--model", default="pi0-tiny")
    parser.add_argument("--checkpoint", default=None)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        adding(Path(name), arguments.episodes)
        requests(Path(name), arguments.model, arguments.checkpoint, arguments.requests)


if __name__ == "__main__":
    main()
