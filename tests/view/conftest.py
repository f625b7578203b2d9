"""The small run that the viewer's tests share, and its export."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.env.scoring import CHANNELS
from probe_kit.runs import Run, label_run, open_run, seal
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite
from probe_kit.train import train_probes
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue
from tests.support.little_run import (
    STREAMS,
    certify,
    episode,
    intervene_on_little_run,
    little_settings,
)
from tests.support.plans import make_plan

CALLS = 2
FILMED, FILM_STEPS = 2, 9
"""An episode that keeps every frame, and its steps."""
SHORTENED, LOST_WORDS = 5, 2
"""An episode whose prompt was cut, and how many words at the end of its instruction were lost."""
HOSTILE = "</script><img src=x onerror=alert(1)>"
"""A label, and part of an instruction, that a page may not obey."""
TURNED = "\u202egnp.exe"
"""Text that would turn the rest of its line round."""
MISREAD = 1, 7
"""Seed of the run, and the episode in it, whose backbone holds the wrong side."""
INFERENCES = (0, 1, 4)
"""Control steps of the filmed episode's inferences, of which the last is not captured."""


@pytest.fixture(scope="module")
def little(little_runs: Path) -> Run:
    """24 episodes with trajectories, probes of two views, and frames of two episodes."""
    return open_run(little_runs / "run")


@pytest.fixture(scope="module")
def catalogue(little: Run) -> Catalogue:
    """Of the small run."""
    return Catalogue([little])


@pytest.fixture(scope="module")
def exported(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of both small runs."""
    runs = [open_run(little_runs / name) for name in ("run", "other")]
    return write_viewer(runs, tmp_path_factory.mktemp("viewer") / "page")


def film() -> tuple[NDArray[np.uint8], ...]:
    """Frames that get lighter on the left and darker on the right."""
    frames = []
    for number in range(FILM_STEPS + 1):
        frame = np.full((60, 80, 3), 20 * number, np.uint8)
        frame[:, 40:] = 250 - 20 * number
        frames.append(frame)
    return tuple(frames)


def filmed(record: EpisodeRecord) -> EpisodeRecord:
    """The record as `--frames all` makes it, where it is that of the filmed episode."""
    number, frames = record.planned.index, film()
    if number != FILMED:
        return record
    return replace(
        record,
        outcome={**record.outcome, "steps": FILM_STEPS},
        trajectory=np.random.default_rng(number).normal(size=(len(frames), len(CHANNELS))).astype(np.float32),
        pictures={thumbnail_key(number): as_thumbnail(frames, "all")},
        frames=len(frames),
    )


def write_run(where: Path, suite: Suite, seed: int) -> Run:
    """24 episodes of two captured inferences. The backbone's last layer holds the answer at the first of them."""
    settings = {**little_settings(), "captured_calls": CALLS, "tokens": "pooled", "light": str(seed)}
    settings["scene"] = SceneSpec(max_steps=FILM_STEPS).to_json()
    plan = make_plan(suite, list(STREAMS), 0, CALLS, True)
    writer = RunWriter(locate(where), plan, settings)
    certify(writer)
    for number in writer.remaining():
        record = filmed(episode(plan, number, seed))
        if number == SHORTENED:
            record = replace(record, outcome={**record.outcome, "lost_words": LOST_WORDS})
        draw = np.random.default_rng([seed, number])
        pooled = {}
        for stream in STREAMS:
            shape = (CALLS, *stream.lead, len(stream.views), stream.width)
            pooled[stream.name] = draw.normal(size=shape).astype(np.float32)
        sign = 1 if plan.episodes[number].content.side_correct == "left" else -1
        if (seed, number) == MISREAD:
            sign = -sign
        pooled["backbone"][0, -1, :, 0] = 3 * sign + draw.normal(size=2) / 2
        roles = [*record.roles, *record.roles]
        steps = INFERENCES if number == FILMED else INFERENCES[:CALLS]
        writer.write(replace(record, arrays={"pooled": pooled}, roles=roles, control_steps=steps))
    seal(where)
    intervene_on_little_run(open_run(where))
    for call in range(CALLS):
        train_probes(open_run(where), permutations=60, call=call)
    return open_run(where)


def hostile(suite: Suite) -> Suite:
    """The suite, whose first item has text in its instruction and concept that a page may not obey."""
    words = f"Put the cube on {HOSTILE} {TURNED}"
    first = replace(suite.items[0], instruction=words, target_concept=HOSTILE)
    return replace(suite, items=(first, *suite.items[1:]))


@pytest.fixture(scope="module")
def runs(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Two runs of the same seeds, whose probes were fitted to both inferences; tests that use them are slow."""
    folder = tmp_path_factory.mktemp("runs")
    suite = hostile(small_suite.select(["color"]))
    written_runs = [write_run(folder / name, suite, seed) for seed, name in enumerate(("a", "b"))]
    label_run(folder / "b", HOSTILE)
    return [written_runs[0], open_run(folder / "b")]
