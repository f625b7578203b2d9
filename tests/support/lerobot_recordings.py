"""Small LeRobotDatasets, written by lerobot itself."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.machine import same_scheduling
from probe_kit.hooks.contract.observation import Observation

CAMERA = "observation.images.top"
FPS = 5


@same_scheduling()
def write_recording(
    folder: Path,
    episodes: Iterable[Sequence[Observation]],
    actions: int = 7,
    videos: bool = False,
    tasks: Mapping[tuple[int, int], str] | None = None,
    more: Mapping[str, Any] | None = None,
) -> Path:
    """What observations hold as a data set of format 3.0: pictures as PNG, states and zero actions.

    videos: encode pictures as video. tasks: of single frames, by episode and frame. more: features beside these,
    with a function of episode and frame.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    episodes = [list(one) for one in episodes]
    first = episodes[0][0]
    features: dict[str, Any] = {
        CAMERA: {
            "dtype": "video" if videos else "image",
            "shape": first.image.shape,
            "names": ["height", "width", "channels"],
        },
        "observation.state": {
            "dtype": "float32",
            "shape": first.state.shape,
            "names": [f"s{place}" for place in range(len(first.state))],
        },
        "action": {"dtype": "float32", "shape": (actions,), "names": None},
    }
    extra = dict(more or {})
    features |= {name: {"dtype": "float32", "shape": (1,), "names": None} for name in extra}
    data = LeRobotDataset.create("local/recording", FPS, features, root=folder, use_videos=videos)
    for number, episode in enumerate(episodes):
        for frame, seen in enumerate(episode):
            data.add_frame(
                {
                    CAMERA: seen.image,
                    "observation.state": seen.state,
                    "action": np.full(actions, 10 * number + frame, np.float32),
                    "task": (tasks or {}).get((number, frame), seen.instruction),
                    **{name: np.array([of(number, frame)], np.float32) for name, of in extra.items()},
                }
            )
        data.save_episode()
    data.finalize()
    return folder
