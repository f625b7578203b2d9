"""One recording in three episodes of small pictures, written by lerobot; no cache of the user is read."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from probe_kit.hooks.contract.observation import Observation
from tests.support.lerobot_recordings import write_recording
from tests.support.made_once import made_once, shared_folder

STATE = np.array([0.29, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
"""A usual one of the embedded policy."""


@pytest.fixture(scope="session")
def _lerobot_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    cache = shared_folder(tmp_path_factory) / "datasets-cache"
    before = os.environ.get("HF_DATASETS_CACHE")
    os.environ["HF_DATASETS_CACHE"] = str(cache)
    import datasets.config

    old = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = cache
    yield
    datasets.config.HF_DATASETS_CACHE = old
    os.environ.pop("HF_DATASETS_CACHE")
    if before is not None:
        os.environ["HF_DATASETS_CACHE"] = before


def observations(episodes: int = 3, frames: int = 5, seed: int = 0) -> list[list[Observation]]:
    """Pictures of noise, states near a usual one; the instruction of odd episodes is another."""
    draw = np.random.default_rng(seed)
    return [
        [
            Observation(
                draw.integers(0, 256, (48, 64, 3), dtype=np.uint8),
                STATE + np.float32(0.01) * draw.normal(size=8).astype(np.float32),
                f"Put the cube on the {('red', 'gray')[number % 2]} shape",
            )
            for _ in range(frames + number)
        ]
        for number in range(episodes)
    ]


@pytest.fixture(scope="session")
def recording(_lerobot_cache: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of 5, 6 and 7 frames, pictures as PNG, a reward beside them."""
    more = {"next.reward": lambda _episode, frame: float(frame >= 3)}

    def make(folder: Path) -> None:
        write_recording(folder / "rec", observations(), more=more)

    return made_once(tmp_path_factory, "recording", make) / "rec"
