"""How fast runs are written and read: codecs, columns against rows and plain files, and the real loop.

    python benchmarks/extract.py [--episodes 860] [--width 512] [--loop 8] [--repeats 5] [--only loop]

Rivals of the columns hold the same float32 numbers: HDF5 (if h5py is there) and one .npy per episode. The loop is
the real one with a pi0 of 66 million random parameters on the CPU.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tests_of_checkout  # noqa: F401
import zarr

from probe_kit.env import SceneSpec
from probe_kit.extract import Extraction, ExtractSettings, prepare
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.hooks import Observation
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families import embedded as tiny
from probe_kit.hooks.families.pi0.network import Pi0Size, build_pi0
from probe_kit.hooks.families.shared.lerobot.paligemma import GemmaSize, SiglipSize
from probe_kit.models.building import initialise
from probe_kit.runs import open_run, seal
from probe_kit.runs.layout import CODECS, StoredStream
from probe_kit.runs.plan import Plan
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite, build_suite
from tests.support.plans import make_plan

LAYERS, VIEWS, TOKENS = 19, ("mean", "last", "mean:language", "mean:image"), 816
SITE = Site("backbone", 11)


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Wall-clock and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def activations(draw: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Residual-like numbers: every channel has a scale of its own, a few of them large."""
    scale = np.exp(np.random.default_rng(0).normal(size=shape[-1]))
    return (draw.normal(size=shape) * scale).astype(np.float32)


def synthetic(plan: Plan, stream: StoredStream, number: int, with_tokens: bool) -> EpisodeRecord:
    """One episode of such numbers."""
    draw = np.random.default_rng(number)
    buffers = EpisodeBuffers([stream], 1, with_tokens, pinned=False)
    buffers.pooled[stream.name][:] = activations(draw, buffers.pooled[stream.name].shape)
    if with_tokens:
        bits = activations(draw, (*stream.lead, stream.tokens, stream.width)).view(np.uint32) >> 16
        buffers.tokens[stream.name][0][..., : stream.tokens, :] = bits
    buffers.roles.append({stream.name: [("image.main", 0, 768), ("language", 768, stream.tokens)]})
    return buffers.record(plan.episodes[number], {"outcome": "oob"}, control_steps=[0])


def bench_codecs(suite: Suite, folder: Path, width: int) -> None:
    """Tokens of four episodes through the whole write path, codec, checksums and commits included."""
    stream = StoredStream("backbone", LAYERS, width, None, TOKENS, VIEWS)
    plan = make_plan(suite, [stream], 0, 1, True)
    rollouts = [synthetic(plan, stream, number, True) for number in range(4)]
    raw = 4 * LAYERS * TOKENS * width * 2 / 1e6
    disk = disk_rate(folder / "plain", rollouts)
    print(
        f"\ntokens, {raw:.0f} MB in 4 episodes; the disk takes the same bytes as plain files, flushed, at "
        f"{disk:.0f} MB/s\ncodec   ratio   write MB/s (per CPU-s)   of the disk's   read a layer ms/episode"
    )
    for codec in CODECS:
        bench_codec(codec, plan, rollouts, folder / codec, raw, disk)


def disk_rate(folder: Path, rollouts: list[EpisodeRecord]) -> float:
    """MB per second of the same tokens in one plain file per episode, each flushed to the disk."""
    folder.mkdir()
    arrays = [rollout.arrays["tokens"]["backbone"][0, :, :TOKENS] for rollout in rollouts]

    def write() -> None:
        for number, array in enumerate(arrays):
            with (folder / f"{number}.bin").open("wb") as file:
                file.write(np.ascontiguousarray(array))
                os.fsync(file.fileno())

    wall, _ = seconds(write)
    return sum(array.nbytes for array in arrays) / 1e6 / wall


def bench_codec(
    codec: str, plan: Plan, rollouts: list[EpisodeRecord], path: Path, raw: float, disk: float
) -> None:
    """One line of the table of codecs."""
    writer = RunWriter(
        locate(path), plan, {"captured_calls": 1, "tokens": "all", "codec": codec, "model": "synthetic"}
    )
    wall, cpu = seconds(lambda: [writer.write(rollout) for rollout in rollouts])
    size = sum(p.stat().st_size for p in (path / "data.zarr/backbone/tokens").rglob("*") if p.is_file())
    run = open_run(path, allow_partial=True)
    read, _ = seconds(lambda: run.tokens(SITE))
    rates = f"{raw / wall:12.0f} ({raw / cpu:.0f}) {raw / wall / disk:15.2f} x"
    print(f"{codec:6} {raw * 1e6 / size:6.2f} {rates} {1e3 * read / 4:18.1f}")


def bench_columns(suite: Suite, folder: Path, episodes: int, width: int) -> None:
    """One view of one layer of every episode, four ways."""
    stream = StoredStream("backbone", LAYERS, width, None, TOKENS, VIEWS)
    plan = make_plan(suite, [stream], 0, 1, False)
    settings = {"captured_calls": 1, "tokens": "pooled", "codec": "zstd", "model": "synthetic"}
    writer = RunWriter(locate(folder / "columns"), plan, settings)
    for number in range(episodes):
        writer.write(synthetic(plan, stream, number, False))
    rows = open_run(folder / "columns", allow_partial=True).rows("backbone")
    values = np.stack([rows[position] for position in range(episodes)])
    print(f"\none column of {episodes} episodes, {values.nbytes / 1e6:.0f} MB in all\nstore            ms")
    as_rows, _ = seconds(lambda: [row.read(i, (0, 11, 0)) for row in (rows,) for i in range(episodes)])
    print(f"rows      {1e3 * as_rows:9.1f}")
    sealing, _ = seconds(lambda: seal(folder / "columns"))
    run = open_run(folder / "columns", allow_partial=True)
    assert run.sealed
    sealed = min(seconds(lambda: run.column(SITE))[0] for _ in range(5))
    print(f"columns   {1e3 * sealed:9.1f}   ({as_rows / sealed:.0f} x rows; sealing took {sealing:.1f} s)")
    for number, row in enumerate(values):
        np.save(folder / f"{number}.npy", row)
    npy, _ = seconds(
        lambda: [np.load(folder / f"{n}.npy", mmap_mode="r")[0, 11, 0].copy() for n in range(episodes)]
    )
    print(f".npy      {1e3 * npy:9.1f}   (memory-mapped, one file per episode)")
    bench_h5(folder / "rows.h5", values)


def bench_h5(path: Path, values: np.ndarray) -> None:
    """The same column from one HDF5 file."""
    try:
        import h5py
    except ImportError:
        print("HDF5      h5py is not installed")
        return
    with h5py.File(path, "w") as file:
        file.create_dataset("pooled", data=values, chunks=(1, *values.shape[1:]), shuffle=True, compression="lzf")
    with h5py.File(path) as file:
        h5, _ = seconds(lambda: file["pooled"][:, 0, 11, 0])
    print(f"HDF5      {1e3 * h5:9.1f}   (shuffle + lzf, one chunk per episode)")


def write_mid_sized(folder: Path) -> None:
    """A pi0 of 66 million random parameters: one inference takes a core about 0.3 s."""
    size = Pi0Size(
        vlm=GemmaSize(width=512, depth=10, mlp_dim=2048, num_heads=8, num_kv_heads=1, head_dim=64),
        expert=GemmaSize(width=384, depth=10, mlp_dim=1536, num_heads=8, num_kv_heads=1, head_dim=64),
        vision=SiglipSize(hidden=256, layers=6, heads=4, inter=1024, patch=16),
        vocab_size=tiny.SIZE.vocab_size,
    )
    policy = build_pi0(tiny.new_pi0_tiny(0).config, size)
    initialise(policy, 0)
    tiny.write_checkpoint(folder, policy, tiny.GUESSED, "random, for a benchmark")
    (folder / "dims.json").write_text(json.dumps(size.to_json()), encoding="utf-8")


def bench_loop(suite: Suite, folder: Path, items: int, repeats: int) -> None:
    """Seconds per episode of the real loop; `off` is the same loop and captures nothing.

    An episode is one inference and the actions it gives, so every inference is captured: the dearest case.
    Modes take turns, and the one that begins changes, so that other work on the machine meets all of them.
    """
    write_mid_sized(folder / "checkpoint")
    base = ExtractSettings(
        "pi0-tiny", str(folder / "checkpoint"), suite=suite.folder, items=items, codec="fast",
        scene=SceneSpec(max_steps=4),
    )  # fmt: skip
    pooled, every = prepare(base), prepare(base.changed(tokens="all"))
    modes = [("off", pooled, 0), ("pooled", pooled, 1), ("all", every, 1)]
    megabytes = {"off": 0.0, "pooled": pooled.plan.bytes / 1e6, "all": every.plan.bytes / 1e6}
    print(f"\nreal loop, {2 * items} episodes of one inference each ({inference_cpu(pooled):.2f} CPU-s)")
    costs: dict[str, list[tuple[float, float]]] = {name: [] for name, _, _ in modes}
    for repeat in range(repeats):
        for name, extraction, calls in modes[repeat % 3 :] + modes[: repeat % 3]:
            costs[name].append(episode_cost(extraction, calls, folder / f"{name}-{repeat}"))
    print("capture  MB/episode  wall s (ratio to off)  CPU s (ratio to off)   medians of", repeats)
    off_wall, off_cpu = np.median(costs["off"], axis=0)
    for name, measured in costs.items():
        wall, cpu = np.median(measured, axis=0)
        print(
            f"{name:8} {megabytes[name] / (2 * items):10.2f} {wall:8.3f} ({wall / off_wall:.2f})"
            f" {cpu:14.3f} ({cpu / off_cpu:.2f})   wall: " + ", ".join(f"{wall:.3f}" for wall, _ in measured)
        )


def inference_cpu(extraction: Extraction) -> float:
    """CPU seconds of one inference by itself, the least of three."""
    policy = extraction.controller.model
    observation = Observation(
        np.zeros((480, 640, 3), np.uint8), np.zeros(8, np.float32), "Put the cube on the red square"
    )
    return min(seconds(lambda: policy.act([observation], [0]))[1] for _ in range(3))


def episode_cost(extraction: Extraction, captured_calls: int, out: Path) -> tuple[float, float]:
    """Wall-clock and CPU seconds per episode of this process, its start left out; it does not simulate."""
    extraction.controller.captured_calls = captured_calls
    stamps: list[tuple[float, float]] = []
    extraction.run(out, progress=lambda *_: stamps.append((time.perf_counter(), time.process_time())))
    begin, end = np.array(stamps[1]), np.array(stamps[-1])
    wall, cpu = (end - begin) / (len(stamps) - 2)
    return float(wall), float(cpu)


def main() -> None:
    """Run all benchmarks and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=860)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--loop", type=int, default=8, help="items of the real loop")
    parser.add_argument("--repeats", type=int, default=5, help="of the real loop")
    parser.add_argument("--only", choices=("codecs", "columns", "loop"), help="one table")
    arguments = parser.parse_args()
    print(f"zarr {zarr.__version__}, numpy {np.__version__}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        suite = build_suite(folder / "suite", ["color"], arguments.episodes // 2)
        if arguments.only in (None, "codecs"):
            bench_codecs(suite, folder, arguments.width)
        if arguments.only in (None, "columns"):
            bench_columns(suite, folder, arguments.episodes, arguments.width)
        if arguments.only in (None, "loop"):
            bench_loop(suite, folder, arguments.loop, arguments.repeats)


if __name__ == "__main__":
    main()
