""""""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit._system.imports import install_command
from probe_kit.errors import (
    MissingExtraError,
    NonFiniteActivationError,
    NoProbesError,
    TooFewGroupsError,
    UnknownCategoryError,
    UnknownSiteError,
    UsageError,
    WorkerDiedError,
)
from probe_kit.hooks import Site
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train import ArrayRun, train_probes
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.probe_sweep import Key, Probed, probe_columns
from probe_kit.train.problem import Problem
from probe_kit.train.samples import Samples
from probe_kit.train.target_samples import TargetSamples

PLANTED = Site("backbone", 3)
PLANTED_EXPERT = Site("expert", 1, "residual", 0)

PlantedRun = Callable[..., ArrayRun]


@pytest.mark.slow
def test_the_curve_peaks_exactly_where_the_answer_was_planted(planted_run: PlantedRun) -> None:
    scores = train_probes(planted_run({PLANTED: 2.0, PLANTED_EXPERT: 2.0}), permutations=60).scores
    for stream, site in (("backbone", PLANTED), ("expert", PLANTED_EXPERT)):
        curve = scores[scores["stream"] == stream].set_index("site")
        assert curve["accuracy"].idxmax() == str(site)
        assert curve.index[curve["p_fwe"] < 0.05].tolist() == [str(site)]


@pytest.mark.slow
def test_nothing_is_significant_with_shuffled_labels(planted_run: PlantedRun) -> None:
    scores = train_probes(planted_run({PLANTED: 2.0}), permutations=60, target="side.shuffled").scores
    assert (scores["p_fwe"] > 0.05).all()
    assert (scores["target"] == "side.shuffled").all()


def test_every_site_has_a_complete_row(planted_run: PlantedRun) -> None:
    run = planted_run({PLANTED: 2.0}, categories=("color", "shape"))
    scores = train_probes(run, permutations=5).scores
    assert len(scores) == 2 * (5 + 4)
    assert (scores[["n", "items", "groups"]] == [80, 40, 20]).all(axis=None)
    assert (scores["chance"] == 0.5).all()
    assert ((scores["ci_low"] <= scores["accuracy"]) & (scores["accuracy"] <= scores["ci_high"])).all()
    best = scores[(scores["category"] == "color") & (scores["layer"] == 3)].iloc[0]
    assert best["depth"] == 0.75
    assert best["auc"] > 0.95
    assert len(best["C"].split()) == len(best["fold_accuracy"].split()) == 5


@pytest.mark.slow
def test_chosen_leaves_out_episodes_placed_nowhere(planted_run: PlantedRun) -> None:
    run = planted_run()
    results = train_probes(run, permutations=10, target="side.chosen")
    curve = results.curves["color", "mean"]
    in_zone = run.episodes[run.episodes["side_placed"] != "none"]
    assert curve.episodes.tolist() == in_zone["episode_id"].tolist()
    assert (curve.labels == (in_zone["side_placed"] == "left")).all()
    assert curve.labels.mean() != 0.5, "more went to one side"
    assert (results.scores["chance"] == 0.5).all()


def test_scores_are_balanced_between_the_sides(planted_run: PlantedRun) -> None:
    """Where one side has more episodes, naming it is worth nothing."""
    results = train_probes(planted_run({PLANTED: 2.0}), permutations=0, target="side.chosen")
    curve = results.curves["color", "mean"]
    is_left = curve.labels
    for row in range(len(curve.sites)):
        shifted = curve.decisions[row].copy()
        for fold in np.unique(curve.fold_of):
            trained = is_left[curve.fold_of != fold]
            shifted[curve.fold_of == fold] -= np.log(trained.sum() / (~trained).sum())
        assert results.scores["accuracy"][row] == pytest.approx(balanced_accuracy_score(is_left, shifted > 0))
    always_left = replace(curve, decisions=np.full_like(curve.decisions, 9.0))
    np.testing.assert_allclose(always_left.sums.accuracies, 0.5)
    assert (always_left.correct.mean(axis=1) == is_left.mean()).all()


def test_an_interrupted_sweep_continues_after_the_last_finished_site(planted_run: PlantedRun) -> None:
    run = planted_run()
    finished: list[str] = []

    def interrupt(fitted_sites: int, _: int, site: str) -> None:
        finished.append(site)
        if fitted_sites == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_probes(run, permutations=2, progress=interrupt)
    assert not list((run.path / "probes").glob("[!.]*"))

    read = watch_columns(run)
    train_probes(run, permutations=2)
    assert len(read) <= 9 - 4
    assert not list((run.path / "probes").glob(".*"))


@pytest.mark.slow
def test_the_same_settings_are_read_back_and_others_are_fitted(planted_run: PlantedRun) -> None:
    run = planted_run()
    first = train_probes(run, permutations=2)
    read = watch_columns(run)
    assert train_probes(run, permutations=2).created == first.created
    assert not read
    assert train_probes(run, permutations=3).key != first.key


def with_tokens(run: ArrayRun, strength: float) -> ArrayRun:
    """Three tokens per episode at every site, one of them padding in every second episode."""
    sign = np.where(run.episodes["side_correct"] == "left", strength, -strength)
    mask = np.ones((80, 3), bool)
    mask[::2, 2] = False
    for number, (site, _) in enumerate(list(run.features)):
        values = np.random.default_rng(number).standard_normal((80, 3, 6))
        values[:, :, 0] += sign[:, None]
        values[~mask] = 1e6
        run.token_features[site, None] = (values, mask)  # type: ignore[index]
    return run


@pytest.mark.slow
def test_token_views_are_probed_beside_pooled_ones_with_fewer_permuted_labels(planted_run: PlantedRun) -> None:
    run = with_tokens(planted_run(), strength=2.0)
    results = train_probes(run, views=("mean", "tokens"), permutations=6, token_permutations=4)
    mean, tokens = results.curves["color", "mean"], results.curves["color", "tokens"]
    assert (mean.null.shape[1], tokens.null.shape[1]) == (6, 4)
    assert (tokens.correct.mean(axis=1) > 0.95).all()
    assert (mean.correct.mean(axis=1) < 0.7).all()
    assert (tokens.fold_of == mean.fold_of).all()


@pytest.mark.slow
def test_the_number_of_token_permuted_labels_matters_only_for_token_views(planted_run: PlantedRun) -> None:
    run = with_tokens(planted_run(), strength=2.0)
    pooled = [train_probes(run, permutations=3, token_permutations=count).key for count in (1, 2)]
    tokens = [train_probes(run, views=("tokens",), permutations=3, token_permutations=n).key for n in (1, 2)]
    assert pooled[0] == pooled[1]
    assert tokens[0] != tokens[1]


@pytest.mark.slow
def test_selectivity_is_the_accuracy_above_random_labels_of_items(planted_run: PlantedRun) -> None:
    results = train_probes(planted_run({PLANTED: 2.0}), permutations=20)
    control = results.curves["color", "mean"].null.mean(axis=1)
    np.testing.assert_allclose(results.scores["control_accuracy"], control)
    np.testing.assert_allclose(results.scores["selectivity"], results.scores["accuracy"] - control)
    assert train_probes(planted_run(), permutations=0).scores["selectivity"].isna().all()


@pytest.mark.slow
def test_a_device_changes_neither_numbers_nor_key(planted_run: PlantedRun, device: str) -> None:
    pytest.importorskip("torch").set_num_threads(1)
    run = planted_run({PLANTED: 2.0}, n_items=24)  # of fewer groups every label permutation would be made
    by_torch = train_probes(run, permutations=2, device=device)
    shutil.rmtree(run.path)
    by_numpy = train_probes(run, permutations=2)
    assert by_torch.key == by_numpy.key
    first, other = (results.curves["color", "mean"].decisions for results in (by_torch, by_numpy))
    np.testing.assert_allclose(first, other, rtol=0, atol=1e-9 * np.abs(other).max())


def test_a_device_is_not_shared_by_processes(planted_run: PlantedRun) -> None:
    pytest.importorskip("torch")
    with pytest.raises(UsageError, match="one process"):
        train_probes(planted_run(), device="cpu", jobs=2)


def test_progress_counts_every_site(planted_run: PlantedRun) -> None:
    reports: list[tuple[int, int]] = []
    train_probes(
        planted_run(), permutations=0, progress=lambda finished, total, _: reports.append((finished, total))
    )
    assert reports == [(finished, 9) for finished in range(1, 10)]


def test_wrong_requests_name_what_there_is(planted_run: PlantedRun) -> None:
    run = planted_run()
    with pytest.raises(UnknownCategoryError, match="it has: color"):
        train_probes(run, ["colour"])
    with pytest.raises(UnknownSiteError, match="it has: mean"):
        train_probes(run, views=["last"])
    with pytest.raises(NoProbesError, match="no activations"):
        train_probes(ArrayRun(run.path, "expert", run.suite, run.episodes, {}))


def test_too_few_items_name_the_category(planted_run: PlantedRun) -> None:
    with pytest.raises(TooFewGroupsError, match=r"category 'color'.*2 independent groups"):
        train_probes(planted_run(n_items=4))


def test_a_broken_activation_names_its_site_and_episode(planted_run: PlantedRun) -> None:
    run = planted_run()
    run.features[PLANTED, "mean"][7, 2] = np.nan
    with pytest.raises(NonFiniteActivationError, match=r"backbone\.03\.residual.*'color-3:s'"):
        train_probes(run, permutations=0)


def watch_columns(run: ArrayRun) -> list[Site]:
    """Sites whose features are read from now on."""
    read: list[Site] = []
    original = run.column

    def column(site: Site, view: str) -> np.ndarray:
        read.append(site)
        return original(site, view)

    object.__setattr__(run, "column", column)
    return read


ITEMS = np.repeat(np.arange(10), 2)
LABELS = np.tile([True, False], 10)
ROWS, NAMES = np.arange(20), ITEMS.astype(str)
PROBLEM = Problem(
    task="binary",
    balanced=True,
    classes=("right", "left"),
    positions=ROWS,
    samples=TargetSamples(ROWS, 0 * ROWS, LABELS.astype(float), NAMES, NAMES, 1, {}),
    labels=LABELS,
    items=NAMES,
    episodes=ROWS.astype(str),
    folds=nested_folds(LABELS, ITEMS, 0),
    permuted_labels=flip_items(LABELS, ITEMS, 3, 0),
    token_permutations=0,
)


def columns(read: list[Key]) -> Iterator[tuple[Key, Samples]]:
    for layer in range(6):
        key = ("mean", Site("backbone", layer))
        read.append(key)
        yield key, Samples.pooled(np.random.default_rng(layer).standard_normal((20, 4)).astype(np.float32))


def columns_of(**crew: Any) -> dict[Key, Probed]:
    return dict(probe_columns(columns([]), {"color": PROBLEM}, **crew))


def assert_same_numbers(alone: dict[Key, Probed], together: dict[Key, Probed]) -> None:
    assert alone.keys() == together.keys()
    for key, probes in alone.items():
        np.testing.assert_array_equal(probes["color"].decisions, together[key]["color"].decisions)
        np.testing.assert_array_equal(probes["color"].null, together[key]["color"].null)


@pytest.mark.slow
def test_processes_give_the_same_numbers_as_this_one() -> None:
    assert_same_numbers(columns_of(), columns_of(jobs=2))


@pytest.mark.slow
def test_what_a_process_raises_keeps_its_class() -> None:
    of_one_class = replace(PROBLEM, labels=np.ones(20, bool))
    with pytest.raises(TooFewGroupsError, match="same label"):
        list(probe_columns(columns([]), {"color": of_one_class}, jobs=2))


@pytest.fixture
def deadly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Any]:
    """A problem whose first fits kill their process, by their number."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "support")
    kind = import_module("deadly_work").DeadlyProblem
    return lambda kills: kind(PROBLEM, tmp_path, kills)


@pytest.mark.slow
def test_a_column_whose_process_is_killed_is_fitted_by_another(deadly: Any) -> None:
    warning = (
        r"worker \d ended with code -9; the column it held \(backbone\.\d\d\.residual mean\) will be tried again"
    )
    with pytest.warns(WorkerLostWarning, match=warning):
        together = dict(probe_columns(columns([]), {"color": deadly(1)}, jobs=2))
    assert_same_numbers(columns_of(), together)


@pytest.mark.filterwarnings("ignore::probe_kit._execution.executor.WorkerLostWarning")
@pytest.mark.slow
def test_a_column_that_kills_two_processes_is_named_with_a_way_out(deadly: Any) -> None:
    with pytest.raises(WorkerDiedError, match=r"column backbone\.00\.residual mean .*code -9.*fewer --jobs"):
        list(probe_columns(islice(columns([]), 1), {"color": deadly(2)}, jobs=2))


def test_an_address_without_a_cluster_is_a_wrong_usage() -> None:
    pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")
    with pytest.raises(UsageError, match=r"no Ray cluster answers at '127\.0\.0\.1:9'"):
        columns_of(ray="127.0.0.1:9")


def test_columns_are_read_only_when_they_are_needed() -> None:
    read: list[Key] = []
    probing = probe_columns(columns(read), {"color": PROBLEM})
    next(probing)
    assert len(read) == 1


def test_without_ray_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("ray"))):
        columns_of(ray="auto")


def test_ray_is_imported_for_ray_only() -> None:
    code = (
        "import sys, probe_kit.train.probe_sweep; "
        "print([m for m in ('ray', 'torch', 'pybullet') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8").stdout == "[]\n"


@pytest.mark.slow
def test_ray_gives_the_same_numbers_and_raises_what_a_task_raises() -> None:
    """Slow: a cluster takes its time to start, and on starved machines it may not start at all."""
    ray = pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")
    try:
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    except (RuntimeError, ConnectionError, TimeoutError, ray.exceptions.RayError) as error:
        pytest.skip(f"Ray does not start here: {error}")
    of_one_class = replace(PROBLEM, labels=np.ones(20, bool))
    try:
        assert_same_numbers(columns_of(), columns_of(ray="auto"))
        with pytest.raises(TooFewGroupsError, match="same label"):
            list(probe_columns(columns([]), {"color": of_one_class}, ray="auto", jobs=1))
        assert ray.is_initialized()  # a cluster that was started elsewhere stays
    finally:
        ray.shutdown()
