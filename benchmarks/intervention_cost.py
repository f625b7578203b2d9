"""What changing streams costs: a clean inference, with one site changed, with joint places, and with gradients.

    python benchmarks/intervention_cost.py [--family pi0-tiny] [--pairs 200] [--device cpu]
    python benchmarks/intervention_cost.py --sweep FOLDER [--repeats 2]

The embedded policy, or another family at the size of `capture_subjects`; one observation, one process. Every pair
is a clean inference and a changed one, in drawn order, one directly behind the other, so that neighbours on the
machine disturb both alike. Prints, per way, the median of the pairs' ratios of processor time with its 95 %
bootstrap interval, and of the times themselves the ratio of medians and of lower fifths. The second plain way says
what the measurement itself adds. Changes take tokens over from an inference before another picture, with a ledger.
A joint condition patches the picture and the words of every block of `kv`. A knockout cuts the attention of the
expert to the picture, in one layer and in all, at every iteration. Gradients are of one number at all
sites of backbone and `kv`: an inference with a graph, and a backward pass. The machine's load is printed first.

`--sweep` times whole interventions on 12 items of Color instead, in turns: a knockout of image and language in all
windows with its controls, and an interchange of as many cells. It prints processor time of both and their ratio.
"""

import argparse
import os
import random
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from capture_subjects import LARGER, subject

from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import (
    AttentionCut,
    Observation,
    Policy,
    Site,
    capture,
    cut_attention,
    gradients_at,
    load_policy,
)
from probe_kit.hooks.capturing.edits import ReplaceWith, TokenSelection, apply_patch, apply_patches
from probe_kit.hooks.contract.sites import HEADS, KV
from probe_kit.intervene import Interchange, Knockout, run_intervention
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.runs import open_run

EMBEDDED = "pi0-tiny"
INSTRUCTION = "Put the cube on the red shape"


def policy_of(family: str, device: str) -> Policy:
    """The embedded one, or one with random weights."""
    if family == EMBEDDED:
        return load_policy(family, device=device)
    with tempfile.TemporaryDirectory() as folder:
        model = subject(family, Path(folder), device, None, 1).model
    assert isinstance(model, Policy)
    return model


def observations() -> tuple[Observation, Observation]:
    """Two pictures of noise, one state."""
    draw = np.random.default_rng(0)
    state = np.array([0.29, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    picture, other = (draw.integers(0, 256, (480, 640, 3), dtype=np.uint8) for _ in range(2))
    return Observation(picture, state, INSTRUCTION), Observation(other, state, INSTRUCTION)


def ways(policy: Policy) -> dict[str, Callable[[], object]]:
    """By name, what is timed."""
    observation, other = observations()
    backbone, expert = (policy.streams[name].sites() for name in ("backbone", "expert"))
    kv = [] if policy.prompt_kv is None else [site for name in KV for site in policy.prompt_kv.sites(name)]
    acting = [site for site in expert if site.layer == policy.streams["expert"].layers - 1]
    with capture(policy, [*backbone, *acting, *kv]) as source:
        policy.infer_without_acting([other], [0])
    roles = policy.roles([observation])

    def changed(sites: list[Site]) -> Callable[[], object]:
        tokens = TokenSelection.of(roles[sites[0].stream][0].valid, policy.card.device)

        def run() -> object:
            with apply_patch(policy, sites, tokens, ReplaceWith(source, tokens.count)) as edit_log:
                policy.infer_without_acting([observation], [0])
            assert edit_log.fires == len(sites)
            return edit_log

        return run

    def joint() -> object:
        prompt_roles = policy.roles([observation])["backbone"][0]
        cells = [TokenSelection.of(prompt_roles.mask(role), policy.card.device) for role in ("image", "language")]
        changes = {site: [(cell, ReplaceWith(source, cell.count)) for cell in cells] for site in kv}
        with apply_patches(policy, changes) as edit_log:
            policy.infer_without_acting([observation], [0])
        assert edit_log.fires == len(cells) * len(kv)
        return edit_log

    heads = policy.streams["expert"].sites(HEADS) if policy.streams["expert"].heads else []

    def cut(sites: Sequence[Site]) -> Callable[[], object]:
        cuts = dict.fromkeys(sites, AttentionCut(policy.roles([observation])["backbone"][0].mask("image")))

        def run() -> object:
            with cut_attention(policy, cuts) as edit_log:
                policy.infer_without_acting([observation], [0])
            return edit_log

        return run

    def slopes() -> object:
        return gradients_at(policy, [observation], [0], [*backbone, *kv], lambda chunks: chunks[0, :, 1].sum())

    joint_ways: dict[str, Callable[[], object]] = {}
    if kv:
        joint_ways[f"joint: 2 roles of {len(kv)} kv sites"] = joint
    if heads:
        layers = sorted({site.layer for site in heads})
        joint_ways["knockout in 1 layer"] = cut([site for site in heads if site.layer == layers[0]])
        joint_ways[f"knockout in {len(layers)} layers"] = cut(heads)
    if policy.interventions.gradients and policy.embodiment_mismatch() is None:
        joint_ways[f"gradients at {len(backbone) + len(kv)} sites"] = slopes
    return {
        "plain": lambda: policy.infer_without_acting([observation], [0]),
        "plain again": lambda: policy.infer_without_acting([observation], [0]),
        "one backbone site": changed(backbone[2:3]),
        f"all {len(backbone)} backbone sites": changed(backbone),
        f"expert's end, {len(acting)} iterations": changed(acting),
        **joint_ways,
    }


def main() -> None:
    """Time every way against plain."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", default=EMBEDDED, help=f"{EMBEDDED} or one of {', '.join(LARGER)}")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sweep", type=Path, default=None)
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.sweep is not None:
        time_sweeps(arguments.sweep, arguments.repeats)
        return
    policy = policy_of(arguments.family, arguments.device)
    every, draw = ways(policy), random.Random(0)
    print(f"load of the last minute: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    plain = every.pop("plain")
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in every}
    for pair in range(arguments.pairs + 2):
        for name, run in draw.sample(list(every.items()), len(every)):
            first = draw.random() < 0.5
            before = timed(plain) if first else 0.0
            baseline = timed(run)
            other = before if first else timed(plain)
            if pair >= 2:  # the first two warm up
                times[name].append((baseline, other))
    for name, pairs in times.items():
        baseline, other = (sorted(column) for column in zip(*pairs, strict=True))
        low, high = interval([changed / unchanged for changed, unchanged in pairs])
        print(
            f"{name:30} {1000 * statistics.median(baseline):8.2f} ms  of plain: "
            f"{statistics.median(changed / unchanged for changed, unchanged in pairs):6.3f} "
            f"[{low:.3f}, {high:.3f}] median of {len(pairs)} pairs, "
            f"{statistics.median(baseline) / statistics.median(other):6.3f} medians, "
            f"{fifth(baseline) / fifth(other):6.3f} lower fifths"
        )


SITES = ("backbone.*", "kv.*", "kv.00.values", "kv.01.values", "kv.02.values")
"""Ten places, each with three roles: as many cells as a knockout of two roles has cuts and controls."""


def time_sweeps(folder: Path, repeats: int) -> None:
    """Time a knockout of all windows and an interchange of as many cells, in turns; the run is made once."""
    if not (folder / "run").exists():
        settings = ExtractSettings(EMBEDDED, categories=("color",), items=12, max_steps=4, env_workers=0)
        extract_run(settings, folder / "run")
    seconds: dict[str, list[float]] = {"knockout": [], "interchange": []}
    for repeat in range(repeats):
        for name, times in seconds.items():
            copy = folder / f"{name}-{repeat}"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(folder / "run", copy)
            kind: Intervention = Knockout(roles=("image", "language"))
            if name == "interchange":
                kind = Interchange(sites=SITES, roles=("all", "image", "language"))
            start = time.process_time()
            result = run_intervention(open_run(copy), kind)
            times.append(time.process_time() - start)
            cells = sum(bool(cell.site) for cell in result.outcomes.cells)
            print(f"{name}: {cells} cells, {times[-1]:.1f} s of processor time", flush=True)
    ratios = [first / second for first, second in zip(*seconds.values(), strict=True)]
    print(f"knockout of interchange: {', '.join(f'{ratio:.2f}' for ratio in ratios)}")


def timed(run: Callable[[], object]) -> float:
    """Seconds of processor time."""
    start = time.process_time()
    run()
    return time.process_time() - start


def interval(ratios: Sequence[float]) -> tuple[float, float]:
    """95 % bootstrap interval of their median."""
    draws = np.random.default_rng(0).choice(np.array(ratios), (2000, len(ratios)))
    low, high = np.quantile(np.median(draws, axis=1), (0.025, 0.975))
    return float(low), float(high)


def fifth(times: Sequence[float]) -> float:
    """What a fifth of them stay below."""
    return sorted(times)[len(times) // 5]


if __name__ == "__main__":
    main()
