"""The control that a random network must not exceed, and that a network which knows must."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import accuracy_score

from probe_kit.hashing import derive_seed
from probe_kit.hooks import Stream
from probe_kit.suite import Suite, build_suite
from probe_kit.train import ArrayRun, ProbeResults, train_probes
from probe_kit.train.controls.features import ControlInputs, random_layer
from probe_kit.train.data.samples import Samples
from probe_kit.train.target_samples import TargetSamples
from tests.train.conftest import problem_of

ITEMS, WIDTH = 100, 24


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suites") / "suite", ("color",), ITEMS)


def inputs_of(run: ArrayRun, suite: Suite) -> ControlInputs:
    rows = np.arange(len(run.episodes))
    names = np.full(rows.size, "all")
    return ControlInputs(run, TargetSamples(rows, 0 * rows, np.zeros(rows.size), names, names, 1, {}), True, suite)


def run_of(suite: Suite, path: Path, knowledge: float = 0.0) -> ArrayRun:
    """A network of three random layers on pictures and words; the last one may know the answer."""
    episodes = pd.DataFrame(
        {
            "episode_id": e.episode_id, "item_id": e.item.item_id, "layout": e.layout, "category": "color",
            "group_id": e.item.group_id, "side_correct": e.side_correct, "side_placed": "none", "outcome": "oob",
            "instruction": e.item.instruction,
        }
        for e in suite.episodes()
    )  # fmt: skip
    sites = list(Stream("backbone", 3, WIDTH).sites())
    run = ArrayRun(path, "random", suite.identity, episodes, {})
    inputs = inputs_of(run, suite)
    rows = np.arange(len(episodes))
    features = {(site, "mean"): inputs.layer(rows, WIDTH, 100 + site.layer) for site in sites}
    sign = np.where(episodes["side_correct"] == "left", 1.0, -1.0)
    features[sites[-1], "mean"][:, 0] += knowledge * sign.astype(np.float32)
    return ArrayRun(path, "random", suite.identity, episodes, features)


def probed(suite: Suite, path: Path, knowledge: float = 0.0) -> ProbeResults:
    run = run_of(suite, path, knowledge)
    return train_probes(run, permutations=39, controls=("random-features",), suite=suite.folder)


@pytest.mark.slow
def test_a_random_network_does_not_exceed_random_features(suite: Suite, tmp_path: Path) -> None:
    scores = probed(suite, tmp_path / "random").scores
    assert not scores["exceeds_random_features"].any()
    assert not scores["signal"].any()
    assert scores["exceeds_untrained"].isna().all()


def test_a_network_that_knows_the_answer_exceeds_random_features(suite: Suite, tmp_path: Path) -> None:
    results = probed(suite, tmp_path / "knowing", knowledge=1.5)
    best = results.scores.loc[results.scores["accuracy"].idxmax()]
    assert best["exceeds_random_features"]
    assert best["signal"]
    control = results.controls.of_category("color")["random-features"]
    assert control.ci[0] < control.score < control.ci[1]
    assert not control.above_chance  # what it has for free is no leak


def test_a_part_that_never_varies_gives_a_random_layer_nothing() -> None:
    """The state at the first frame of every recording is often one."""
    words = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    constant = np.ones((6, 2), np.float32)
    np.testing.assert_array_equal(random_layer([words, constant], 5, 0), random_layer([words], 5, 0))
    assert not random_layer([constant], 5, 0).any()


def test_random_layers_repeat_and_differ_by_seed(suite: Suite, tmp_path: Path) -> None:
    inputs, rows = inputs_of(run_of(suite, tmp_path), suite), np.arange(20)
    np.testing.assert_array_equal(inputs.layer(rows, 8, 0), inputs.layer(rows, 8, 0))
    assert (inputs.layer(rows, 8, 0) != inputs.layer(rows, 8, 1)).all()
    assert inputs.layer(rows, 8, 0).std() > 0.3  # neither dead nor saturated


def test_the_reference_is_the_mean_of_five_layers_by_scikit_learns_accuracy(suite: Suite, tmp_path: Path) -> None:
    """Every layer is probed by itself on the folds of the sites; none of them is chosen."""
    run = run_of(suite, tmp_path / "random")
    results = train_probes(run, permutations=0, controls=("random-features",), suite=suite.folder)
    inputs = inputs_of(run, suite)
    problem = problem_of(run)
    accuracies = []
    for number in range(5):
        layer = inputs.layer(problem.positions, WIDTH, derive_seed("binding", 0, number))
        decisions = problem.fit(Samples.pooled(layer)).decisions
        accuracies.append(accuracy_score(problem.labels, decisions > 0))
    assert len(set(accuracies)) > 1, "else the mean is the best"
    control = results.controls.of_category("color")["random-features"]
    assert control.score == pytest.approx(np.mean(accuracies))
    assert [one.reference for one in results.controls.comparisons] == pytest.approx([np.mean(accuracies)] * 3)
