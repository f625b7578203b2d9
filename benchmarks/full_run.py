"""A run of the paper's size, 3,440 episodes with frames and trajectories, for benchmarks that read runs.

    python benchmarks/full_run.py RUN [--episodes 3440] [--permutations 20]

Written by the ordinary writer and probed by the ordinary probes, without a model. Frames, trajectories and
outcomes are those of a few dozen episodes that scripts really played; every episode takes one of them whose cube
ended where its own is said to. Activations are noise, with a little of the answer in the middle layers of every
second category. Sites as in pi0 (19 in the backbone, 190 in the expert); streams are narrow, because tables,
report and figures see no activations.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tests_of_checkout  # noqa: F401
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.extract.sources.player import Ending
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.extract.sources.source import Played as PlayerOptions
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.layout import COMMITS, StoredStream
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite, build_suite
from probe_kit.suite.generators import GENERATORS
from probe_kit.train import train_probes
from tests.support.plans import make_plan

WIDTH = 16
STREAMS = (
    StoredStream("backbone", 19, WIDTH, None, 816, ("mean", "mean:language"), quantities=("residual",)),
    StoredStream("expert", 19, WIDTH, 10, 51, ("mean", "mean:action"), quantities=("residual",)),
)
SCRIPTS = ("expert", "expert-mirrored", "idle")
SEED = 0


@dataclass(frozen=True)
class Played:
    """An episode that a script played, as any number of episodes of the run take it over."""

    outcome: dict[str, Any]
    ends: tuple[NDArray[np.uint8], ...]
    trajectory: NDArray[np.float32]


def play(plan: Plan, scene: SceneSpec, per_script: int) -> dict[str, list[Played]]:
    """Episodes of the plan, far apart, by the side on which the cube ended."""
    by_side: dict[str, list[Played]] = defaultdict(list)
    stride = max(1, len(plan.episodes) // per_script)
    for script in SCRIPTS:
        stage = ScenePlayer(scene, PlayerOptions("ends", script=script))
        try:
            for planned in plan.episodes[::stride][:per_script]:
                ending = stage.begin(planned, False)
                assert isinstance(ending, Ending)
                assert ending.small_frames
                assert ending.trajectory is not None
                by_side[ending.outcome["side_placed"]].append(
                    Played(ending.outcome, ending.small_frames, ending.trajectory)
                )
        finally:
            stage.close()
    return by_side


def episode(planned: Row, played: dict[str, list[Played]], knows: bool) -> tuple[EpisodeRecord, Played]:
    """One episode: right in 7 of 10 where the category is known, else anywhere. The same numbers every time."""
    draw = np.random.default_rng([SEED, planned.index])
    correct = planned.content.side_correct
    other = "right" if correct == "left" else "left"
    weights = (0.7, 0.2, 0.1) if knows else (0.3, 0.3, 0.4)
    placed = str(draw.choice([correct, other, "none"], p=weights))
    played_episode = played[placed][int(draw.integers(len(played[placed])))]
    outcome = {
        **played_episode.outcome,
        "outcome": "oob" if placed == "none" else "correct" if placed == correct else "wrong",
    }
    pooled = {}
    for stream in STREAMS:
        values = draw.normal(size=(1, *stream.lead, len(stream.views), stream.width)).astype(np.float32)
        if knows:
            values[..., stream.layers // 2 :, :, 0] += 1.5 if correct == "left" else -1.5
        pooled[stream.name] = values
    roles = [{"backbone": [("language", 0, 816)], "expert": [("action", 0, 51)]}]
    arrays = {"pooled": pooled, "tokens": {}}
    return EpisodeRecord(
        planned, outcome, arrays, roles, played_episode.trajectory, control_steps=[0]
    ), played_episode


def planned_run(suite: Suite, episodes: int) -> Plan:
    """The first `episodes` of the suite, spread over its categories as evenly as items allow."""
    plan = make_plan(suite, list(STREAMS), SEED, 1, False)
    return replace(plan, episodes=plan.episodes[:episodes])


def small_suite(folder: Path, episodes: int) -> Suite:
    """The embedded suite with at least so many episodes in all."""
    items = -(-episodes // (2 * len(GENERATORS)))
    return build_suite(folder, items_per_category=items + items % 2)


def write_full_run(folder: Path, episodes: int, say: Callable[[str], None] = print) -> Run:
    """The run at `folder`/run, or the one that is there; continued if it was interrupted."""
    began = time.process_time()
    suite, scene = small_suite(folder / "suite", episodes), SceneSpec()
    plan = planned_run(suite, episodes)
    known_categories = set(list(dict.fromkeys(entry.content.item.category for entry in plan.episodes))[::2])
    settings = {
        "model": "synthetic", "weights_sha256": None, "random_weights": False, "captured_calls": 1,
        "tokens": "pooled", "codec": "zstd", "seed": SEED,
        "suite": {"identity": suite.identity, "seed_text": suite.seed_text},
        "scene": scene.to_json(),
    }  # fmt: skip
    location = locate(folder / "run")
    writer = RunWriter(location, plan, settings)
    remaining = writer.remaining()
    if remaining:
        played = play(plan, scene, 12)
        for number in remaining:
            planned = plan.episodes[number]
            record, played_episode = episode(planned, played, planned.content.item.category in known_categories)
            writer.write(replace(record, pictures={thumbnail_key(number): as_thumbnail(played_episode.ends)}))
        say(f"written: {len(remaining)} episodes, {time.process_time() - began:.0f} CPU-s")
        began = time.process_time()
        seal(folder / "run")
        say(f"sealed: {time.process_time() - began:.0f} CPU-s")
    return open_run(folder / "run")


def probe_full_run(run: Run, permutations: int, views: Sequence[str] = ("mean",), jobs: int | None = None) -> None:
    """Probes of every site and category, and a control; stored ones are loaded."""
    train_probes(run, views=views, permutations=permutations, controls=("position",), jobs=jobs)


def size_of(folder: Path) -> str:
    """Files and megabytes."""
    files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return f"{len(files)} files, {sum(files) / 1e6:.1f} MB"


def main() -> None:
    """Write, seal and probe it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=3440)
    parser.add_argument("--permutations", type=int, default=20)
    options = parser.parse_args()
    run = write_full_run(options.folder, options.episodes)
    began = time.process_time()
    probe_full_run(run, options.permutations)
    print(f"probed: {time.process_time() - began:.0f} CPU-s")
    print(
        f"{run.path}: {len(run.episodes)} episodes, {size_of(run.path)}; {size_of(run.path / COMMITS)} of commits"
    )


if __name__ == "__main__":
    main()
