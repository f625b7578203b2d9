"""Inputs without content: black and stuck cameras, one camera under two names, a constant state."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.runs.input_content import CODEC_NOISE, FILE, EpisodeFrames, content_notes

EPISODES, FRAMES, SIDE = 4, 3, 32
SCENE = np.random.default_rng(0).integers(30, 200, (SIDE, SIDE, 3)).astype(np.uint8)
Show = Callable[[int, int], NDArray[np.uint8]]


def plain(*levels: int) -> NDArray[np.uint8]:
    return np.full((SIDE, SIDE, 3), levels, np.uint8)


def moving(episode: int, frame: int) -> NDArray[np.uint8]:
    picture = SCENE.copy()
    picture[4 + episode, 5 * frame : 5 * frame + 2] = 240
    return picture


def noise(episode: int, frame: int, most: int = CODEC_NOISE // 2) -> NDArray[np.uint8]:
    """Noise of a video."""
    return np.random.default_rng([episode, frame]).integers(0, most + 1, (SIDE, SIDE, 3)).astype(np.uint8)


def arm(episode: int, frame: int) -> NDArray[np.float64]:
    return np.array([episode, frame / 2, 1.0])


def episodes(*cameras: Show, state: Callable[[int, int], NDArray[np.float64]] | None = arm) -> list[EpisodeFrames]:
    return [
        EpisodeFrames(
            str(episode),
            np.stack([np.stack([show(episode, frame) for show in cameras]) for frame in range(FRAMES)]),
            None if state is None else np.stack([state(episode, frame) for frame in range(FRAMES)]),
        )
        for episode in range(EPISODES)
    ]


def notes(*cameras: Show, lossy: bool = False, **options: object) -> list[str]:
    names = ["top", "wrist"][: len(cameras)]
    return content_notes(episodes(*cameras, **options), names, names if lossy else ())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("show", "note"),
    [
        (lambda *_: plain(0, 0, 0), "top shows nothing but black, in all 12 pictures looked at"),
        (lambda e, f: noise(e, f, 5), "top shows nothing but black, in all 12 pictures looked at"),
        (lambda *_: plain(255, 255, 255), "nothing but white"),
        (lambda *_: plain(200, 20, 40), r"nothing but one colour \(RGB 200, 20, 40\)"),
        (lambda e, f: plain(0, 0, 0) if e in (1, 2) else moving(e, f), r"black in episodes 1 and 2 \(2 of 4"),
        (lambda *_: SCENE, "top shows the same picture in all 4 episodes looked at"),
        (lambda e, _: moving(e, 0), "top shows one picture from beginning to end of all 4 episodes looked at"),
        (lambda e, f: moving(e, f if e else 0), r"from beginning to end of episode 0 \(1 of 4 looked at\)"),
    ],
)
@pytest.mark.parametrize("state", [arm, None])
def test_a_camera_without_content_is_named(show: Show, note: str, state: object) -> None:
    (line,) = notes(show, state=state)
    assert re.search(note, line)


@pytest.mark.parametrize("lossy", [True, False])
def test_noise_of_a_video_hides_no_stuck_camera_and_pictures_without_video_are_compared_exactly(
    lossy: bool,
) -> None:
    lines = notes(lambda e, f: SCENE + noise(e, f), lossy=lossy)
    assert lines == ["top shows the same picture in all 4 episodes looked at"] * lossy


def test_one_camera_under_two_names_is_named_and_two_of_one_scene_are_not() -> None:
    assert notes(moving, lambda e, f: moving(e, f) + noise(e, f) // 2) == ["top and wrist show the same picture"]
    assert notes(moving, lambda e, f: moving(e, f)[:, ::-1]) == []


def test_a_constant_state_is_named() -> None:
    assert notes(moving, state=lambda *_: np.ones(3)) == ["the state is the same at all 12 frames looked at"]
    assert notes(moving, state=lambda *_: np.zeros(3))[0].endswith("(all zeros)")
    (line,) = notes(moving, state=lambda e, _: np.full(3, float(e)))
    assert line == "the state does not change within any of 4 episodes looked at"


@pytest.mark.parametrize(
    "show",
    [
        moving,
        lambda e, f: SCENE if f == 0 else moving(e, f),  # scenes are set up alike
        lambda e, f: plain(0, 0, 0) if f == 0 else moving(e, f),  # a film that fades in
        lambda e, f: plain(20 + 30 * e, 20 + 30 * f, 128),  # its colour says where it is from
    ],
)
def test_pictures_that_say_something_are_not_cried_about(show: Show) -> None:
    assert notes(show) == []


def test_an_arm_at_rest_needs_no_other_picture() -> None:
    """In episode 0 only the noise of the joints moves."""

    def state(episode: int, frame: int) -> NDArray[np.float64]:
        return np.array([0.001 * frame, 0, 0]) if episode == 0 else arm(episode, frame)

    assert notes(lambda e, f: moving(e, f if e else 0), state=state) == []


def test_two_frames_of_an_episode_cannot_tell() -> None:
    short = [
        EpisodeFrames(each.name, each.pictures[:2], each.state) for each in episodes(lambda e, _: moving(e, 0))
    ]
    assert content_notes(short, ["top"]) == content_notes([], ["top"]) == []


def test_files_of_a_folder_are_compared_with_each_other() -> None:
    def folder(show: Show, count: int) -> list[str]:
        files = [EpisodeFrames(f"{number}.png", show(number, 0)[None, None]) for number in range(count)]
        return content_notes(files, ["picture"], unit=FILE)

    assert folder(lambda *_: SCENE, 3) == ["picture shows the same picture in all 3 files looked at"]
    assert folder(lambda *_: SCENE, 2) == folder(moving, 3) == []
    assert folder(lambda n, _: plain(0, 0, 0) if n == 1 else moving(n, 0), 4) == [
        "picture shows nothing but black in file 1.png (1 of 4 looked at)"
    ]
