import re
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

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit._system.imports import install_command
from probe_kit.errors import MissingExtraError, TooFewGroupsError, UsageError, WorkerDiedError
from probe_kit.hooks import Site
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.crossval.nested_folds import nested_folds
from probe_kit.train.data.samples import Samples
from probe_kit.train.execution import ExecutionSettings, Key, Probed, probe_columns
from probe_kit.train.problem import Problem
from probe_kit.train.target_samples import TargetSamples

ITEMS = np.repeat(np.arange(10), 2)
LABELS = np.tile([True, False], 10)
ROWS, NAMES = np.arange(20), ITEMS.astype(str)
PROBLEM = Problem(
    task="binary",
    is_side=True,
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


def columns_of(settings: ExecutionSettings) -> dict[Key, Probed]:
    return dict(probe_columns(columns([]), {"color": PROBLEM}, settings))


def assert_same_numbers(alone: dict[Key, Probed], together: dict[Key, Probed]) -> None:
    assert alone.keys() == together.keys()
    for key, probes in alone.items():
        np.testing.assert_array_equal(probes["color"].decisions, together[key]["color"].decisions)
        np.testing.assert_array_equal(probes["color"].null, together[key]["color"].null)


def test_processes_give_the_same_numbers_as_this_one() -> None:
    assert_same_numbers(columns_of(ExecutionSettings()), columns_of(ExecutionSettings(jobs=2)))


@pytest.mark.slow
def test_what_a_process_raises_keeps_its_class() -> None:
    of_one_class = replace(PROBLEM, labels=np.ones(20, bool))
    with pytest.raises(TooFewGroupsError, match="same label"):
        list(probe_columns(columns([]), {"color": of_one_class}, ExecutionSettings(jobs=2)))


@pytest.fixture
def deadly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Any]:
    """A problem whose first fits kill their process, by their number."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "support")
    kind = import_module("deadly_work").DeadlyProblem
    return lambda kills: kind(PROBLEM, tmp_path, kills)


def test_a_column_whose_process_is_killed_is_fitted_by_another(deadly: Any) -> None:
    held = (
        r"worker \d ended with code -9; the column it held \(backbone\.\d\d\.residual mean\) will be tried again"
    )
    with pytest.warns(WorkerLostWarning, match=held):
        together = dict(probe_columns(columns([]), {"color": deadly(1)}, ExecutionSettings(jobs=2)))
    assert_same_numbers(columns_of(ExecutionSettings()), together)


@pytest.mark.filterwarnings("ignore::probe_kit._execution.executor.WorkerLostWarning")
@pytest.mark.slow
def test_a_column_that_kills_two_processes_is_named_with_a_way_out(deadly: Any) -> None:
    with pytest.raises(WorkerDiedError, match=r"column backbone\.00\.residual mean .*code -9.*fewer --jobs"):
        list(probe_columns(islice(columns([]), 1), {"color": deadly(2)}, ExecutionSettings(jobs=2)))


def test_an_address_without_a_cluster_is_a_wrong_usage() -> None:
    pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")
    with pytest.raises(UsageError, match=r"no Ray cluster answers at '127\.0\.0\.1:9'"):
        columns_of(ExecutionSettings(ray="127.0.0.1:9"))


def test_columns_are_read_only_when_they_are_needed() -> None:
    read: list[Key] = []
    probing = probe_columns(columns(read), {"color": PROBLEM}, ExecutionSettings())
    next(probing)
    assert len(read) == 1


def test_without_ray_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("ray"))):
        columns_of(ExecutionSettings(ray="auto"))


def test_ray_is_imported_for_ray_only() -> None:
    code = (
        "import sys, probe_kit.train.execution; "
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
        assert_same_numbers(columns_of(ExecutionSettings()), columns_of(ExecutionSettings(ray="auto")))
        with pytest.raises(TooFewGroupsError, match="same label"):
            list(probe_columns(columns([]), {"color": of_one_class}, ExecutionSettings(ray="auto", jobs=1)))
        assert ray.is_initialized()  # a cluster that was started elsewhere stays
    finally:
        ray.shutdown()
