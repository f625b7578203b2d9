"""What integrity costs: hashes while writing, opening a large run, and reading every byte to verify it.

    python benchmarks/integrity.py [--width 512] [--episodes 3440] [--gigabytes 1.2] [--repeats 5]

Rivals: the same writing without any checksum and with crc32c; parsing the commits of the same run and comparing
nothing; reading the same files and doing nothing with them, and hashing them in one thread.
"""

import argparse
import hashlib
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import google_crc32c
import numpy as np
import tests_of_checkout  # noqa: F401

from probe_kit.env import SceneSpec
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.scene_source import SceneSource, scene_row
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs.commits import NOT_MEASURED, Commit, commit_key, write_commit, write_seconds
from probe_kit.runs.layout import DATA, StoredStream
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.records import HASH
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite, build_suite
from tests.support.plans import make_plan

BACKBONE = StoredStream("backbone", 19, 512, None, 816, ("mean", "last", "mean:language", "mean:image"))
EXPERT = StoredStream("expert", 19, 64, 10, 51, ("mean", "mean:action"))
RECORDING = "probe_kit.runs.array_store"
Seconds = tuple[float, float]


def seconds(work: Callable[[], object]) -> Seconds:
    """Wall-clock and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def medians(turns: list[Seconds]) -> Seconds:
    """Of wall-clock and CPU seconds."""
    return statistics.median(turn[0] for turn in turns), statistics.median(turn[1] for turn in turns)


def episode(plan: Plan, number: int) -> EpisodeRecord:
    """Residual-like numbers: every channel has a scale of its own."""
    draw, buffers = np.random.default_rng(number), EpisodeBuffers(list(plan.streams), 1, True, pinned=False)
    spans: dict[str, list[tuple[str, int, int]]] = {}
    for stream in plan.streams:
        scale = np.exp(np.random.default_rng(0).normal(size=stream.width))
        shape = (*stream.lead, stream.tokens, stream.width)
        bits = (draw.normal(size=shape) * scale).astype(np.float32).view(np.uint32) >> 16
        buffers.tokens[stream.name][0][..., : stream.tokens, :] = bits
        spans[stream.name] = [("language", 0, stream.tokens)]
    buffers.roles.append(spans)
    return buffers.record(plan.episodes[number], {"outcome": "oob", "side_placed": "none"}, control_steps=[0])


def settings(codec: str) -> dict[str, Any]:
    """Settings of a synthetic run."""
    return {"captured_calls": 1, "tokens": "all", "codec": codec, "model": "synthetic", "weights_sha256": None,
            "random_weights": False, "suite": {"identity": "synthetic", "seed_text": "synthetic"}}  # fmt: skip


def bench_writing(suite: Suite, folder: Path, width: int, repeats: int) -> None:
    """Two episodes of tokens through the whole write path; the three ways take turns."""
    stream = replace(BACKBONE, width=width)
    plan = make_plan(suite, [stream], 0, 1, True)
    records = [episode(plan, number) for number in range(2)]
    raw = 2 * stream.raw_bytes(True) / 1e6
    ways: dict[str, Callable[[bytes], str] | None] = {
        "blake2b": None, "crc32c": lambda content: f"{google_crc32c.value(content):064x}",
        "nothing": lambda _content: "0" * 64,
    }  # fmt: skip
    for codec in ("zstd", "fast", "none"):
        seconds_by_way: dict[str, list[Seconds]] = {name: [] for name in ways}
        for repeat in range(repeats):
            for name, digest in ways.items():
                writer = RunWriter(locate(folder / f"{codec}-{name}-{repeat}"), plan, settings(codec))
                if digest is None:
                    seconds_by_way[name].append(seconds(partial(write, writer, records)))
                    continue
                with (
                    patch(f"{RECORDING}.digest", digest),
                    patch(f"{RECORDING}.block_digest", lambda _part: "0" * 16),
                ):
                    seconds_by_way[name].append(seconds(partial(write, writer, records)))
        for name, turns in seconds_by_way.items():
            wall, cpu = medians(turns)
            without = medians(seconds_by_way["nothing"])[1]
            print(f"write --codec {codec:4} {name:8} {raw / wall:6.0f} MB/s {raw / cpu:6.0f} MB/CPU-s, "
                  f"{cpu / without:.2f} x the CPU of nothing")  # fmt: skip


def write(writer: RunWriter, records: list[EpisodeRecord]) -> None:
    """All of them."""
    for record in records:
        writer.write(record)


def read_all(files: list[Path]) -> None:
    """A megabyte at a time into the same memory, which is the cheapest way, and do nothing with it."""
    buffer = bytearray(1 << 20)
    for path in files:
        with path.open("rb", buffering=0) as file:
            while file.readinto(buffer):
                pass


def hash_all(files: list[Path]) -> None:
    """One file after another in one thread: what the hash alone takes."""
    for path in files:
        with path.open("rb") as file:
            hashlib.file_digest(file, "blake2b")


def forget(files: list[Path]) -> None:
    """Drop the files from the page cache, where the system supports this."""
    for path in files:
        with path.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def bench_verifying(suite: Suite, run: Path, gigabytes: float, repeats: int) -> None:
    """Every byte of a run with tokens of full width, against reading and hashing the same files.

    From the disk, its pages forgotten before every turn, and from memory, where the run was read just before.
    """
    stream = replace(BACKBONE, width=2048)
    episodes = max(1, round(gigabytes * 1e9 / stream.raw_bytes(True)))
    plan = make_plan(suite, [stream], 0, 1, True)
    many = tuple(_numbered(plan.episodes[0], number) for number in range(episodes))
    writer = RunWriter(locate(run), _of_many(suite, plan, many), settings("none"))
    record = episode(plan, 0)
    with writer.claim():
        for planned in many:
            writer.write(replace(record, planned=planned))
        seal(run)
    files = [path for path in run.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 1e6
    ways: dict[str, Callable[[], object]] = {
        "reading alone": partial(read_all, files),
        "hashing alone": partial(hash_all, files),
        "verify --deep": partial(verify_run, run, deep=True),
    }
    for where in ("disk", "memory"):
        seconds_by_way: dict[str, list[Seconds]] = {name: [] for name in ways}
        for _ in range(repeats):
            for name, work in ways.items():
                (forget if where == "disk" else read_all)(files)
                seconds_by_way[name].append(seconds(work))
        for name, turns in seconds_by_way.items():
            wall, cpu = medians(turns)
            ratio = medians(seconds_by_way["reading alone"])[0] / wall
            print(f"{size:.0f} MB in {len(files)} files from {where}, {name} {size / wall:6.0f} MB/s "
                  f"({size / cpu:.0f} per CPU-s), {ratio:.2f} of the speed of reading")  # fmt: skip


def large_run(suite: Suite, run: Path, episodes: int) -> None:
    """A run of many episodes, all with the objects of the first under other names."""
    plan = make_plan(suite, [replace(BACKBONE, width=2), replace(EXPERT, width=2)], 0, 1, True)
    first = plan.episodes[0]
    many = tuple(_numbered(first, number) for number in range(episodes))
    writer = RunWriter(locate(run), _of_many(suite, plan, many), settings("zstd"))
    writer.write(episode(writer.plan, 0))
    model = writer.root.location.read(commit_key(0))
    commit = json.loads(model)
    del commit[HASH]
    for number in range(1, episodes):
        objects = {}
        for key, object_record in commit["objects"].items():
            new = key.replace("/c/0/", f"/c/{number}/", 1)
            objects[new] = object_record
            (run / DATA / new).parent.mkdir(parents=True)
            os.link(run / DATA / key, run / DATA / new)
        commit_fields = {**commit, "episode": number, "episode_id": many[number].episode_id, "objects": objects}
        write_seconds(writer.root, number, replace(NOT_MEASURED, inference=0.0, simulation=0.0))
        write_commit(writer.location, Commit.model_validate(commit_fields))


def _of_many(suite: Suite, plan: Plan, episodes: tuple[Row, ...]) -> Plan:
    """The plan with these episodes, whose items its suite then holds."""
    items = tuple(planned.content.item for planned in episodes)
    source = SceneSource(SceneSettings(scene=SceneSpec()), replace(suite, items=items))
    return replace(plan, episodes=episodes, selection=source.selection(episodes))


def _numbered(planned: Row, number: int) -> Row:
    item = replace(planned.content.item, item_id=f"color-{number:05d}")
    return scene_row(number, replace(planned.content, item=item), 0, 0, item.content_sha256)


def parse_commits(run: Path) -> None:
    """Every commit as JSON, and nothing compared."""
    for path in sorted((run / "commits").iterdir()):
        json.loads(path.read_bytes())


def bench_opening(suite: Suite, folder: Path, episodes: int, repeats: int) -> None:
    """`open_run` and the stamp, which is what every command asks first."""
    run = folder / "large"
    large_run(suite, run, episodes)
    ways: dict[str, Seconds] = {}
    for name, work in {"checked": lambda: open_run(run).stamp, "parsed": partial(parse_commits, run)}.items():
        ways[name] = medians([seconds(work) for _ in range(repeats + 1)][1:])
        sizes = [path.stat().st_size for path in (run / "commits").iterdir()]
        print(f"open {episodes} episodes, {name}: {ways[name][0]:.2f} s ({ways[name][1]:.2f} CPU-s), "
              f"{statistics.mean(sizes) / 1e3:.1f} kB per commit")  # fmt: skip
    wall, cpu = (ways["checked"][part] / ways["parsed"][part] for part in (0, 1))
    print(f"opening: {wall:.2f} x wall, {cpu:.2f} x CPU")


def main() -> None:
    """All of it, on a fresh folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--episodes", type=int, default=3440)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--gigabytes", type=float, default=1.2, help="of the run that is verified")
    parser.add_argument("--only", choices=["opening", "writing", "verifying"], help="one part instead of all")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"load {load:.1f} on {os.cpu_count()} cores, {datetime.now(UTC):%d %B %Y}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        suite = build_suite(folder / "suite", ["color"], 6)
        if options.only in (None, "opening"):
            bench_opening(suite, folder, options.episodes, options.repeats)
        if options.only in (None, "writing"):
            bench_writing(suite, folder, options.width, options.repeats)
        if options.only in (None, "verifying"):
            bench_verifying(suite, folder / "verified", options.gigabytes, options.repeats)


if __name__ == "__main__":
    main()
