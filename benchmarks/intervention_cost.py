"""What changing streams costs: one inference plain, with one site changed, and with all of them.

    python benchmarks/intervention_cost.py [--repeats 40] [--device cpu]

The embedded policy, one observation, one process, ways in an order drawn for every repeat; prints the median
processor time of each way, and its ratio to the plain one: of medians, of lower fifths (what neighbours on the
machine disturb least), and the median of pairs. How far the second plain way is from 1 is the noise. Changes take
tokens over from an inference before another picture, ledger included.
"""

import argparse
import random
import statistics
import time
from collections.abc import Callable

import numpy as np

from probe_kit.hooks import Observation, Policy, Site, capture, load_policy
from probe_kit.intervene.patching import Replaced, patched

INSTRUCTION = "Put the cube on the red shape"


def observations() -> tuple[Observation, Observation]:
    """Two pictures of noise, one state."""
    draw = np.random.default_rng(0)
    state = np.array([0.29, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    own, other = (draw.integers(0, 256, (480, 640, 3), dtype=np.uint8) for _ in range(2))
    return Observation(own, state, INSTRUCTION), Observation(other, state, INSTRUCTION)


def ways(policy: Policy) -> dict[str, Callable[[], object]]:
    """By name, what is timed."""
    seen, other = observations()
    backbone = policy.streams["backbone"].sites()
    with capture(policy, backbone) as donor:
        policy.act([other], [0])
    mask = policy.roles([seen])["backbone"][0].valid

    def changed(sites: list[Site]) -> Callable[[], object]:
        def run() -> object:
            with patched(policy, sites, mask, Replaced(donor, mask.size)) as ledger:
                policy.act([seen], [0])
            assert ledger.fires == len(sites)
            return ledger

        return run

    return {
        "plain": lambda: policy.act([seen], [0]),
        "plain again": lambda: policy.act([seen], [0]),
        "one backbone site": changed(backbone[2:3]),
        f"all {len(backbone)} backbone sites": changed(backbone),
    }


def main() -> None:
    """Time every way in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    policy = load_policy("pi0-tiny", device=arguments.device)
    every, draw = ways(policy), random.Random(0)
    times: dict[str, list[float]] = {name: [] for name in every}
    for repeat in range(arguments.repeats + 2):
        for name, run in draw.sample(list(every.items()), len(every)):
            start = time.process_time()
            run()
            if repeat >= 2:  # the first two warm up
                times[name].append(time.process_time() - start)
    plain = times["plain"]
    for name, found in times.items():
        paired = statistics.median(own / other for own, other in zip(found, plain, strict=True))
        print(
            f"{name:26} {1000 * statistics.median(found):8.2f} ms  of plain: "
            f"{statistics.median(found) / statistics.median(plain):6.3f} medians, "
            f"{fifth(found) / fifth(plain):6.3f} lower fifths, {paired:6.3f} pairs"
        )


def fifth(times: list[float]) -> float:
    """What a fifth of them stay below."""
    return sorted(times)[len(times) // 5]


if __name__ == "__main__":
    main()
