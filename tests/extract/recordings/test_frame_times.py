"""A time names the frame that is nearest by far, in exact arithmetic, whatever a video counts time in."""

import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit._system.machine import same_scheduling
from probe_kit.errors import RecordingError
from probe_kit.extract import LeRobotSource
from probe_kit.extract.sources.frame_times import NONE, TickTimes, nearest_by_far
from probe_kit.extract.sources.lerobot_folder import LeRobotFrames, open_lerobot
from probe_kit.extract.sources.recorded_video import RecordedVideo
from probe_kit.extract.sources.recording import episodes_text, read_episodes
from probe_kit.extract.sources.recording_source import RecordingSource
from tests.extract.recordings.conftest import observations
from tests.support.lerobot_recordings import CAMERA, FPS, write_recording
from tests.support.slow_cases import slow_but

pytestmark = pytest.mark.usefixtures("_lerobot_cache")
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000"
LENGTHS = (5, 6, 7)
ORDER = [(episode, frame) for episode, length in enumerate(LENGTHS) for frame in range(length)]

# -- the rule ----------------------------------------------------------------------------------------------------


def nearest_frame(moment: Fraction, frames: list[Fraction], step: Fraction) -> int:
    """The rule by its definition, over all frames."""
    distances = [abs(frame - moment) for frame in frames]
    for position, distance in enumerate(distances):
        other_distances = distances[:position] + distances[position + 1 :]
        if 3 * distance <= step and all(other > distance and other >= 2 * distance for other in other_distances):
            return position
    return NONE


BASES = [Fraction(1, 90000), Fraction(1, 15360), Fraction(1, 1000), Fraction(1001, 30000), Fraction(1, 5)]
JITTERED = st.lists(st.tuples(st.integers(0, 12), st.sampled_from([0, 0, 1, 2, 3, 4, 5, -3])), max_size=12)
"""Numbers of frames, and tenths of a frame step by which they are late."""


@settings(max_examples=150, deadline=None)
@given(
    lines=JITTERED,
    begin=st.floats(0, 2000) | st.sampled_from([0.0, 1120.0, 1 / 3]),
    video_frames=JITTERED,
    base=st.sampled_from(BASES),
    fps=st.sampled_from([5.0, 30.0, 29.97, 30000 / 1001]),
)
def test_the_frame_that_is_nearest_by_far_is_that_of_fractions(
    lines: list[tuple[int, int]], begin: float, video_frames: list[tuple[int, int]], base: Fraction, fps: float
) -> None:
    """Videos may lack frames, and have two at one time."""
    step = 1 / (Fraction(fps) * base)
    frames = sorted(
        int((Fraction(begin) / base) + (number + Fraction(late, 10)) * step) for number, late in video_frames
    )
    seconds = [float(np.float32((number + late / 10) / fps)) for number, late in lines]
    match = nearest_by_far(TickTimes.of(seconds, begin, base), frames, step)
    moments = [(Fraction(begin) + Fraction(second)) / base for second in seconds]
    due = [nearest_frame(moment, list(map(Fraction, frames)), step) for moment in moments]
    assert match.positions.tolist() == due
    for moment, drift in zip(moments, match.drifts.tolist(), strict=True):
        nearest = min((abs(frame - moment) / step for frame in frames), default=None)
        assert drift == pytest.approx(np.inf if nearest is None else float(nearest), rel=1e-12)


@pytest.mark.parametrize(
    ("moment", "position"),
    [
        (Fraction(10, 3), 0),
        (Fraction(10, 3) + Fraction(1, 10**12), NONE),
        (Fraction(20, 3), 1),
        (Fraction(5), NONE),
        (Fraction(-10, 3), 0),
        (Fraction(70, 3), 2),
        (Fraction(24), NONE),
    ],
)
def test_a_third_of_a_step_is_the_last_distance_that_names_a_frame(moment: Fraction, position: int) -> None:
    times = TickTimes([moment.numerator], moment.denominator)
    assert nearest_by_far(times, [0, 10, 20], Fraction(10)).positions.tolist() == [position]


@pytest.mark.parametrize("episodes", [[0], [0, 1, 2], [1, 3, 4, 9], list(range(0, 20, 2))])
def test_episodes_are_written_as_they_are_read(episodes: list[int]) -> None:
    assert read_episodes(episodes_text(episodes)) == tuple(episodes)


# -- videos ------------------------------------------------------------------------------------------------------


def change(file: Path, column: str, of: Callable[[list[Any]], list[Any]]) -> None:
    table = pq.read_table(file)
    number, kind = table.schema.get_field_index(column), table.schema.field(column).type
    pq.write_table(table.set_column(number, column, pa.array(of(table.column(column).to_pylist()), kind)), file)


def shade(number: int) -> int:
    return 20 + 12 * number


@same_scheduling()
def film(file: Path, codec: str, rate: Fraction, count: int, muxer: dict[str, str], coder: dict[str, str]) -> None:
    """Write frames whose shade is their number."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w", options=muxer) as box:
        stream: Any = box.add_stream(codec, rate=rate, options=coder)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.time_base = 1 / rate
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), shade(number), np.uint8))
            frame.pts, frame.time_base = number, 1 / rate
            box.mux(stream.encode(frame))
        box.mux(stream.encode())


NTSC = Fraction(30000, 1001)
X264 = {"preset": "ultrafast", "g": "5"}
B_FRAMES = {"preset": "medium", "g": "6", "bf": "3", "b_strategy": "0", "sc_threshold": "0"}
X265 = {"x265-params": "keyint=6:bframes=3:log-level=none"}
CODED: dict[str, tuple[str, str, Fraction, dict[str, str], dict[str, str], float]] = {
    "H.264 in mp4": ("mp4", "libx264", Fraction(5), {}, X264, 0),
    "B-frames in mp4": ("mp4", "libx264", Fraction(30), {}, B_FRAMES, 0),
    "one key frame": ("mp4", "libx264", Fraction(30), {}, {**B_FRAMES, "g": "99"}, 0),
    "open groups of pictures": ("mp4", "libx264", Fraction(30), {}, {**B_FRAMES, "flags": "-cgop"}, 0),
    "H.265, open groups": ("mp4", "libx265", Fraction(30), {}, X265, 0),
    "29.97 in ticks of 1001": ("mp4", "libx264", NTSC, {}, B_FRAMES, 0),
    "a base of 1/90000": ("mp4", "libx264", NTSC, {"video_track_timescale": "90000"}, B_FRAMES, 0),
    "a base of 1/1000": ("mp4", "libx264", Fraction(30), {"video_track_timescale": "1000"}, B_FRAMES, 0),
    "milliseconds of mkv": ("mkv", "libx264", Fraction(30), {}, B_FRAMES, 0),
    "29.97 in mkv": ("mkv", "libx264", NTSC, {}, X264, 0),
    "VP9 in webm": ("webm", "libvpx-vp9", Fraction(30), {}, {"deadline": "realtime", "g": "6"}, 0),
    "AV1 as lerobot writes it": ("mp4", "libsvtav1", Fraction(30), {}, {"g": "2", "preset": "12"}, 0),
    "a transport stream, two frames late": ("ts", "libx264", Fraction(30), {}, B_FRAMES, 2 / 30),
    "no edit list, two frames late": ("mp4", "libx264", Fraction(30), {"use_editlist": "0"}, B_FRAMES, 2 / 30),
    "fragments": ("mp4", "libx264", Fraction(30), {"movflags": "frag_keyframe+empty_moov"}, X264, 0),
    "pictures in avi": ("avi", "mjpeg", Fraction(30), {}, {}, 0),
}  # fmt: skip


@pytest.fixture(scope="module")
def filmed(_lerobot_cache: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of 5, 6 and 7 frames, whose video is written again by each test."""
    return write_recording(tmp_path_factory.mktemp("filmed") / "rec", observations(), videos=True)


def refilmed(filmed: Path, folder: Path, coded: str, begin: float = 0.0, more: int = 0) -> Path:
    """The recording with a video of another coding, whose episodes begin `begin` s and `more` frames later."""
    ending, codec, rate, muxer, coder, first = CODED[coded]
    shutil.copytree(filmed, folder)
    (folder / f"{VIDEO}.mp4").unlink()
    film(folder / f"{VIDEO}.{ending}", codec, rate, sum(LENGTHS) + more, muxer, coder)
    fps = int(rate) if rate.denominator == 1 else 29.97
    info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    info["video_path"] = info["video_path"].replace("mp4", ending)
    info["fps"] = info["features"][CAMERA]["info"]["video.fps"] = fps
    (folder / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
    starts = first + begin + (more + np.cumsum([0, *LENGTHS])) / float(rate)
    change(folder / EPISODES, f"videos/{CAMERA}/from_timestamp", lambda _: starts[:-1].tolist())
    change(folder / EPISODES, f"videos/{CAMERA}/to_timestamp", lambda _: starts[1:].tolist())
    seconds = [number / float(rate) for length in LENGTHS for number in range(length)]
    change(folder / DATA, "timestamp", lambda _: seconds)
    return folder


def shades(folder: Path) -> list[float]:
    """The mean of every picture, in the order of the data set."""
    frames = LeRobotFrames(open_lerobot(LeRobotSource(str(folder))))
    frames.check(range(3), [CAMERA])
    return [float(frames.pictures(*at, [CAMERA])[CAMERA].mean()) for at in ORDER]


@pytest.mark.parametrize("coded", slow_but(["B-frames in mp4", "29.97 in mkv"], CODED))
def test_every_frame_shows_its_own_picture_whatever_the_video_counts_time_in(
    filmed: Path, tmp_path: Path, coded: str
) -> None:
    folder = refilmed(filmed, tmp_path / "rec", coded)
    np.testing.assert_allclose(shades(folder), [shade(number) for number in range(18)], atol=4)


@pytest.mark.slow
@pytest.mark.parametrize("coded", ["H.264 in mp4", "milliseconds of mkv", "a base of 1/90000"])
@pytest.mark.parametrize("begin", [-0.3, -0.05, 0.0, 0.05, 0.3])
def test_a_begin_up_to_a_third_of_a_step_beside_a_frame_changes_no_picture(
    filmed: Path, tmp_path: Path, coded: str, begin: float
) -> None:
    """The video begins with two frames of no episode."""
    rate = CODED[coded][2]
    folder = refilmed(filmed, tmp_path / "rec", coded, begin / float(rate), more=2)
    np.testing.assert_allclose(shades(folder), [shade(number) for number in range(2, 20)], atol=4)


@pytest.mark.parametrize("begin", [0.4, 0.5, -0.4])
def test_a_begin_between_two_frames_is_refused_by_its_episode_and_frames(
    filmed: Path, tmp_path: Path, begin: float
) -> None:
    folder = refilmed(filmed, tmp_path / "rec", "H.264 in mp4", more=2)
    for part in ("from", "to"):
        change(
            folder / EPISODES,
            f"videos/{CAMERA}/{part}_timestamp",
            lambda rows: [rows[0], rows[1] + begin / FPS, rows[2]],
        )
    expected = (
        rf"{VIDEO}\.mp4 shows no picture of {CAMERA} for frames 0, 1, 2, 3, 4 and 1 more of episode 1: frame 0 is "
        rf"at \d\.\d+ s, {abs(begin):.2f} of a frame step from the nearest frame .* Without it: --episodes 0,2$"
    )
    with pytest.raises(RecordingError, match=expected):
        shades(folder)


def test_an_episode_that_begins_at_another_episodes_frame_is_refused(filmed: Path, tmp_path: Path) -> None:
    """Each of its frames is near a frame of the video, which is a step late; its range is nearly right."""
    folder = refilmed(filmed, tmp_path / "rec", "H.264 in mp4")
    late = {"from": 0.75, "to": 0.4}
    for part, steps in late.items():
        column = f"videos/{CAMERA}/{part}_timestamp"
        change(folder / EPISODES, column, lambda rows, by=steps / FPS: [rows[0], rows[1] + by, rows[2]])
    with pytest.raises(RecordingError, match="shows its frame 6; expected frame 5, because its 18"):
        shades(folder)


# -- timestamps --------------------------------------------------------------------------------------------------


def summed(step: float) -> list[float]:
    """Timestamps that a recorder adds up in float32, with a step that is too long or too short."""
    return [
        float(number)
        for length in LENGTHS
        for number in np.cumsum(np.full(length, step, np.float32)) - np.float32(step)
    ]


@pytest.mark.parametrize("videos", [False, True])
def test_timestamps_that_drift_by_a_fraction_of_a_frame_are_shown_with_their_largest_drift(
    recording: Path, filmed: Path, tmp_path: Path, videos: bool
) -> None:
    folder = shutil.copytree(recording, tmp_path / "rec") if not videos else None
    folder = folder or refilmed(filmed, tmp_path / "rec", "H.264 in mp4")
    change(folder / DATA, "timestamp", lambda _: summed(1.04 / FPS))
    source = RecordingSource.open(LeRobotSource(str(folder)), False)
    source.check_frames()
    drift = source.facts()["largest time drift"]
    assert drift.startswith("0.24 of a frame step (48 ms) from ")
    assert drift.endswith(", at frame 6 of episode 2")
    if videos:
        np.testing.assert_allclose(shades(folder), [shade(number) for number in range(18)], atol=4)


@pytest.mark.parametrize("step", [1.06, 1.5, 0.9, 0])
def test_timestamps_that_drift_further_are_refused_before_a_run_by_episode_and_line(
    recording: Path, tmp_path: Path, step: float
) -> None:
    folder = Path(shutil.copytree(recording, tmp_path / "rec"))
    change(folder / DATA, "timestamp", lambda rows: [*rows[:11], *summed(step / FPS)[11:]])
    source = RecordingSource.open(LeRobotSource(str(folder)), False)
    with pytest.raises(RecordingError, match=r"episode 2: line \d is frame .* Without it: --episodes 0:2$"):
        source.check_frames()


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1.0])
def test_a_timestamp_that_is_no_time_is_refused(recording: Path, tmp_path: Path, time: float) -> None:
    folder = Path(shutil.copytree(recording, tmp_path / "rec"))
    change(folder / DATA, "timestamp", lambda rows: [time, *rows[1:]])
    with pytest.raises(RecordingError, match="episode 0: line 0 is frame 0 at"):
        LeRobotFrames(open_lerobot(LeRobotSource(str(folder)))).check([0], [])


# -- damaged episodes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [0, 10, 17])
def test_the_first_and_last_picture_of_every_episode_are_decoded(
    recording: Path, tmp_path: Path, line: int
) -> None:
    """Line 0 is the first of episode 0, 10 and 17 are the last ones of episodes 1 and 2."""
    folder = Path(shutil.copytree(recording, tmp_path / "rec"))
    change(
        folder / DATA,
        CAMERA,
        lambda rows: [{**row, "bytes": b""} if n == line else row for n, row in enumerate(rows)],
    )
    frame, episode = {0: (0, 0), 10: (5, 1), 17: (6, 2)}[line]
    frames = LeRobotFrames(open_lerobot(LeRobotSource(str(folder))))
    with pytest.raises(RecordingError, match=f"at frame {frame} of episode {episode}") as refused:
        frames.check(range(3), [CAMERA])
    sound = [number for number in range(3) if number != episode]
    assert str(refused.value).endswith(f"Without it: --episodes {episodes_text(sound)}")
    frames.check(sound, [CAMERA])


@pytest.mark.slow
@pytest.mark.parametrize("coded", ["milliseconds of mkv", "fragments", "a transport stream, two frames late"])
def test_a_video_that_was_cut_off_is_refused_by_the_episodes_that_it_lacks(
    filmed: Path, tmp_path: Path, coded: str
) -> None:
    folder = refilmed(filmed, tmp_path / "rec", coded)
    (file,) = (folder / "videos").rglob("file-000.*")
    content = file.read_bytes()
    times = RecordedVideo(file).times
    assert len(times) == 18
    file.write_bytes(content[: int(len(content) * 0.8)])
    with pytest.raises(RecordingError, match=r"episode [12]\b"):
        shades(folder)


@pytest.mark.slow
def test_pictures_do_not_depend_on_the_order_in_which_they_are_read(filmed: Path, tmp_path: Path) -> None:
    for number, coded in enumerate(("one key frame", "open groups of pictures", "H.265, open groups")):
        folder = refilmed(filmed, tmp_path / str(number), coded)
        frames = LeRobotFrames(open_lerobot(LeRobotSource(str(folder))))
        forward = {at: frames.pictures(*at, [CAMERA])[CAMERA] for at in ORDER}
        for at in np.random.default_rng(0).permutation(ORDER).tolist():
            np.testing.assert_array_equal(frames.pictures(*at, [CAMERA])[CAMERA], forward[tuple(at)])
