"""A run through the real writer with several captured inferences, and a label planted in its features."""

from pathlib import Path

import numpy as np

from probe_kit.env.scoring import CHANNELS, Trajectory
from probe_kit.env.spec import SceneSpec
from probe_kit.hashing import derive_seed
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite
from tests.support.little_run import certify
from tests.support.plans import make_plan

STREAMS = (
    StoredStream("backbone", 2, 8, None, 6, ("mean",), quantities=("residual",)),
    StoredStream("expert", 1, 4, 2, 3, ("mean",), quantities=("residual",)),
)
STEPS, CALLS, EVERY = 12, 4, 3
GRASP, RELEASE = 4, 8
PLANTED = 3
"""The feature of `backbone.layer1` that holds 10 × the y of the hand, metres."""


def write_labelled_run(where: Path | str, suite: Suite, seed: int = 0, weights: str = "0" * 64) -> Run:
    """Every episode grasps at frame 4 and releases at frame 8; the last episode ends after two inferences."""
    plan = make_plan(suite, list(STREAMS), seed, CALLS, False)
    settings = {
        "model": "labelled",
        "weights_sha256": weights,
        "random_weights": True,
        "captured_calls": CALLS,
        "tokens": "pooled",
        "codec": "zstd",
        "seed": seed,
        "suite": {"identity": "labelled@1#0123456789ab", "seed_text": "labelled@1#0123456789ab"},
        "scene": SceneSpec(max_steps=STEPS).to_json(),
    }
    writer = RunWriter(locate(where), plan, settings)
    certify(writer)
    for number, planned in enumerate(plan.episodes):
        draw = np.random.default_rng(derive_seed("labelled", seed, number))
        steps = STEPS if number + 1 < len(plan.episodes) else 2 * EVERY
        frames = hand_and_cube(draw, steps)
        control = list(range(0, steps, EVERY))
        pooled = {}
        for stream in STREAMS:
            array = draw.normal(size=(CALLS, *stream.lead, 1, stream.width)).astype(np.float32)
            if stream.name == "backbone":
                array[: len(control), 1, 0, PLANTED] = 10 * frames[control, CHANNELS.index("tool.y")]
            array[len(control) :] = np.nan
            pooled[stream.name] = array
        outcome = {"outcome": "oob", "side_placed": "none", "cube_x": 0.0, "cube_y": 0.0, "steps": steps}
        roles = [{"backbone": [("language", 0, 6)], "expert": [("action", 0, 3)]}] * len(control)
        writer.write(
            EpisodeRecord(planned, outcome, {"pooled": pooled}, roles, frames, (1, 2), {}, tuple(control))
        )
    seal(where)
    return open_run(where)


def hand_and_cube(draw: np.random.Generator, steps: int) -> np.ndarray:
    """(steps + 1, channels): the hand wanders along y, and holds the cube from frame 4 to frame 7."""
    frames = draw.normal(size=(steps + 1, len(CHANNELS))).astype(np.float32)
    frames[:, CHANNELS.index("tool.y")] = 0.1 * draw.normal(size=steps + 1).cumsum()
    at = np.arange(steps + 1)
    frames[:, CHANNELS.index("held.bool")] = (at >= GRASP) & (at < RELEASE)
    return Trajectory.of_frames(frames).frames
