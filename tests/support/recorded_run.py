"""A run on recordings through the real writer, without a model and without lerobot."""

from pathlib import Path

import numpy as np

from probe_kit.extract.sources.player import SIDE
from probe_kit.hashing import derive_seed
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.layout import CAPTURE_ONLY, DATASET, OTHER_ACTIONS, RECORDED_EPISODES, StoredStream
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from tests.support.little_run import certify

STREAMS = (StoredStream("backbone", 2, 6, None, 4, ("mean",), quantities=("residual",)),)
EXPERT = StoredStream("expert", 1, 4, 2, 2, ("mean",), quantities=("residual",))
CALLS, EVERY, STATE, ACTION, CHUNK = 4, 5, 3, 2, 2
SHORT = 11
"""The episode that has a frame less."""
PLANTED = 2
"""The feature of `backbone.layer1` that holds the first number of the state."""


def recorded_plan(episodes: int, pixels: bool = True, streams: tuple[StoredStream, ...] = STREAMS) -> Plan:
    """Frames 0, 5, 10 and 15 of every episode but SHORT, which has three; of two tasks in turn."""
    rows = tuple(recorded_row(number, CALLS - (number == SHORT)) for number in range(episodes))
    inputs = {"columns": [2], "state": [STATE], "action": [CHUNK, ACTION], "prediction": [CHUNK, ACTION]}
    dataset = {
        "kind": "lerobot",
        "meta_blake2b": "0" * 32,
        "fps": 5.0,
        "frames": f"every:{EVERY}",
        "cameras": [["base", "observation.images.top", "image"]],
        "rotations": [],
        "instruction": None,
        "inputs": inputs | ({"pixels": [1, SIDE, SIDE, 3]} if pixels else {}),
        "columns": ["timestamp", "next.reward"],
        "names": {"state": ["x", "y", "z"], "action": ["dx", "grip"]},
    }
    recording = {"name": "kitchen", "episodes": list(range(episodes)), RECORDED_EPISODES: episodes + 2}
    return Plan(rows, streams, 1000, {DATASET: dataset}, {"recording": {**recording, OTHER_ACTIONS: None}})


def recorded_row(number: int, count: int) -> Row:
    """The first frames of a recorded episode."""
    item = f"episode-{number:06d}"
    columns = {
        "episode_id": item,
        "item_id": item,
        "category": "all",
        "group_id": item,
        "instruction": f"Open the {('door', 'drawer')[number % 2]}",
        "source_episode": number,
        "first_frame": 0,
        "frame_step": EVERY,
        "frames": count,
        "recorded_frames": 20,
        "policy_seed": number,
        "content_blake2b": f"{number:032x}",
    }
    return Row(number, columns, frames=range(0, EVERY * count, EVERY))


def write_recorded_run(
    where: Path | str,
    episodes: int = 12,
    pixels: bool = True,
    weights: str = "0" * 64,
    planted: bool = True,
    expert: bool = False,
) -> Run:
    """Every number is drawn; with `planted` the first of the state lies in the features too.

    Another network, by its `weights`, has other features of the same frames. With `expert` there is an action
    stream, of noise.
    """
    plan = recorded_plan(episodes, pixels, (*STREAMS, EXPERT) if expert else STREAMS)
    settings = {
        "model": "shown",
        "weights_sha256": weights,
        "random_weights": False,
        "captured_calls": CALLS,
        "tokens": "pooled",
        "codec": "zstd",
        "seed": 0,
        "capture_only": True,
        **plan.identity,
    }
    writer = RunWriter(locate(where), plan, settings)
    certify(writer)
    for planned in plan.episodes:
        draw = np.random.default_rng(derive_seed("recorded", planned.index))
        count = len(planned.frames or ())
        state = draw.normal(size=(count, STATE)).astype(np.float32)
        pooled = np.full((CALLS, 2, 1, 6), np.nan, np.float32)
        noise = draw.normal(size=(count, 2, 1, 6))
        if weights != "0" * 64:
            noise = np.random.default_rng(derive_seed("network", weights, planned.index)).normal(size=noise.shape)
        pooled[:count] = noise
        if planted:
            pooled[:count, 1, 0, PLANTED] = 5 * state[:, 0]
        inputs = {
            "state": state,
            "action": draw.normal(size=(count, CHUNK, ACTION)).astype(np.float32),
            "prediction": draw.normal(size=(count, CHUNK, ACTION)).astype(np.float32),
            "columns": np.column_stack([np.arange(count) * EVERY / 5.0, draw.integers(0, 2, count)]),
        }
        if pixels:
            inputs["pixels"] = draw.integers(0, 256, (count, 1, SIDE, SIDE, 3), dtype=np.uint8)
        writer.write(
            EpisodeRecord(
                planned,
                {"outcome": CAPTURE_ONLY, "frames_blake2b": "0" * 32},
                {"pooled": {"backbone": pooled, **({"expert": noisy(draw, count)} if expert else {})}},
                [{"backbone": [("language", 0, 4)], **({"expert": [("action", 0, 2)]} if expert else {})}] * count,
                control_steps=tuple(planned.frames or ()),
                inputs=inputs,
            )
        )
    seal(where)
    return open_run(where)


def noisy(draw: np.random.Generator, count: int) -> np.ndarray:
    """Activations of the action stream, of `count` inferences."""
    padded = np.full((CALLS, *EXPERT.lead, 1, EXPERT.width), np.nan, np.float32)
    padded[:count] = draw.normal(size=(count, *padded.shape[1:]))
    return padded
