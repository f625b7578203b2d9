"""Sentences about inputs of a run that have no content, or on which its first output did not depend."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.errors import RunDamagedError
from probe_kit.runs.input_content import EPISODE, FILE, MOST_EPISODES, EpisodeFrames, content_notes
from probe_kit.runs.layout import source_settings_of
from probe_kit.runs.provenance import INPUT_CONTENT, input_notes
from probe_kit.runs.reader import reached_calls

if TYPE_CHECKING:
    from probe_kit.runs.reader import RunReader

IMAGE = "image"
"""The encoding of pictures that went through no video, in the settings of a run."""


def notes_of_inputs(run: "RunReader") -> list[str]:
    """Return a sentence for every input of a run that its first output did not depend on, or without content."""
    return [*input_notes(run.certificate), *notes_of_content(run)]


def notes_of_content(run: "RunReader") -> list[str]:
    """Return a sentence for every input without content of a run's recordings, environment or pictures.

    They are those of the pictures and states that the run stores. Of a run without pictures, and of a copy without
    its arrays, they are those of the frames at which it looked before it was played.
    """
    if not len(run.episodes):
        return []
    inputs = run.inputs
    if inputs is not None and "pixels" in inputs.kinds:
        cameras: list[Any] = source_settings_of(run.settings)["cameras"]
        names = [camera if isinstance(camera, str) else camera[0] for camera in cameras]
        lossy = [camera[0] for camera in cameras if not isinstance(camera, str) and camera[2] != IMAGE]
        is_folder = "picture" in run.episodes
        with suppress(RunDamagedError):  # `run verify` is the command that reports damage
            return content_notes(
                _files(run) if is_folder else _stored_inputs(run), names, lossy, FILE if is_folder else EPISODE
            )
    records: Sequence[Mapping[str, Any]] = run.certificate.get("processes", [run.certificate])
    return list(dict.fromkeys(note for record in records for note in record.get(INPUT_CONTENT, ())))


def _positions(count: int) -> list[int]:
    positions: list[int] = np.unique(
        np.linspace(0, count - 1, min(count, MOST_EPISODES)).round().astype(int)
    ).tolist()
    return positions


def _stored_inputs(run: "RunReader") -> list[EpisodeFrames]:
    """Return stored pictures and states of some episodes; the first and last row of a recorded one are joined."""
    rows_of: dict[str, list[int]] = {}
    for row, item in enumerate(run.episodes["item_id"].astype(str)):
        rows_of.setdefault(item, []).append(row)
    items, counts = list(rows_of.values()), reached_calls(run).sum(axis=1).tolist()
    names = run.episodes["source_episode" if run.recorded else "item_id"].astype(str).tolist()
    ends = [tuple(dict.fromkeys((rows[0], rows[-1]))) for rows in items]
    return [_frames(run, names[ends[at][0]], ends[at], counts) for at in _positions(len(ends))]


def _files(run: "RunReader") -> list[EpisodeFrames]:
    """Return some stored pictures of a folder, each file once."""
    row_of = {str(file): row for row, file in reversed(list(enumerate(run.episodes["picture"])))}
    names, counts = list(row_of), reached_calls(run).sum(axis=1).tolist()
    return [_frames(run, names[at], [row_of[names[at]]], counts) for at in _positions(len(names))]


def _frames(run: "RunReader", name: str, rows: Sequence[int], counts: Sequence[int]) -> EpisodeFrames:
    inputs = run.inputs
    assert inputs is not None
    pictures = np.concatenate([inputs.row("pixels", row)[: counts[row]] for row in rows])
    if "state" not in inputs.kinds:
        return EpisodeFrames(name, pictures)
    states = [inputs.row("state", row)[: counts[row]] for row in rows]
    return EpisodeFrames(name, pictures, np.concatenate(states).astype(np.float64))
