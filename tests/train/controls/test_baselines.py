from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from probe_kit.errors import UsageError
from probe_kit.suite import Suite, build_suite, load_picture
from probe_kit.train import ArrayRun
from probe_kit.train.controls.baselines import baseline_features


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suites") / "suite", ("color",), 8)


def run_of(suite: Suite, path: Path) -> ArrayRun:
    episodes = pd.DataFrame(
        [
            {"episode_id": e.episode_id, "item_id": e.item.item_id, "layout": e.layout, "instruction": text}
            for e in suite.episodes()
            for text in [e.item.instruction]
        ]
    )
    return ArrayRun(path, "m", suite.identity, episodes, {})


def test_pixels_are_the_left_and_the_right_picture_of_the_layout(suite: Suite, tmp_path: Path) -> None:
    features = baseline_features(run_of(suite, tmp_path), "pixels", suite)
    left, right = features[:, :3072], features[:, 3072:]
    np.testing.assert_array_equal(left[0::2], right[1::2])  # swapping the layout swaps the pictures
    small = load_picture(suite.items[0].picture("left")).resize((32, 32), Image.Resampling.BOX)
    np.testing.assert_allclose(left[0].reshape(32, 32, 3) * 255, np.asarray(small), atol=1e-3)


def test_words_are_counted_alone_and_with_the_sign_of_the_layout(planted_run: Callable[..., ArrayRun]) -> None:
    run = planted_run()
    features = baseline_features(run, "instruction", None)
    alone, signed = np.split(features, 2, axis=1)
    words = sorted({word for text in run.episodes["instruction"] for word in text.split()})
    assert alone[:, words.index("cube")].tolist() == [1] * 80
    assert (alone.sum(axis=1) == 6).all()
    np.testing.assert_array_equal(signed, alone * np.tile([[1], [-1]], (40, 1)))


def test_a_control_that_does_not_exist_lists_those_that_do(planted_run: Callable[..., ArrayRun]) -> None:
    with pytest.raises(UsageError, match="position, instruction, pixels"):
        baseline_features(planted_run(), "sound", None)  # type: ignore[arg-type]
    silent = ArrayRun(Path("R"), "m", "s@1#0", planted_run().episodes.drop(columns="instruction"), {})
    with pytest.raises(UsageError, match="no column 'instruction'"):
        baseline_features(silent, "instruction", None)
