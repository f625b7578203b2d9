"""Trajectories in a run: one array beside the streams, one chunk per episode, named in the episode's commit.

    data.zarr/trajectory   float32 (episode, frame, channel); frames behind the end of an episode are not numbers

Frames and channels are those of `probe_kit.env.scoring`.
"""

from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.core.array_spec import ArrayConfigLike

from probe_kit.env.scoring import CHANNELS, Trajectory
from probe_kit.errors import RunDamagedError
from probe_kit.runs.arrays import ROOM, codecs
from probe_kit.runs.commits import Commit
from probe_kit.runs.layout import TRAJECTORY
from probe_kit.runs.rows import Rows


def create_trajectories(store: Store, frames: int, codec: str) -> None:
    """Create the array: `frames` is one more than an episode has actions at most."""
    zarr.create_array(
        store,
        name=TRAJECTORY,
        shape=(ROOM, frames, len(CHANNELS)),
        chunks=(1, frames, len(CHANNELS)),
        dtype="float32",
        fill_value=np.nan,
        compressors=codecs(codec, typesize=4),
        dimension_names=("episode", "frame", "channel"),
        attributes={"channels": list(CHANNELS)},
        config={"write_empty_chunks": True},
    )


def names_trajectory(commit: Commit) -> bool:
    """Whether an episode's commit names a trajectory; one that did not act has none."""
    return any(key.startswith(f"{TRAJECTORY}/") for key in commit.objects)


def write_trajectory(store: Store, number: int, frames: NDArray[np.float32], config: ArrayConfigLike) -> None:
    """Store the frames (T + 1, C) of episode `number`."""
    array: zarr.Array[Any] = zarr.open_array(store, path=TRAJECTORY, mode="r+", zarr_format=3, config=config)
    row = np.full(array.shape[1:], np.nan, np.float32)
    row[: len(frames)] = frames
    array[number] = row


class Trajectories:
    """The trajectories of the committed episodes of a run, in their order.

    rows: of the array `trajectory`. steps: how many actions every committed episode had. where: the run's name.
    Raises RunDamagedError if a channel that is read today is not among the stored ones.
    """

    def __init__(self, rows: Rows, steps: Sequence[int], where: str) -> None:
        self._rows, self._steps, self._where = rows, steps, where
        channels = [str(name) for name in cast("list[str]", self._rows.array.attrs["channels"])]
        if lacking := [name for name in CHANNELS if name not in channels]:
            raise RunDamagedError(
                f"the trajectories of {where} lack {', '.join(lacking)}; another version of probe_kit stored "
                "them. Read them with the version that the run's provenance names"
            )
        self._columns = [channels.index(name) for name in CHANNELS]

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, position: int) -> Trajectory:
        """Return that of one episode. Raises RunDamagedError if stored bytes are missing, changed or too few."""
        return self._trajectory(self._rows[position], self._steps[position])

    def __iter__(self) -> Iterator[Trajectory]:
        return map(self._trajectory, self._rows, self._steps)

    def _trajectory(self, row: NDArray[np.float32], steps: int) -> Trajectory:
        frames = steps + 1
        if frames > len(row):
            raise RunDamagedError(
                f"a trajectory of {self._where} has room for {len(row)} frames; its outcome says {frames - 1} "
                "actions. Check the run with `probe-kit run verify --deep`"
            )
        return Trajectory.of_frames(row[:frames, self._columns])
