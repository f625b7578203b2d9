from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from probe_kit.errors import UsageError
from probe_kit.suite import Suite, build_suite, load_picture
from probe_kit.train import ArrayRun, train_probes
from probe_kit.train.controls.features import ControlInputs
from probe_kit.train.target_samples import TargetSamples


def features_of(run: ArrayRun, name: str, suite: Suite | None) -> np.ndarray:
    """Features of a control of a side, for every episode."""
    rows = np.arange(len(run.episodes))
    names = np.full(rows.size, "all")
    samples = TargetSamples(rows, np.zeros_like(rows), np.zeros(rows.size), names, names, 1, {})
    return ControlInputs(run, samples, True, suite).features(name)


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
    features = features_of(run_of(suite, tmp_path), "pixels", suite)
    left, right = features[:, :3072], features[:, 3072:]
    np.testing.assert_array_equal(left[0::2], right[1::2])  # swapping the layout swaps the pictures
    small = load_picture(suite.items[0].picture("left")).resize((32, 32), Image.Resampling.BOX)
    np.testing.assert_allclose(left[0].reshape(32, 32, 3) * 255, np.asarray(small), atol=1e-3)


def test_words_are_counted_alone_and_with_the_sign_of_the_layout(planted_run: Callable[..., ArrayRun]) -> None:
    run = planted_run()
    features = features_of(run, "instruction", None)
    alone, signed = np.split(features, 2, axis=1)
    words = sorted({word for text in run.episodes["instruction"] for word in text.split()})
    assert alone[:, words.index("cube")].tolist() == [1] * 80
    assert (alone.sum(axis=1) == 6).all()
    np.testing.assert_array_equal(signed, alone * np.tile([[1], [-1]], (40, 1)))


def test_a_control_that_does_not_exist_or_is_not_possible_is_refused(
    planted_run: Callable[..., ArrayRun],
) -> None:
    run = planted_run()
    with pytest.raises(UsageError, match="unknown control 'sound'; expected some of position, step, state"):
        train_probes(run, controls=("sound",))
    for name, reason in (("step", "one inference"), ("state", "no trajectories"), ("action", "no actions")):
        with pytest.raises(UsageError, match=f"control '{name}' is not possible: .*{reason}"):
            train_probes(run, controls=(name,))
    silent = ArrayRun(run.path, "m", "s@1#0", run.episodes.drop(columns="instruction"), run.features)
    with pytest.raises(UsageError, match="no column 'instruction'"):
        train_probes(silent, controls=("instruction",))
