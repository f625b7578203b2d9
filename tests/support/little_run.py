"""A small run through the real writer, with everything a run can hold, made in a second without a model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring import CHANNELS
from probe_kit.env.spec import SceneSpec
from probe_kit.hashing import derive_seed
from probe_kit.intervene import ConditionOutcomes, ImageSwap
from probe_kit.intervene.settings import settings_of
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.commits import Seconds
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Plan
from probe_kit.runs.store import Location, locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite
from probe_kit.train import train_probes
from tests.intervene.answers import store_outcomes
from tests.support.plans import make_plan

STREAMS = (
    StoredStream("backbone", 2, 6, None, 130, ("mean", "last"), quantities=("residual",)),
    StoredStream("expert", 1, 4, 2, 3, ("mean", "mean:action"), quantities=("residual",)),
)
STEPS = 2
PICTURED = 2
"""Episodes that keep frames."""
PLACED = ("left", "right", "none")


def little_plan(suite: Suite, seed: int = 0, episodes: int | None = None) -> Plan:
    plan = make_plan(suite, list(STREAMS), seed, 1, True)
    return replace(plan, episodes=plan.episodes[:episodes])


def suite_record(suite: Suite) -> dict[str, str]:
    """The part of a run's settings that names its suite."""
    record: dict[str, str] = little_plan(suite).selection["suite"]
    return record


def little_settings(seed: int = 0, codec: str = "zstd") -> dict[str, Any]:
    return {
        "model": "little",
        "weights_sha256": "0" * 64,
        "random_weights": True,
        "captured_calls": 1,
        "tokens": "all",
        "codec": codec,
        "seed": seed,
        "suite": {"identity": "little@1#0123456789ab", "seed_text": "little@1#0123456789ab"},
        "scene": SceneSpec(max_steps=STEPS).to_json(),
    }


def little_writer(where: Location, plan: Plan, seed: int = 0, codec: str = "zstd") -> RunWriter:
    writer = RunWriter(where, plan, little_settings(seed, codec))
    certify(writer)
    return writer


def certify(writer: RunWriter) -> None:
    """What the process says of itself, which is part of the work on a run."""
    check = {f"actions_{how}_hooks_sha256": "a" * 64 for how in ("with", "without")}
    writer.write_certificate({"policy": {"family": "little"}, "capture_check": check})


def episode(plan: Plan, number: int, seed: int = 0) -> EpisodeRecord:
    """The same numbers for the same episode and seed, always."""
    draw = np.random.default_rng(derive_seed("little", seed, number))
    planned = plan.episodes[number]
    arrays: dict[str, dict[str, Any]] = {"pooled": {}, "tokens": {}}
    for stream in STREAMS:
        arrays["pooled"][stream.name] = draw.normal(
            size=(1, *stream.lead, len(stream.views), stream.width)
        ).astype(np.float32)
        tokens = draw.integers(0, 0x7F00, (1, *stream.lead, stream.stored_tokens, stream.width), np.uint16)
        tokens[..., stream.tokens :, :] = 0
        arrays["tokens"][stream.name] = tokens
    placed = PLACED[int(draw.integers(3))]
    outcome = {
        "outcome": "oob" if placed == "none" else "correct" if placed == planned.content.side_correct else "wrong",
        "side_placed": placed,
        "cube_x": float(draw.uniform()),
        "cube_y": float(draw.uniform(-0.3, 0.3)),
        "steps": STEPS,
    }
    roles = [{"backbone": [("language", 0, 130)], "expert": [("action", 0, 3)]}]
    trajectory = draw.normal(size=(STEPS + 1, len(CHANNELS))).astype(np.float32)
    pictures = {thumbnail_key(number): as_thumbnail(still(seed, number))} if number < PICTURED else {}
    seconds = Seconds(0.25 + number, 0.5)
    return EpisodeRecord(planned, outcome, arrays, roles, trajectory, (1, 2, number), pictures, (0, 1), seconds)


def still(seed: int, number: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two frames that differ by seed and episode."""
    return np.full((60, 80, 3), 100 * seed + number, np.uint8), np.full((60, 80, 3), 50, np.uint8)


def write_little_run(
    where: Path | str, suite: Suite, seed: int = 0, codec: str = "zstd", episodes: int | None = None
) -> Run:
    """Written and sealed."""
    plan = little_plan(suite, seed, episodes)
    writer = little_writer(locate(where), plan, seed, codec)
    for number in writer.remaining():
        writer.write(episode(plan, number, seed))
    seal(where)
    return open_run(where)


def intervene_on_little_run(run: Run) -> None:
    """A stored intervention on its episodes, with answers drawn instead of inferred."""
    settings, episodes = settings_of(ImageSwap(), run), run.episodes
    draw = np.random.default_rng(derive_seed("little", run.settings_sha256))
    names = {"episodes": "episode_id", "items": "item_id", "groups": "group_id", "categories": "category"}
    lateral = draw.normal(size=(2, len(episodes)))
    answers = ConditionOutcomes(
        conditions=("clean", "image_swap"),
        **{column: episodes[name].to_numpy(dtype=str) for column, name in names.items()},
        sides=episodes["side_correct"].to_numpy(dtype=str),
        displacement=lateral,
        max_action_change=np.abs(lateral - lateral[0]),
        edit_log=np.zeros((*lateral.shape, 5)),
        replay_error=np.zeros(len(episodes)),
    )
    check = {
        "episodes": len(episodes),
        "compared": len(episodes),
        "equal": len(episodes),
        "largest_difference": 0.0,
    }
    store_outcomes(run.location, run.suite, settings, answers, {"replay": check})


def probe_little_run(run: Run) -> None:
    """Two sets of probes; to the second a control is added later."""
    train_probes(run, permutations=1, seed=1)
    train_probes(run, permutations=2)
    train_probes(run, permutations=2, controls=("position",))
