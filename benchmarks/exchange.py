"""The processor time that an observation costs on its way from a simulator's process to the model's.

    python benchmarks/exchange.py [--observations 300]

Once large arrays pass through shared memory, as in a run, and once, through the same socket, as
`multiprocessing.connection` sends them. Both ends are timed; the two ways take turns.
"""

import argparse
import time
from statistics import median
from typing import Any

import numpy as np

from probe_kit._execution.process_pool import Child
from probe_kit.hooks.contract.observation import Observation

SIZES = (224, 224), (480, 640), (1080, 1920)
TURNS = 5
WAYS = "shared memory", "socket"


def serve(connection: Any) -> None:
    """Answer as many requests for observations as the parent says, then with the processor time they took."""
    while True:
        way, count, size = connection.recv()
        random = np.random.default_rng(0)
        observation = Observation(random.integers(0, 256, (*size, 3), np.uint8), np.zeros(8, np.float32), "")
        pipe = _pipe(connection, way)
        began = time.process_time()
        for _ in range(count):
            pipe.recv()
            pipe.send(observation)
        connection.send(time.process_time() - began)


def _pipe(connection: Any, way: str) -> Any:
    return connection if way == "shared memory" else connection._connection


def milliseconds(child: Child, way: str, count: int, size: tuple[int, int]) -> tuple[float, float]:
    """The processor time of one observation, in the model's process and in the simulator's."""
    child.connection.send((way, count, size))
    pipe = _pipe(child.connection, way)
    began = time.process_time()
    for _ in range(count):
        pipe.send(None)
        pipe.recv()
    ours = time.process_time() - began
    return 1000 * ours / count, 1000 * child.connection.recv() / count


def main() -> None:
    """Print the times and their ratios, by size of the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=300, help="observations of a turn")
    count = parser.parse_args().observations
    child = Child("exchange:serve")
    try:
        for height, width in SIZES:
            turns = [[milliseconds(child, way, count, (height, width)) for way in WAYS] for _ in range(TURNS)]
            shared, socket = (
                [median(end) for end in zip(*of_way, strict=True)] for of_way in zip(*turns, strict=True)
            )
            ratios = ", ".join(
                f"{end} {ours:.2f} of {theirs:.2f} ms ({ours / theirs:.2f})"
                for end, ours, theirs in zip(("model's process", "simulator"), shared, socket, strict=True)
            )
            print(f"{width} × {height}: {ratios}", flush=True)
    finally:
        child.close()


if __name__ == "__main__":
    main()
