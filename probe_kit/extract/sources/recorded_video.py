"""A video file of recordings: the exact times of its frames, without decoding, and the picture at one of them."""

from bisect import bisect_right
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.suite.pictures import LARGEST_PICTURE

_TIMELESS = "has no frame with a time. Write it again as MP4"


class VideoError(Exception):
    """A video that cannot be read."""


class RecordedVideo:
    """The first video stream of a file.

    Attributes:
        base: The seconds of a tick, in which the stream counts time.
        times: The times of all frames that are shown, in ticks, ascending. Edit lists are applied.
        rate: The frames per second by its header; 0 where it says none.

    Raises:
        VideoError: For a file that PyAV does not open, without a video or its times, or with too large pictures.
    """

    def __init__(self, path: Path) -> None:
        import av

        self._path = path
        try:
            self._container = av.open(str(path))
            stream = self._stream = self._container.streams.video[0]
        except (av.error.FFmpegError, IndexError, OSError) as error:
            reason = str(error)[:200]
            raise VideoError(f"is no video that PyAV opens ({reason}). Copy the data set again") from error
        if max(stream.width, stream.height) > LARGEST_PICTURE:
            raise VideoError(
                f"claims to be {stream.width}×{stream.height} pixels; at most {LARGEST_PICTURE} are read. Make it "
                "smaller"
            )
        if not stream.time_base:
            raise VideoError(_TIMELESS)
        self.base: Fraction = stream.time_base
        self.rate = float(stream.average_rate or 0)
        packets = [
            (packet.pts, packet.is_keyframe)
            for packet in self._demux()
            if packet.pts is not None and not packet.is_discard
        ]
        if not packets:
            raise VideoError(_TIMELESS)
        self._last: int | None = None
        self._decoding: Iterator[Any] = iter(())
        self.times = tuple(sorted(time for time, _ in packets))
        self._starts = tuple(sorted({self.times[0], *(time for time, is_start in packets if is_start)}))

    def _demux(self) -> Iterator[Any]:
        """Yield the packets up to the end of the file, or to the place where it is cut off."""
        import av

        try:
            yield from self._container.demux(self._stream)
        except av.error.FFmpegError:
            return

    def picture(self, time: int) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) uint8 at one of `times`.

        Decoding continues from the last picture, or begins at the last key frame before the time. Pictures before
        a key frame in time may lie behind it in the file. Then decoding begins one key frame earlier, or at the
        first.

        Raises:
            VideoError: If the stream shows no whole picture at that time.
        """
        import av

        reason = "no picture was decoded"
        for frames in self._attempts(time):
            try:
                for frame in frames:
                    if frame.pts is None:
                        continue
                    self._last = frame.pts
                    if frame.pts == time and not frame.is_corrupt:
                        return np.ascontiguousarray(frame.to_ndarray(format="rgb24"))
                    if frame.pts >= time:
                        break
            except (av.error.FFmpegError, OSError) as error:
                reason = f"{type(error).__name__}: {str(error)[:200]}"
        self._last = None
        raise VideoError(reason)

    def _attempts(self, time: int) -> Iterator[Iterator[Any]]:
        """Yield decoded frames from one place after another, the nearest one before a time first."""
        count = bisect_right(self._starts, time)
        starts = self._starts[max(count - 2, 0) : count]
        if self._last is not None and starts[-1] <= self._last < time:
            yield self._decoding
        for start in (*reversed(starts), None):
            self._decoding = self._decode(start)
            yield self._decoding

    def _decode(self, start: int | None) -> Iterator[Any]:
        """Yield the frames from a time on, or of the file opened again for None: not every format can seek."""
        import av

        if start is None:
            with av.open(str(self._path)) as container:
                yield from container.decode(video=0)
            return
        self._container.seek(start, backward=True, any_frame=False, stream=self._stream)
        yield from self._container.decode(self._stream)
