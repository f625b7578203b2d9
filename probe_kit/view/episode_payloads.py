"""The payloads of episodes: a column per property of all, and paths, events and log-odds of a single one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring import EVENTS, RULES, Events, Trajectory, judge, rule_of
from probe_kit.errors import RunDamagedError
from probe_kit.hashing import sha256_json
from probe_kit.intervene.kinds.image_swap import swap_responses_by_episode
from probe_kit.retention.behaviour import SCORES
from probe_kit.runs.layout import FIRST_FRAME, FRAME_COLUMNS
from probe_kit.runs.thumbnails import ThumbnailFrames, episode_frames
from probe_kit.suite.pictures import picture_size
from probe_kit.view.run_payloads import (
    PackedArray,
    best_sites,
    code_words,
    pack_floats,
    pack_log_odds,
    round_number,
)
from probe_kit.view.viewed_run import ViewedRun, toward

_STILL = 1e-4
"""Distance in metres that a tile may move and still be drawn where it began."""
_ANSWERS = {
    "question": "question",
    "text": "answer",
    "option read": "said",
    "parsing rule": "parse",
    **{f"outcome, {score}": outcome for score, (outcome, _) in SCORES.items()},
}
"""By heading, columns of a VLM run that hold its question and answer."""


def episode_payload(viewed: ViewedRun, number: int) -> dict[str, Any]:
    """Return the payload of the episode of this number.

    `inferences` holds the control step of every inference, of which the first K were captured. `log_odds` and
    `refitted` are packed (K, S) by captured inference and site. The first are of the probes of one inference, the
    second of the probes that were fitted to each inference.

    Args:
        viewed: The run of the episode.
        number: Number of the episode.

    Raises:
        KeyError: If it is not committed.
    """
    run, position = viewed.run, viewed.position_of[number]
    row = {str(name): value for name, value in run.episodes.iloc[position].to_dict().items()}
    probes = viewed.probes.get(str(row["category"]))
    log_odds, held_out = (None, True) if probes is None else probes.log_odds(position)
    calls = int(viewed.captured_inferences[position])
    trajectory = run.trajectory(position) if run.has_trajectories else None
    frames = episode_frames(run, position)
    return {
        "number": number,
        "frames": None if frames is None else _frames(viewed, number, frames),
        "inferences": viewed.inference_steps(position),
        "log_odds": None if log_odds is None else pack_log_odds(log_odds),
        "refitted": None if log_odds is None else _refitted_log_odds(viewed, row, calls),
        "held_out": held_out,
        "trajectory": None if trajectory is None else _trajectory(trajectory),
        "events": {} if trajectory is None else _events(trajectory),
        "outcomes": {} if trajectory is None else _outcomes(viewed, trajectory, row),
        # Words at the end of the instruction that did not reach the network.
        "lost_words": int(round_number(row.get("lost_words"), 0) or 0),
        "instruction_tokens": len(run.instruction_ids(position) or ()),
        "words": _answers(viewed, row) | _label_words(viewed, row, position),
        "inputs": _inputs(viewed, position),
        "attention": _attention(viewed, row, position, 1 if frames is None else frames.cameras),
    }


def _answers(viewed: ViewedRun, row: dict[str, Any]) -> dict[str, str]:
    """Return by heading the question to a VLM and its answer; none of a policy."""
    answers = {heading: row.get(column) for heading, column in _ANSWERS.items()} if viewed.answers else {}
    return {heading: str(viewed.outcome_word(value)) for heading, value in answers.items() if value is not None}


def _label_words(viewed: ViewedRun, row: dict[str, Any], position: int) -> dict[str, str]:
    """Return the file of a picture and its labels that are texts, by their names; none of other runs."""
    inputs = viewed.run.inputs
    if inputs is None or not inputs.classes:
        return {}
    first = dict(zip(inputs.columns, inputs.row("columns", position)[0], strict=True))
    cells = {name: inputs.cell(name, first[name]) for name in inputs.classes}
    texts = {name: str(cell) for name, cell in cells.items() if cell is not None}
    return {name: str(row[name]) for name in ("picture",) if name in row} | texts


def _refitted_log_odds(viewed: ViewedRun, row: dict[str, Any], calls: int) -> Any:
    """Return the log-odds of the probes of each inference; None where only one inference was probed."""
    category, view = str(row["category"]), viewed.view
    if len(viewed.refitted) < 2:  # one alone is that of `log_odds`
        return None
    log_odds = np.full((calls, len(viewed.sites)), np.nan)
    for call, results in viewed.refitted.items():
        curve = results.curves.get((category, str(view)))
        positions = [] if curve is None else np.flatnonzero(curve.episodes == row["episode_id"]).tolist()
        if curve is not None and positions and call < calls:
            sign = toward(str(row["side_correct"]))
            log_odds[call] = curve.decisions[:, positions[0]] * sign
    return pack_log_odds(log_odds)


def _frames(viewed: ViewedRun, number: int, frames: ThumbnailFrames) -> dict[str, Any]:
    """Return the division of the episode's picture: `count` frames of one size in `columns`.

    The `steps` are those of the frames, where there is one for each inference.
    """
    columns = min(frames.count, FRAME_COLUMNS)
    size = picture_size(frames.content)
    if size is None:
        raise RunDamagedError(f"the picture of episode {number} in {viewed.run.location} cannot be decoded")
    width, height = size
    cell = {"width": width // columns, "height": height // -(-frames.count // columns)}
    of_inferences = frames.kind == "inferences"
    steps = viewed.inference_steps(viewed.position_of[number]) if of_inferences else None
    return {"count": frames.count, "columns": columns, **cell, "all": frames.kind != "ends", "steps": steps}


def _attention(viewed: ViewedRun, row: dict[str, Any], position: int, pictures: int) -> dict[str, Any] | None:
    """Return the attention on the patches of a frame of so many pictures, by step; None where none is stored.

    The `boxes` are packed (P, 4) shares of the frame. The `weights` are packed (B, P) of every inference.
    """
    stored = viewed.patch_attention.get(str(row["category"]))
    if stored is None or not (of_episode := stored.episodes == row["episode_id"]).any():
        return None
    steps, on_frame = viewed.inference_steps(position), stored.only(of_episode).on_frame(pictures)
    # Interventions count inferences of an episode, and name frames of recordings by their number.
    calls = on_frame.calls.tolist()
    return {
        "blocks": on_frame.weights.shape[1],
        "boxes": pack_floats(on_frame.boxes),
        "steps": calls if viewed.run.recorded else [steps[call] for call in calls],
        "weights": [pack_floats(weights) for weights in on_frame.weights],
    }


def _inputs(viewed: ViewedRun, position: int) -> list[dict[str, Any]]:
    """Return inputs and outputs of the inferences of an episode, by group and number: lines packed (K,)."""
    inputs = viewed.run.inputs
    if inputs is None:
        return []
    count = len(viewed.inference_steps(position))
    rows = {kind: inputs.row(kind, position)[:count] for kind in inputs.kinds if kind != "pixels"}
    # Of a chunk of actions the first one is shown.
    first = {name: rows[name][:, 0] for name in ("action", "prediction") if name in rows}
    words = {"action": "recorded" if viewed.run.recorded else "action", "prediction": "predicted"}
    groups = [("actions", {words[name]: values for name, values in first.items()}, inputs.names.get("action", ()))]
    if "state" in rows:
        groups.append(("state", {"state": rows["state"]}, inputs.names.get("state", ())))
    if "columns" in rows:
        # A text is stored as a position among the texts, which makes no chart; see `_label_words`.
        numbers = [at for at, name in enumerate(inputs.columns) if name not in inputs.classes]
        names = tuple(inputs.columns[at] for at in numbers)
        groups += [("columns", {"value": rows["columns"][:, numbers]}, names)] * bool(numbers)
    return [{"title": title, "series": _series(lines, names)} for title, lines, names in groups if lines and count]


def _series(lines: dict[str, NDArray[Any]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return a chart per number.

    Args:
        lines: (K, D) values by name of the line.
        names: Names of the D numbers, if they have any.
    """
    width = max(values.shape[1] for values in lines.values())
    return [
        {
            "name": names[number] if number < len(names) else str(number),
            "lines": [
                {"name": name, "values": pack_floats(values[:, number])}
                for name, values in lines.items()
                if number < values.shape[1]
            ],
        }
        for number in range(width)
    ]


def _trajectory(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "frames": len(trajectory),
        "tool": pack_floats(trajectory.tool[:, :3]),
        "cube": pack_floats(trajectory.cube[:, :3]),
        "opening": pack_floats(trajectory.opening),
        "commanded": pack_floats(trajectory.commanded[:, :3]),
        "executed": pack_floats(trajectory.executed[:, :3]),
        "tiles": {
            "left": pack_floats(_tile_middles(trajectory.tile_left[:, :2])),
            "right": pack_floats(_tile_middles(trajectory.tile_right[:, :2])),
        },
    }


def _tile_middles(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the middles of a tile (T + 1, 2), or its first one alone where it stays."""
    return positions if np.abs(positions - positions[0]).max() > _STILL else positions[:1]


def _events(trajectory: Trajectory) -> dict[str, int | None]:
    events = Events.of(trajectory)
    return {name: events.frame(name) for name in EVENTS}


def _outcomes(viewed: ViewedRun, trajectory: Trajectory, row: dict[str, Any]) -> dict[str, str]:
    """Return the outcome under every rule at the last step."""
    scene = viewed.run.settings["scene"]
    return {
        name: judge(trajectory, rule_of(name, scene), row["side_correct"], 1, scene["max_steps"]).outcome
        for name in RULES
    }


# -- all episodes ------------------------------------------------------------------------------------------------


_WORDS = {
    "item": "item_id",
    "category": "category",
    "layout": "layout",
    "instruction": "instruction",
    "target": "target_concept",
    "distractor": "distractor_concept",
    "side_correct": "side_correct",
    "side_placed": "side_placed",
    "ending": "truncation_reason",
}
"""Coded columns by the column of `run.episodes`; None where the run has no such column."""
_SHORT = 12
"""Number of hexadecimal digits that distinguish the seeds of episodes."""


def episodes_payload(viewed: ViewedRun) -> dict[str, Any]:
    """Return numbers, ids and words of all episodes in the order of the plan.

    `log_odds` are of the category's best sites, held out, at the inference that the probes are of, toward the
    correct side. `swap` is of the stored image swap, 1 where the action follows the pictures, -1 where it does the
    reverse, else 0; None without any. `seeds` are equal where scene and policy seed are equal, by which runs are
    paired.
    """
    episodes = viewed.run.episodes
    words = _WORDS | ({"item": "picture"} if "picture" in episodes else {})
    none, zeros = [None] * len(episodes), [0] * len(episodes)
    return {
        "number": [int(number) for number in episodes["episode"]],
        "id": [str(name) for name in episodes["episode_id"]],
        **{
            name: code_words([_word(value) for value in episodes[column]] if column in episodes else none)
            for name, column in words.items()
        },
        "outcome": code_words([viewed.outcome_word(_word(value)) for value in episodes["outcome"]]),
        "steps": [None if value is None else int(value) for value in episodes.get("steps", none)],
        "distance": [round_number(value, 3) for value in episodes.get("distance_correct", none)],
        "seeds": [
            sha256_json([int(scene), int(policy)])[:_SHORT]
            for scene, policy in zip(episodes.get("scene_seed", zeros), episodes["policy_seed"], strict=True)
        ],
        "first_frame": [
            None if value is None else str(value)[:_SHORT] for value in episodes.get(FIRST_FRAME, none)
        ],
        "swap": _swap_responses(viewed),
        "log_odds": {part: _best_log_odds(viewed, part) for part in ("backbone", "action")},
    }


def _swap_responses(viewed: ViewedRun) -> list[int | None]:
    responses = swap_responses_by_episode(viewed.run) if viewed.run.source.is_scene else {}
    return [responses.get(str(name)) for name in viewed.run.episodes["episode_id"]]


def _word(value: Any) -> str | None:
    return None if value is None or value != value else str(value)


def _best_log_odds(viewed: ViewedRun, part: str) -> PackedArray | None:
    """Return the packed log-odds (E,) of the best sites; None without probes of that part."""
    best_of_category = {name: best_sites(viewed, name)[part] for name in viewed.probed_categories}
    if all(best is None for best in best_of_category.values()):
        return None
    log_odds = np.full(len(viewed.run.episodes), np.nan)
    for position, category in enumerate(viewed.run.episodes["category"]):
        best = best_of_category.get(category)
        if best is not None:
            log_odds[position] = viewed.probes[category].first(position)[best["site"]]
    return pack_log_odds(log_odds)
