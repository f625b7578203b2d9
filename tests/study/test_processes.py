"""Playing in processes: the numbers of this process, also if processes are killed."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import psutil
import pytest

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit.errors import WorkerDiedError
from probe_kit.study import EpisodeStored, conduct_study, load_study, plan_study, playing
from probe_kit.suite import Suite
from tests.study.small_study import EPISODES, check_same_bytes, small_study

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def played_here(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = small_study(tmp_path_factory.mktemp("here"), small_suite)
    assert conduct_study(plan_study(load_study(file))) == []
    return file


def test_processes_give_the_bytes_of_this_process(played_here: Path, small_suite: Suite, tmp_path: Path) -> None:
    file, moved = small_study(tmp_path, small_suite), list[EpisodeStored]()
    failures = conduct_study(
        plan_study(load_study(file)),
        lambda event: moved.append(event) if isinstance(event, EpisodeStored) else None,
        slots=2,
    )
    assert failures == []
    assert len(moved) == EPISODES
    check_same_bytes(file, played_here)


def test_a_killed_process_is_replaced_and_nothing_changes(
    played_here: Path, small_suite: Suite, tmp_path: Path
) -> None:
    file = small_study(tmp_path, small_suite)
    killed: list[int] = []

    def kill_one(event: object) -> None:
        if isinstance(event, EpisodeStored) and event.stored in (5, 15) and len(killed) < 4:
            victims = [process.pid for process in _players() if process.pid not in killed]
            killed.append(victims[0])
            psutil.Process(victims[0]).kill()

    with pytest.warns(
        WorkerLostWarning, match=r"ended with code -9; the model it held \(.*\) will be tried again"
    ):
        assert conduct_study(plan_study(load_study(file)), kill_one, slots=2) == []
    assert killed
    check_same_bytes(file, played_here)


@pytest.fixture
def deadly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "support"))


@pytest.mark.usefixtures("deadly")
def test_a_model_whose_process_always_dies_fails_and_the_others_are_played(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its processes are ended from outside as soon as they have its model; the other one finds what it needs."""
    file = small_study(tmp_path, small_suite)
    monkeypatch.setattr(playing, "play_here", import_module("deadly_work").play_but_the_first)
    with pytest.warns(WorkerLostWarning):
        (failure,) = conduct_study(plan_study(load_study(file)), slots=2)
    assert (failure.model, failure.stage, failure.error) == ("first", "playing", "WorkerDiedError")
    assert "ended with code 7, 3 times without an episode in between" in failure.reason
    states = {planned.cell.name: planned.state for planned in plan_study(load_study(file)).cells}
    assert states == {
        "first/still": "failed",
        "first/dark": "waiting",
        "second/still": "whole",
        "reader/p1": "whole",
    }


@pytest.mark.usefixtures("deadly")
def test_processes_that_die_before_they_begin_end_the_study(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playing, "play_here", import_module("deadly_work").stillborn)
    with (
        pytest.warns(WorkerLostWarning),
        pytest.raises(WorkerDiedError, match=r"3 workers in a row ended before their first task.*code 7"),
    ):
        conduct_study(plan_study(load_study(small_study(tmp_path, small_suite))), slots=1)


def _players() -> Iterator[psutil.Process]:
    for child in psutil.Process().children(recursive=True):
        if "probe_kit._execution.executor:serve" in " ".join(child.cmdline()):
            yield child
