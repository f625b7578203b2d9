"""Small frames of an episode as one picture: the first and last one (2 kB), or all of them (4 kB each).

They illustrate: no number depends on them. The commit of their episode names the picture with its hash, because a
reader of a report believes what it shows. All pictures may be deleted, not single ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image

from probe_kit.errors import RunDamagedError
from probe_kit.runs.commits import Commit, commit_key, redo, redo_picture
from probe_kit.runs.layout import CAPTURE_ONLY, FRAME_COLUMNS, FRAMES, FrameChoice, source_settings_of
from probe_kit.runs.reader import RunReader
from probe_kit.runs.small_frames import SmallFrames, shrink
from probe_kit.runs.store import Location, locate
from probe_kit.suite.pictures import decode_bytes

if TYPE_CHECKING:
    import pandas as pd

_LARGEST_SHEET = 16_383
"""The most pixels of the longer side, a limit of WebP."""
_CODING: dict[FrameChoice, dict[str, int]] = {
    "ends": {"quality": 85, "method": 4},
    "all": {"quality": 80, "method": 0},
}
"""The settings of the WebP encoder; method 2 would save a fifth of a sheet's bytes, and take twice the time."""


@dataclass(frozen=True)
class FrameSheet:
    """The stored picture of an episode.

    Attributes:
        content: The WebP.
        count: The number of frames it holds, one before the first action and one behind each. None in a picture of
            the first and last frame.
    """

    content: bytes
    count: int | None


@dataclass(frozen=True)
class ThumbnailFrames:
    """The frames of an episode as a reader is shown them.

    Attributes:
        content: One WebP of `count` frames.
        kind: `ends`: the first and the last one. `all`: one before the first action and one behind each.
            `inferences`: one per inference.
        cameras: The number of pictures side by side in a frame, from the first camera on.
    """

    content: bytes
    count: int
    kind: Literal["ends", "all", "inferences"]
    cameras: int = 1

    @cached_property
    def decoded(self) -> SmallFrames:
        """The frames one by one."""
        return decode_frames(self.content, self.count)


def episode_frames(run: RunReader, position: int) -> ThumbnailFrames | None:
    """Return the stored picture of the episode in a row, else one of what its inferences saw; None without either.

    Raises:
        RunDamagedError: For a picture that was changed.
    """
    row, inputs = run.episodes.iloc[position], run.inputs
    sheet = read_sheet(run.location, int(row.get("episode", position)))
    if sheet is not None and sheet.count is not None:
        return ThumbnailFrames(sheet.content, sheet.count, "all")
    cameras = len(source_settings_of(run.settings).get("cameras", ())) or 1
    if sheet is not None:
        return ThumbnailFrames(sheet.content, count_ends(row), "ends", cameras)
    if inputs is None or "pixels" not in inputs.kinds:
        return None
    inferences = int((run.control_steps[position] >= 0).sum())
    frames = tuple(np.hstack(list(pictures)) for pictures in inputs.row("pixels", position)[:inferences])
    return ThumbnailFrames(as_thumbnail(frames, "all"), len(frames), "inferences", cameras) if frames else None


def count_ends(episode: "Mapping[Any, Any] | pd.Series[Any]") -> int:
    """Return how many frames a picture of the first and last one holds: without acting there is no last one."""
    return 1 if "parse" in episode or episode["outcome"] == CAPTURE_ONLY else 2


def as_thumbnail(frames: SmallFrames, choice: FrameChoice = "ends") -> bytes:
    """Return the frames as one WebP, `FRAME_COLUMNS` to a row; black behind the last one."""
    columns = min(len(frames), FRAME_COLUMNS)
    blank = [np.zeros_like(frames[0])] * (-len(frames) % columns)
    full = [*frames, *blank]
    rows = [np.hstack(full[start : start + columns]) for start in range(0, len(full), columns)]
    encoded = BytesIO()
    Image.fromarray(np.vstack(rows)).save(encoded, "WEBP", **_CODING[choice])
    return encoded.getvalue()


def decode_frames(content: bytes, count: int) -> SmallFrames:
    """Return the `count` frames of a picture that `as_thumbnail` made."""
    columns = min(count, FRAME_COLUMNS)
    rows = -(-count // columns)
    pixels = np.asarray(
        decode_bytes(
            content, "the stored frames:", RunDamagedError, "Extract the run again.", largest=_LARGEST_SHEET
        )
    )
    # The inverse of `hstack` and `vstack`: a grid of cells, then one cell after another, row by row.
    cells = pixels.reshape(rows, pixels.shape[0] // rows, columns, pixels.shape[1] // columns, 3).swapaxes(1, 2)
    return tuple(cells.reshape(-1, *cells.shape[2:])[:count])


def read_thumbnail(run: Path | Location, number: int) -> bytes | None:
    """Return a WebP of episode `number`, first frame left and last frame right; None if the run keeps none.

    Raises:
        RunDamagedError: For a picture that was changed, or is lost alone.
    """
    sheet = read_sheet(run, number)
    if sheet is None or sheet.count is None:
        return None if sheet is None else sheet.content
    first, *later = decode_frames(sheet.content, sheet.count)
    return as_thumbnail(tuple(shrink(frame) for frame in (first, *later[-1:])))


def read_sheet(run: Path | Location, number: int) -> FrameSheet | None:
    """Return the picture of episode `number` as it is stored; None if the run keeps none.

    Pictures of arrays that are no run have no hash to be checked against.

    Raises:
        RunDamagedError: If it is not the one that was stored when the episode was committed, or is lost alone.
    """
    location, key = locate(run), thumbnail_key(number)
    commit, name = None, f"{location}/{commit_key(number)}"
    if location.exists(commit_key(number)):
        commit = Commit.parse(location.read(commit_key(number)), name, redo(number), episode=number)
        if key not in commit.pictures:
            return None
    try:
        content = location.read(key)
    except FileNotFoundError:
        if commit is None or not location.keys(FRAMES):
            return None
        raise RunDamagedError(f"{location}/{key} is missing. {redo_picture(number)}") from None
    if commit is not None and (problem := commit.pictures[key].problem(content)):
        raise RunDamagedError(f"{location}/{key} {problem}. {redo_picture(number)}")
    return FrameSheet(content, None if commit is None else commit.frames)


def thumbnail_key(number: int) -> str:
    """Return the key of the thumbnail of episode `number`."""
    return f"{FRAMES}/{number:08d}.webp"
