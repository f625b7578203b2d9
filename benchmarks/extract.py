"""How fast runs are written and read: codecs, columns against rows and plain files, and the real loop.

    python benchmarks/extract.py [--episodes 860] [--width 512] [--loop 16]

Rivals of the columns hold the same float32 numbers: HDF5 (if h5py is there) and one .npy per episode. The loop is
the real one with pi0-tiny and a pause in every inference that stands for a large model on a GPU.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr

from probe_kit.extract import ExtractSettings, open_run, prepare, seal
from probe_kit.extract.controllers import PolicyController
from probe_kit.extract.layout import CODECS, StoredStream
from probe_kit.extract.plan import Plan, make_plan
from probe_kit.extract.rollout import Rollout
from probe_kit.extract.staging import EpisodeBuffers
from probe_kit.extract.writer import RunWriter
from probe_kit.hooks.sites import Site
from probe_kit.suite import Suite, build_suite

LAYERS, VIEWS, TOKENS = 19, ("mean", "last", "mean:language", "mean:image"), 816
SITE = Site("backbone", 11)
PAUSE_S = 0.25


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Wall-clock and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def activations(draw: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Residual-like numbers: every channel has a scale of its own, a few of them large."""
    scale = np.exp(np.random.default_rng(0).normal(size=shape[-1]))
    return (draw.normal(size=shape) * scale).astype(np.float32)


def synthetic(plan: Plan, stream: StoredStream, number: int, with_tokens: bool) -> Rollout:
    """One episode of such numbers."""
    draw = np.random.default_rng(number)
    buffers = EpisodeBuffers([stream], 1, with_tokens, pinned=False)
    buffers.pooled[stream.name][:] = activations(draw, buffers.pooled[stream.name].shape)
    if with_tokens:
        bits = activations(draw, (*stream.lead, stream.tokens, stream.width)).view(np.uint32) >> 16
        buffers.tokens[stream.name][0][..., : stream.tokens, :] = bits
    buffers.roles.append({stream.name: [("image.main", 0, 768), ("language", 768, stream.tokens)]})
    return Rollout(plan.episodes[number], {"outcome": "oob"}, buffers, [])


def bench_codecs(suite: Suite, folder: Path, width: int) -> None:
    """Tokens of four episodes through the whole write path, codec, checksums and commits included."""
    stream = StoredStream("backbone", LAYERS, width, None, TOKENS, VIEWS)
    plan = make_plan(suite, [stream], 0, 1, True)
    rollouts = [synthetic(plan, stream, number, True) for number in range(4)]
    raw = 4 * LAYERS * TOKENS * width * 2 / 1e6
    print(
        f"\ntokens, {raw:.0f} MB in 4 episodes\ncodec   ratio   write MB/s (per CPU-s)   read a layer ms/episode"
    )
    for codec in CODECS:
        bench_codec(codec, plan, rollouts, folder / codec, raw)


def bench_codec(codec: str, plan: Plan, rollouts: list[Rollout], path: Path, raw: float) -> None:
    """One line of the table of codecs."""
    writer = RunWriter(path, plan, {"captured_calls": 1, "tokens": "all", "codec": codec, "model": "synthetic"})
    wall, cpu = seconds(lambda: [writer.write(rollout) for rollout in rollouts])
    size = sum(p.stat().st_size for p in (path / "data.zarr/backbone/tokens").rglob("*") if p.is_file())
    run = open_run(path, allow_partial=True)
    read, _ = seconds(lambda: run.tokens(SITE))
    print(f"{codec:6} {raw * 1e6 / size:6.2f} {raw / wall:12.0f} ({raw / cpu:.0f}) {1e3 * read / 4:18.1f}")


def bench_columns(suite: Suite, folder: Path, episodes: int, width: int) -> None:
    """One view of one layer of every episode, four ways."""
    stream = StoredStream("backbone", LAYERS, width, None, TOKENS, VIEWS)
    plan = make_plan(suite, [stream], 0, 1, False)
    settings = {"captured_calls": 1, "tokens": "pooled", "codec": "zstd", "model": "synthetic"}
    writer = RunWriter(folder / "columns", plan, settings)
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


class Paused:
    """A policy whose every inference waits, as a large model on a GPU would let the host wait."""

    def __init__(self, policy: object) -> None:
        self._policy, self._act = policy, policy.act

    def __enter__(self) -> None:
        def act(*arguments: object) -> object:
            time.sleep(PAUSE_S)
            return self._act(*arguments)

        self._policy.act = act

    def __exit__(self, *_: object) -> None:
        del self._policy.act


def bench_loop(suite: Suite, folder: Path, items: int) -> None:
    """Episodes per second of the real loop; `off` runs the same loop and captures nothing."""
    print(f"\nreal loop, {2 * items} episodes of 12 actions, {PAUSE_S} s pause per inference\ncapture  episodes/s")
    base = ExtractSettings("pi0-tiny", suite=suite.folder, items=items, codec="fast")
    base = replace(base, scene=replace(base.scene, max_steps=12))
    for name, tokens in (("off", "pooled"), ("pooled", "pooled"), ("all", "all")):
        print(f"{name:8} {episodes_per_second(replace(base, tokens=tokens), folder / name, name == 'off'):9.2f}")


def episodes_per_second(settings: ExtractSettings, out: Path, off: bool) -> float:
    """Of one extraction, its start left out; `off`: captures nothing."""
    extraction = prepare(settings)
    controller = extraction.controller
    assert isinstance(controller, PolicyController)
    if off:
        controller.captured_calls = 0
    stamps: list[float] = []
    with Paused(controller.policy):
        extraction.run(out, progress=lambda *_: stamps.append(time.perf_counter()))
    return (len(stamps) - 2) / (stamps[-1] - stamps[1])


def main() -> None:
    """Run all benchmarks and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=860)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--loop", type=int, default=16, help="items of the real loop")
    arguments = parser.parse_args()
    print(f"zarr {zarr.__version__}, numpy {np.__version__}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        suite = build_suite(folder / "suite", ["color"], arguments.episodes // 2)
        bench_codecs(suite, folder, arguments.width)
        bench_columns(suite, folder, arguments.episodes, arguments.width)
        bench_loop(suite, folder, arguments.loop)


if __name__ == "__main__":
    main()
