"""Data sets that lerobot's own tools edited show pictures, words and numbers of their source, frame by frame."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit._system.machine import same_scheduling
from probe_kit.extract import LeRobotSource
from probe_kit.extract.sources.recording_source import RecordingSource

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("_lerobot_cache")]
TOP, WRIST = "observation.images.top", "observation.images.wrist"
FPS = 10
LENGTHS = (3, 5, 4, 6, 2)
TEXTS = ("Put the cube on the red shape", "Put the cube on the gray shape")
CODED = 6.0
"""The largest mean distance of a picture of a video, coded twice, from its source."""


@dataclass(frozen=True)
class Expected:
    """An episode of the source, by its number, and its words where they were changed."""

    episode: int
    text: str | None = None


def picture(camera: str, episode: int, frame: int) -> np.ndarray:
    """A ramp, which a codec keeps, in shades that no other frame of any camera has."""
    ramp = np.linspace(0, 40, 64, dtype=np.uint8)[None, :, None]
    shades = np.array([30 * episode + 20, 30 * frame + 20, 150 if camera == TOP else 60], np.uint8)
    return np.broadcast_to(ramp + shades, (48, 64, 3)).copy()


def state(episode: int, frame: int) -> np.ndarray:
    return np.array([episode, frame, 10 * episode + frame], np.float32)


def words(episode: int, frame: int) -> str:
    """The words of episode 3 change in its midst."""
    return TEXTS[(episode + (episode == 3 and frame > 2)) % 2]


@same_scheduling()
def write(folder: Path, videos: bool) -> Path:
    from lerobot.datasets import LeRobotDataset

    kind = "video" if videos else "image"
    pixels = {"dtype": kind, "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
    features = {
        **dict.fromkeys((TOP, WRIST), pixels),
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
        "action": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
    }  # fmt: skip
    data = LeRobotDataset.create("local/source", FPS, features, root=folder, use_videos=videos)
    for episode, length in enumerate(LENGTHS):
        for frame in range(length):
            numbers = {"observation.state": state(episode, frame), "action": state(episode, frame)}
            pictures = {camera: picture(camera, episode, frame) for camera in (TOP, WRIST)}
            data.add_frame({**pictures, **numbers, "task": words(episode, frame)})
        data.save_episode()
    data.finalize()
    return folder


@pytest.fixture(scope="module", params=["image", "video"])
def source(request: pytest.FixtureRequest, _lerobot_cache: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp(request.param) / "source", request.param == "video")


def opened(folder: Path) -> Any:
    from lerobot.datasets import LeRobotDataset

    return LeRobotDataset(f"local/{folder.name}", root=folder)


def check(folder: Path, episodes: Sequence[Expected], cameras: Sequence[str] = (TOP, WRIST)) -> None:
    """Compare every frame with the source, as `extract` reads it."""
    opened_source = RecordingSource.open(LeRobotSource(str(folder)), False)
    opened_source.check_frames()
    assert opened_source.folder.cameras == list(cameras)
    assert opened_source.folder.lengths == [LENGTHS[expected.episode] for expected in episodes]
    for number, expected in enumerate(episodes):
        frames = range(LENGTHS[expected.episode])
        texts = [expected.text or words(expected.episode, frame) for frame in frames]
        assert opened_source._texts(number) == texts
        states = opened_source.reader.numbers(number, ["observation.state"])["observation.state"]
        np.testing.assert_array_equal(states, [state(expected.episode, frame) for frame in frames])
        for frame in frames:
            for camera, pixels in opened_source.reader.pictures(number, frame, cameras).items():
                due = picture(camera, expected.episode, frame)
                far = np.abs(pixels.astype(float) - due).mean()
                assert far == 0 if not opened_source.folder.is_video(camera) else far < CODED, (
                    number,
                    frame,
                    camera,
                )


def all_but(*left_out: int) -> list[Expected]:
    return [Expected(episode) for episode in range(len(LENGTHS)) if episode not in left_out]


# -- one edit ----------------------------------------------------------------------------------------------------


def test_the_source_itself(source: Path) -> None:
    check(source, all_but())


@pytest.mark.parametrize("episodes", [[0], [1, 3], [4], [0, 1, 2, 3]])
def test_deleted_episodes(source: Path, tmp_path: Path, episodes: list[int]) -> None:
    from lerobot.datasets import delete_episodes

    delete_episodes(opened(source), episodes, tmp_path / "rest", "local/rest")
    check(tmp_path / "rest", all_but(*episodes))


@pytest.mark.parametrize("splits", [{"train": [0, 2], "val": [1, 3, 4]}, {"train": 0.6, "val": 0.4}])
def test_splits(source: Path, tmp_path: Path, splits: dict[str, Any]) -> None:
    from lerobot.datasets import split_dataset

    split_dataset(opened(source), splits, tmp_path)
    first = splits["train"] if isinstance(splits["train"], list) else [0, 1, 2]
    check(tmp_path / "train", [Expected(episode) for episode in first])
    check(tmp_path / "val", all_but(*first))


@pytest.mark.parametrize("together", [True, False])
def test_merged_data_sets(source: Path, tmp_path: Path, together: bool) -> None:
    from lerobot.datasets import merge_datasets

    other = Path(shutil.copytree(source, tmp_path / "other"))
    sets = [opened(source), opened(other)]
    merge_datasets(sets, "local/both", tmp_path / "both", concatenate_videos=together, concatenate_data=together)
    check(tmp_path / "both", all_but() + all_but())


@pytest.mark.parametrize("camera", [TOP, WRIST])
def test_recordings_are_read_after_lerobot_removed_a_camera(source: Path, tmp_path: Path, camera: str) -> None:
    from lerobot.datasets import remove_feature

    remove_feature(opened(source), camera, tmp_path / "single", "local/single")
    check(tmp_path / "single", all_but(), [name for name in (TOP, WRIST) if name != camera])


NEW = "Put the cube on the blue shape"
WORDS: dict[str, tuple[dict[str, Any], Callable[[int, str], str]]] = {
    "of all episodes": ({"new_task": NEW}, lambda *_: NEW),
    "of all but one": (
        {"new_task": NEW, "episode_tasks": {1: TEXTS[0]}},
        lambda episode, _: TEXTS[0] if episode == 1 else NEW,
    ),
    "a text": ({"task_replacements": {TEXTS[0]: NEW}}, lambda _, first: NEW if first == TEXTS[0] else first),
}


@pytest.mark.parametrize("kind", WORDS)
def test_new_words(source: Path, tmp_path: Path, kind: str) -> None:
    """lerobot gives all frames of an episode one text, the new one of the first in its list of tasks."""
    from lerobot.datasets import modify_tasks

    folder = Path(shutil.copytree(source, tmp_path / "set"))
    change, text = WORDS[kind]
    data = opened(folder)
    firsts = [data.meta.episodes[episode]["tasks"][0] for episode in range(len(LENGTHS))]
    modify_tasks(data, **change)
    check(folder, [Expected(episode, text(episode, first)) for episode, first in enumerate(firsts)])


def test_new_statistics(source: Path, tmp_path: Path) -> None:
    from lerobot.datasets import recompute_stats

    folder = Path(shutil.copytree(source, tmp_path / "set"))
    recompute_stats(opened(folder))
    check(folder, all_but())


def test_pictures_that_became_videos(tmp_path: Path) -> None:
    from lerobot.datasets import convert_image_to_video_dataset

    source = write(tmp_path / "source", False)
    convert_image_to_video_dataset(opened(source), tmp_path / "videos", "local/videos", num_workers=1)
    check(tmp_path / "videos", all_but())


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_videos_that_were_coded_again(tmp_path: Path, codec: str) -> None:
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import reencode_dataset

    source = write(tmp_path / "source", True)
    reencode_dataset(opened(source), rgb_encoder=RGBEncoderConfig(vcodec=codec), num_workers=0)
    check(source, all_but())


# -- several edits -----------------------------------------------------------------------------------------------


def test_edits_one_after_another(source: Path, tmp_path: Path) -> None:
    """Delete, merge with the source, split, remove a camera, and change the words."""
    from lerobot.datasets import delete_episodes, merge_datasets, modify_tasks, remove_feature, split_dataset

    remaining = delete_episodes(opened(source), [1, 4], tmp_path / "rest", "local/rest")
    both = merge_datasets([remaining, opened(source)], "local/both", tmp_path / "both")
    order = all_but(1, 4) + all_but()
    check(tmp_path / "both", order)
    split_dataset(both, {"train": [1, 2, 5, 7], "val": [0, 3]}, tmp_path)
    remove_feature(opened(tmp_path / "train"), TOP, tmp_path / "single", "local/single")
    modify_tasks(opened(tmp_path / "single"), new_task=NEW)
    check(tmp_path / "val", [order[0], order[3]])
    check(tmp_path / "single", [Expected(order[number].episode, NEW) for number in (1, 2, 5, 7)], [WRIST])
