"""What the paper's whole study would take: a formula over measured inputs. An extrapolation, not a measurement.

    python benchmarks/cost_model.py [--gpus 1 8 64] [--set inference=0.1 cores=4 ...]

A worker has one GPU and some cores. Simulation, inference and writing overlap, so an episode takes as long as the
slowest of them:

    seconds per episode and worker =
        max(calls x inference / gain, simulate / cores, raw bytes / (writing cores x write))
    hours = models x episodes x that / GPUs + models x load x ceil(GPUs / models) / GPUs, at least one load
    disk  = models x episodes x (token bytes / ratio + 2 x pooled bytes / pooled_ratio + beside); columns are the 2

Calls per episode are those of the protocol: its actions, divided by how many of a chunk it executes. The first
table is the paper's whole evaluation, part by part. `--set` changes an input; every one is printed with where it
comes from. Bytes of activations are exact: the streams that the families declare for their released sizes.
"""

import argparse
from dataclasses import dataclass
from math import ceil

from probe_kit.env import SceneSpec
from probe_kit.hooks.contract.sites import view_names
from probe_kit.hooks.registry import known_families
from probe_kit.runs.layout import StoredStream

FAMILIES = ("pi0", "openvla")
ACTIONS = SceneSpec.preset("act2answer").max_steps
SUITE, CATEGORY = 3440, 300
"""Episodes of the paper's suite, and of one of its categories with 150 items."""


@dataclass(frozen=True)
class Part:
    """A part of the paper's evaluation: episodes, and inferences in each."""

    name: str
    episodes: int
    calls: int


STUDY = (
    Part("Table 2: seven VLAs, an inference per action", 7 * SUITE, ACTIONS),
    Part("Table 2: Xiaomi-R0, four actions per inference", SUITE, ACTIONS // 4),
    Part("Table 5: five settings, three VLAs, four categories", 5 * 3 * 4 * CATEGORY, ACTIONS),
    Part("Table 2: nine VLMs, a question in two orders", 9 * SUITE, 2),
    Part("Table 4: eight further rows of VLMs", 8 * SUITE, 2),
)


@dataclass(frozen=True)
class Input:
    """A number of the formula. source: where it was measured, or that it was not."""

    value: float
    unit: str
    source: str


INPUTS = {
    "episodes": Input(SUITE, "per model", "the paper's suite: 1,720 questions in two layouts"),
    "models": Input(7, "checkpoints", "the paper also has co-trained variants; an assumption"),
    "calls": Input(ACTIONS, "inferences per episode", "80 actions, 1 executed per inference; Xiaomi-R0: 20"),
    "inference": Input(0.3, "s on a GPU", "NOT MEASURED here (no GPU): an assumption, pass your own"),
    "gain": Input(1, "of a batch", "1: batch 1; benchmarks/throughput.py measures yours"),
    "simulate": Input(2.2, "CPU-s per episode", "act2answer, expert: 80 actions, a picture before each"),
    "cores": Input(8, "per GPU, that simulate", "an assumption about the machine"),
    "writing": Input(2, "cores per GPU, that write", "an assumption about the machine"),
    "write": Input(181e6, "raw bytes per CPU-s", "benchmarks/extract.py, --codec zstd, synthetic activations"),
    "ratio": Input(
        1.23, "raw bytes / stored", "benchmarks/extract.py, synthetic; storage design: 1.5 on a network"
    ),
    "pooled_ratio": Input(1.08, "raw bytes / stored", "benchmarks/full_run.py, noise"),
    "beside": Input(6400.0, "bytes per episode", "benchmarks/full_run.py: commit, frames, trajectory"),
    "load": Input(60, "s to load a model", "NOT MEASURED here at full size: an assumption"),
}


def raw_bytes(family: str, tokens: bool) -> int:
    """Of one episode with one captured inference."""
    return sum(stream.raw_bytes(tokens) for stream in streams_of(family))


def streams_of(family: str) -> list[StoredStream]:
    """What a run of the released size stores."""
    declared = known_families()[family].checkpoints.declared[""]
    return [
        StoredStream.of(declaration.stream, declaration.tokens, view_names(declaration.roles))
        for declaration in declared
    ]


@dataclass(frozen=True)
class Estimate:
    """Of the whole study. per_worker: seconds per episode; bound: what sets them."""

    per_worker: float
    bound: str
    hours: float
    disk: float


def estimate(inputs: dict[str, float], pooled: int, tokens: int, gpus: int) -> Estimate:
    """The formula of this file's first words. pooled, tokens: bytes per episode."""
    parts = {
        "inference": inputs["calls"] * inputs["inference"] / inputs["gain"],
        "simulation": inputs["simulate"] / inputs["cores"],
        "writing": (pooled + tokens) / (inputs["writing"] * inputs["write"]),
    }
    bound = max(parts, key=lambda name: parts[name])
    episodes = inputs["models"] * inputs["episodes"]
    loads = max(inputs["models"], gpus) * inputs["load"] / gpus
    seconds = ceil(episodes / gpus) * parts[bound] + loads
    stored = tokens / inputs["ratio"] + 2 * pooled / inputs["pooled_ratio"] + inputs["beside"]
    return Estimate(parts[bound], bound, seconds / 3600, episodes * stored)


def main() -> None:
    """Print the inputs, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", nargs="*", default=[], metavar="INPUT=VALUE")
    parser.add_argument("--gpus", type=int, nargs="*", default=[1, 8, 64])
    options = parser.parse_args()
    inputs = {name: setting.value for name, setting in INPUTS.items()}
    for text in options.set:
        name, _, value = text.partition("=")
        if name not in inputs:
            parser.error(f"{name!r} is no input; expected one of {', '.join(inputs)}")
        inputs[name] = float(value)
    for name, setting in INPUTS.items():
        source = setting.source if inputs[name] == setting.value else "given"
        print(f"{name:10}{inputs[name]:>14,g}  {setting.unit:26} {source}")
    print()
    for part in STUDY:
        print(_part(part.name, part.episodes, part.episodes * part.calls, inputs))
    episodes, calls = sum(part.episodes for part in STUDY), sum(part.episodes * part.calls for part in STUDY)
    print(_part("the whole evaluation, one GPU", episodes, calls, inputs))
    heads = ("family", "tokens", "GPUs", "MB raw / episode", "episodes / s", "hours", "disk TB", "bound by")
    print("\n" + _line(*heads))
    for family in FAMILIES:
        for tokens in (False, True):
            raw, pooled = raw_bytes(family, tokens), raw_bytes(family, False)
            for gpus in options.gpus:
                cost = estimate(inputs, pooled, raw - pooled, gpus)
                rate, hours = f"{gpus / cost.per_worker:.2f}", f"{cost.hours:.1f}"
                stored_tokens, disk = "all" if tokens else "pooled", f"{cost.disk / 1e12:.2f}"
                print(_line(family, stored_tokens, str(gpus), f"{raw / 1e6:.1f}", rate, hours, disk, cost.bound))


def _part(name: str, episodes: int, calls: int, inputs: dict[str, float]) -> str:
    hours = calls * inputs["inference"] / inputs["gain"] / 3600
    return f"{name:54}{episodes:>8,} episodes{calls:>11,} inferences{hours:>8.1f} h"


def _line(*cells: str) -> str:
    widths = (-8, -7, 5, 17, 13, 7, 8, -12)
    return " ".join(
        f"{cell:{'<' if width < 0 else '>'}{abs(width)}}" for cell, width in zip(cells, widths, strict=True)
    )


if __name__ == "__main__":
    main()
