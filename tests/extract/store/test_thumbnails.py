"""Thumbnails illustrate: they are there by default, whole, and change no number of a run."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, Run, extract_run
from probe_kit.extract.store.frame_ends import HEIGHT
from probe_kit.extract.store.thumbnails import read_thumbnail
from probe_kit.suite import build_suite
from tests.support.episode_tables import without_seconds


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    suite = build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)
    return ExtractSettings("expert", suite=suite.folder, scene=SceneSpec(max_steps=40))


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
    bare = extract_run(replace(settings, frames="none"), tmp_path / "bare")
    assert bare.settings_sha256 == run.settings_sha256
    assert without_seconds(bare.episodes).equals(without_seconds(run.episodes))
    assert bare.stamp != run.stamp, "commits name their pictures"
    assert not (bare.path / "frames").exists()
    assert read_thumbnail(bare.path, 0) is None


@pytest.mark.slow
def test_environment_processes_give_the_same_thumbnails(
    settings: ExtractSettings, run: Run, tmp_path: Path
) -> None:
    other = extract_run(replace(settings, env_workers=0), tmp_path / "run")
    for number in run.episodes["episode"]:
        assert read_thumbnail(other.path, number) == read_thumbnail(run.path, number)


@pytest.mark.slow
def test_a_torn_thumbnail_of_a_killed_process_is_cleared(settings: ExtractSettings, tmp_path: Path) -> None:
    run = extract_run(settings, tmp_path / "run")
    torn = run.path / "frames" / "abc.tmp"
    torn.write_bytes(b"RIFF")
    extract_run(settings, tmp_path / "run")
    assert not torn.exists()
