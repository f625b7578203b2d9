"""Films of the episodes of a run: H.264 in MP4, which every browser and presentation plays."""

from fractions import Fraction
from pathlib import Path

import numpy as np

from probe_kit._system.optional_dependencies import require
from probe_kit.extract.store.films.filmed_episodes import control_rate, episode_name, filmed_episodes
from probe_kit.extract.store.run import Run
from probe_kit.extract.store.small_frames import SmallFrames

CODEC = "libx264"
QUALITY = {"crf": "20", "preset": "medium"}


def write_films(run: Run, folder: Path) -> None:
    """One film per episode, `<number>-<category>-<outcome>.mp4`, in the speed at which the arm was controlled.

    Raises UsageError for a run without all frames, MissingExtraError without PyAV, and RunDamagedError.
    """
    require("av", "datasets")
    rate = Fraction(control_rate(run)).limit_denominator(1000)
    for one in filmed_episodes(run):
        folder.mkdir(exist_ok=True)
        _write_film(folder / f"{episode_name(one)}.mp4", one.frames, rate)


def _write_film(path: Path, frames: SmallFrames, rate: Fraction) -> None:
    av = require("av", "datasets")
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])  # H.264 halves the colours in both directions
    with av.open(str(path), "w") as film:
        stream = film.add_stream(CODEC, rate=rate, options=QUALITY)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame[:height, :width]), format="rgb24")
            film.mux(stream.encode(picture))
        film.mux(stream.encode())
