"""What changing streams costs: one inference plain, with one site changed, and with all of them.

    python benchmarks/intervention_cost.py [--repeats 40] [--device cpu]

The embedded policy, one observation, one process, interleaved; prints the median processor time of each way and
its ratio to the plain one. Changes take tokens over from an inference before another picture, ledger included.
"""

import argparse
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
    every = ways(policy)
    times: dict[str, list[float]] = {name: [] for name in every}
    for repeat in range(arguments.repeats + 2):
        for name, run in every.items():
            start = time.process_time()
            run()
            if repeat >= 2:  # the first two warm up
                times[name].append(time.process_time() - start)
    plain = statistics.median(times["plain"])
    for name, found in times.items():
        middle = statistics.median(found)
        print(f"{name:26} {1000 * middle:8.2f} ms  {middle / plain:6.3f} of plain")


if __name__ == "__main__":
    main()
