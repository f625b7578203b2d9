"""The frames of a run's episodes, as exports take them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from probe_kit.errors import UsageError
from probe_kit.extract.store.format.commits import FRAME_COUNT
from probe_kit.extract.store.run import Run
from probe_kit.extract.store.small_frames import SmallFrames
from probe_kit.extract.store.thumbnails import decode_frames, read_sheet


@dataclass(frozen=True)
class FilmedEpisode:
    """position: its row in `run.episodes`. row: that row. frames: one before the first action, one behind each."""

    position: int
    row: dict[str, Any]
    frames: SmallFrames


def filmed_episodes(run: Run) -> Iterator[FilmedEpisode]:
    """Every episode with its frames, decoded one at a time.

    Raises UsageError before the first if an episode was played without `--frames all`, or its frames were deleted.
    """
    rows = run.episodes.to_dict("records")
    for commit in run.commits():
        if FRAME_COUNT not in commit:
            raise UsageError(
                f"{run.location} does not keep every frame of episode {commit['episode_id']}. Extract it again to "
                "another --out, with --frames all"
            )
    for position, row in enumerate(rows):
        sheet = read_sheet(run.location, int(row["episode"]))
        if sheet is None or sheet.count is None:
            raise UsageError(f"{run.location} has lost its frames; its folder of pictures was deleted")
        named = {str(name): value for name, value in row.items()}
        yield FilmedEpisode(position, named, decode_frames(sheet.content, sheet.count))


def episode_name(one: FilmedEpisode) -> str:
    """What a file of this episode is called: `<number>-<category>-<outcome>`."""
    return f"{one.row['episode']:08d}-{one.row['category']}-{one.row['outcome']}"


def control_rate(run: Run) -> float:
    """Actions per second of the run's scene. Raises UsageError for a run without a scene."""
    scene = run.settings.get("scene")
    if scene is None:
        raise UsageError(f"{run.location} was not played in a scene")
    return float(scene["physics"]["rate"] / scene["physics"]["substeps"])
