"""Inferences per second against the batch, and what a batch changes of the numbers.

    python benchmarks/throughput.py [--subjects tiny,large] [--batches 1,2,4,8,16] [--repeats 3] [--device cuda]

`tiny` is the embedded pi0-tiny. Every other name is a family at about 142 million random parameters; `large` is
pi0 (see `capture_subjects.py`). Every batch holds the same observations and seeds in the same order. Time is
processor time of one thread on a CPU, so that other jobs do not count, and wall time between synchronisations on a
GPU; the least of the repeats. `apart` is the largest difference of an action from that of the same observation and
seed alone, in the units of the action. A family whose card allows one observation per call is not batched.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from capture_subjects import WRITERS, written

from probe_kit.hooks import Observation, Policy, load_policy

BATCHES = (1, 2, 4, 8, 16)


def observations(count: int) -> list[Observation]:
    """Pictures of noise, each another, in the size that the scene renders."""
    rng = np.random.default_rng(0)
    state = np.array([0.29, 0.0, 0.13, 0.0, 0.0, 0.0, 0.0, 0.8], np.float32)
    words = ("Put the cube on the red shape", "Put the cube on the star")
    return [
        Observation(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), state, words[number % 2])
        for number in range(count)
    ]


def policy_of(subject: str, folder: Path, device: str) -> Policy:
    """A subject by its name."""
    if subject == "tiny":
        return load_policy("pi0-tiny", device=device)
    family = "pi0" if subject == "large" else subject
    options = {"statistics": "bridge"} if family == "pi0" else WRITERS[family][1]
    return load_policy(family, str(written(family, folder / subject)), device, random_weights=True, **options)


def seconds(policy: Policy, examples: list[Observation], repeats: int, device: str) -> float:
    """Of one call with these observations."""
    on_gpu = device.startswith("cuda")
    clock = time.perf_counter if on_gpu else time.process_time
    durations = []
    for _ in range(repeats):
        if on_gpu:
            torch.cuda.synchronize()
        began = clock()
        policy.act(examples, range(len(examples)))
        if on_gpu:
            torch.cuda.synchronize()
        durations.append(clock() - began)
    return min(durations)


def measure(policy: Policy, batches: list[int], repeats: int, device: str) -> None:
    """Print a line per batch."""
    most = policy.card.batch
    examples = observations(max(batches))
    alone = np.concatenate([policy.act([observation], [seed]) for seed, observation in enumerate(examples)])
    first = None
    for batch in batches:
        if most is not None and batch > most:
            print(f"  batch {batch:>3}: its card allows {most} per call, since more change its numbers")
            return
        spent = seconds(policy, examples[:batch], repeats, device)
        first = first or spent
        apart = float(np.abs(policy.act(examples[:batch], range(batch)) - alone[:batch]).max())
        print(
            f"  batch {batch:>3}: {1e3 * spent:9.1f} ms a call, {batch / spent:8.2f} inferences / s, "
            f"{first * batch / spent:5.2f} of batch 1; apart {apart:.1e}",
            flush=True,
        )


def main() -> None:
    """Every subject at every batch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", default="tiny,large")
    parser.add_argument("--batches", default=",".join(map(str, BATCHES)))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.device == "cpu":
        torch.set_num_threads(1)
    print(f"load {os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores; device {options.device}")
    with tempfile.TemporaryDirectory() as name:
        for subject in options.subjects.split(","):
            policy = policy_of(subject, Path(name), options.device)
            print(f"{subject}: {policy.card.family}, {policy.card.parameters / 1e6:.1f} million parameters")
            measure(policy, [int(text) for text in options.batches.split(",")], options.repeats, options.device)


if __name__ == "__main__":
    main()
