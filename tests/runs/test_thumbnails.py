"""Thumbnails illustrate: they are there by default, whole, and change no number of a run."""

import json
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probe_kit.env import Act2AnswerEnv, SceneSpec, ScriptedExpert
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.records import HASH, as_record
from probe_kit.runs.small_frames import FILM_HEIGHT, HEIGHT, shrink
from probe_kit.runs.thumbnails import as_thumbnail, decode_frames, read_sheet, read_thumbnail
from probe_kit.suite import build_suite, load_suite
from tests.support.episode_tables import without_seconds


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    suite = build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)
    return ExtractSettings("expert", suite=suite.folder, scene=SceneSpec(max_steps=40), env_workers=0)


@pytest.fixture(scope="module")
def run(settings: ExtractSettings, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_run(settings, tmp_path_factory.mktemp("runs") / "run")


def halves(run: Run, number: int) -> tuple[np.ndarray, np.ndarray]:
    encoded = read_thumbnail(run.path, number)
    assert encoded is not None
    first, last = np.split(np.asarray(Image.open(BytesIO(encoded)).convert("RGB")).astype(int), 2, axis=1)
    return first, last


def cube(picture: np.ndarray) -> np.ndarray:
    """Where the green cube's pixels are, (rows, columns) on average."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return np.argwhere((green > red + 40) & (green > blue + 40)).mean(axis=0)


def test_every_episode_keeps_its_first_and_last_frame(run: Run) -> None:
    for number in run.episodes["episode"]:
        first, last = halves(run, number)
        assert first.shape == last.shape == (HEIGHT, HEIGHT * 4 // 3, 3)
        assert np.hypot(*(cube(first) - cube(last))) > 10, "the expert carried the cube"


@pytest.mark.slow
def test_thumbnails_change_neither_numbers_nor_settings_and_can_be_left_out(
    settings: ExtractSettings, run: Run, tmp_path: Path
) -> None:
    film = extract_run(settings.changed(frames="all"), tmp_path / "film")
    assert film.settings_sha256 == run.settings_sha256
    assert without_seconds(film.episodes).equals(without_seconds(run.episodes))
    bare = extract_run(settings.changed(frames="none"), tmp_path / "bare")
    assert bare.settings_sha256 == run.settings_sha256
    assert without_seconds(bare.episodes).equals(without_seconds(run.episodes))
    assert bare.stamp != run.stamp, "commits name their pictures"
    assert not (bare.path / "frames").exists()
    assert read_thumbnail(bare.path, 0) is None


def different_frames(count: int) -> tuple[np.ndarray, ...]:
    """Flat pictures of different shades; WebP keeps a flat shade to a few units."""
    return tuple(np.full((240, 320, 3), 10 * number, np.uint8) for number in range(count))


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 16, 21])
def test_a_sheet_gives_back_every_frame_in_order(count: int) -> None:
    frames = different_frames(count)
    decoded = decode_frames(as_thumbnail(frames, "all"), count)
    assert [frame.shape for frame in decoded] == [(240, 320, 3)] * count
    for before, behind in zip(frames, decoded, strict=True):
        np.testing.assert_allclose(behind.astype(int), before, atol=5)


@pytest.fixture(scope="module")
def film_settings(settings: ExtractSettings) -> ExtractSettings:
    return settings.changed(scene=SceneSpec(max_steps=8), frames="all", env_workers=0)


@pytest.fixture(scope="module")
def filmed(film_settings: ExtractSettings, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_run(film_settings, tmp_path_factory.mktemp("filmed") / "run")


@pytest.mark.slow
def test_all_frames_are_those_that_the_environment_draws_in_the_same_episode(
    filmed: Run, film_settings: ExtractSettings
) -> None:
    row = filmed.episodes.iloc[1]
    sheet = read_sheet(filmed.location, int(row["episode"]))
    assert sheet is not None
    assert sheet.count == row["steps"] + 1 == 9
    frames = decode_frames(sheet.content, sheet.count)
    assert film_settings.source.suite is not None
    item = next(
        suite_item
        for suite_item in load_suite(film_settings.source.suite).items
        if suite_item.item_id == row["item_id"]
    )
    env = Act2AnswerEnv(film_settings.scene)
    env.reset(seed=int(row["scene_seed"]), options={"item": item, "layout": row["layout"]})
    expert = ScriptedExpert(env)
    expert.reset()
    for number in range(len(frames)):
        if number:
            env.advance(expert.act())
        assert np.abs(env.render_small(FILM_HEIGHT).astype(int) - frames[number]).mean() < 2
        shrunk = shrink_to_film(env.render())
        assert np.array_equal(env.render_small(FILM_HEIGHT), shrunk), "what was drawn is not drawn again"
        errors = [np.abs(shrunk.astype(int) - other).mean() for other in frames]
        assert errors[number] < min(errors) + 0.1 < 4, "the picture that a policy gets, in small"
    env.close()


@pytest.mark.slow
def test_all_frames_of_a_policy_are_those_that_its_stored_actions_lead_to(
    film_settings: ExtractSettings, tmp_path: Path
) -> None:
    settings = film_settings.changed(model="pi0-tiny", items=2, captured_calls="all", later_views="mean")
    filmed = extract_run(settings, tmp_path / "film")
    bare = extract_run(settings.changed(frames="none"), tmp_path / "bare")
    assert filmed.captured_calls == 2
    assert filmed.reached(1).all()
    for site in filmed.sites("expert"):
        for call in range(2):
            assert np.array_equal(filmed.column(site, "mean", call), bare.column(site, "mean", call))
    assert film_settings.source.suite is not None
    items = {item.item_id: item for item in load_suite(film_settings.source.suite).items}
    env = Act2AnswerEnv(settings.scene)
    for position, row in enumerate(filmed.episodes.to_dict("records")):
        sheet = read_sheet(filmed.location, int(row["episode"]))
        assert sheet is not None
        assert sheet.count == row["steps"] + 1
        options = {"item": items[row["item_id"]], "layout": row["layout"]}
        env.reset(seed=int(row["scene_seed"]), options=options)
        actions = filmed.trajectory(position).commanded
        for step, frame in enumerate(decode_frames(sheet.content, sheet.count)):
            if step:
                env.advance(actions[step - 1])
            assert np.abs(shrink_to_film(env.render()).astype(int) - frame).mean() < 4, step
    env.close()


def shrink_to_film(frame: np.ndarray) -> np.ndarray:
    """A frame as all are kept, each pixel the mean of those it covers."""
    height, width = frame.shape[:2]
    size = (width * FILM_HEIGHT // height, FILM_HEIGHT)
    return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX))


@pytest.mark.slow
def test_reports_take_first_and_last_frame_out_of_a_sheet(filmed: Run) -> None:
    sheet = read_sheet(filmed.location, 0)
    assert sheet is not None
    assert sheet.count is not None
    frames = decode_frames(sheet.content, sheet.count)
    for half, frame in zip(halves(filmed, 0), (frames[0], frames[-1]), strict=True):
        assert (
            np.abs(half - np.asarray(Image.fromarray(frame).resize((160, 120), Image.Resampling.BOX), int)).mean()
            < 4
        )


@pytest.mark.slow
def test_a_commit_with_another_number_of_frames_is_damage(filmed: Run) -> None:
    path = filmed.path / "commits" / "00000001.json"
    stored = path.read_bytes()
    commit = json.loads(stored)
    del commit[HASH]
    path.write_bytes(as_record({**commit, "frames": 0}))
    with pytest.raises(RunDamagedError, match="frames is "):
        open_run(filmed.path)
    path.write_bytes(stored)
    assert verify_run(filmed.path, deep=True).ok


def test_a_film_that_no_webp_can_hold_is_refused() -> None:
    with pytest.raises(UsageError, match="at most 544 frames"):
        ExtractSettings("idle", scene=SceneSpec(max_steps=544), frames="all")


def test_the_pictures_of_several_cameras_stand_side_by_side_at_the_size_of_the_first() -> None:
    first, wrist = (np.full((60, width, 3), value, np.uint8) for width, value in ((80, 10), (40, 200)))
    together = shrink(first, wrist)
    assert together.shape == (120, 320, 3)
    np.testing.assert_array_equal(together[:, :160], shrink(first))
    assert (together[:, 160:] == 200).all()
