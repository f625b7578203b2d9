"""The playing of models in other processes: order, GPUs, losses."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from probe_kit._execution.executor import GivenUp, TaskQueue
from probe_kit.extract import ExtractSettings
from probe_kit.study import playing
from probe_kit.study.cells import Failure
from probe_kit.study.playing import Made, ModelTask, Moved, RunTask

SETTINGS = ExtractSettings("expert")


def task(model: str, size: float, gpus: int = 0) -> ModelTask:
    runs = tuple(RunTask(f"{model}/{way}", SETTINGS, way, 0) for way in ("plain", "dark"))
    return ModelTask(model, runs, gpus, size)


def conducted(monkeypatch: pytest.MonkeyPatch, tasks: list[ModelTask], story: Any, **where: Any) -> list[Any]:
    """The events that are reported while `story` plays the queue in place of workers."""
    reports: list[Any] = []
    monkeypatch.setattr(playing, "work_off", lambda _pool, queue: story(queue))
    playing.play_models(tasks, reports.append, **where)
    return reports


def test_the_longest_model_goes_first_and_one_with_a_gpu_only_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(
        __import__("sys").modules, "torch", SimpleNamespace(cuda=SimpleNamespace(device_count=lambda: 1))
    )

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        assert [queue.take(slot) for slot in (1, 0, 2, 0)] == [
            task("middle", 2), task("long", 3, gpus=1), task("short", 1), None,
        ]  # fmt: skip
        for slot, played in ((1, "middle"), (0, "long"), (2, "short")):
            assert not queue.finished
            yield slot, task(played, 0)
        assert queue.finished

    assert (
        conducted(monkeypatch, [task("short", 1), task("long", 3, gpus=1), task("middle", 2)], story, slots=3)
        == []
    )


def test_a_lost_model_comes_back_without_the_runs_that_are_made_or_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = Made("base", "base/plain")
    failed = Failure(stage="episodes", model="base", run="base/dark", reason="two of them")

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        queue.take(0)
        for slot, event, left in ((0, made, ["base/dark"]), (1, failed, [])):
            yield slot, event
            queue.retry(slot, "base", counts=False)
            again = queue.take(slot + 1)
            assert again is not None
            assert [run.run for run in again.runs] == left

    assert conducted(monkeypatch, [task("base", 1)], story, slots=1) == [made, failed]


def test_a_model_is_given_up_after_three_losses_without_an_episode_in_between(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved = Moved("base", "base/plain", 1, 4, "correct")

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        def lose() -> tuple[ModelTask, bool]:
            held = queue.take(0)
            assert held is not None
            return held, queue.retry(0, "base")

        assert all(lose()[1] for _ in range(2))
        queue.take(0)
        yield 0, moved
        assert queue.retry(0, "base")
        assert lose()[1]
        held, again = lose()
        assert not again
        yield 0, GivenUp(held, "worker 0 ended with code -11")
        assert queue.finished

    reports = conducted(monkeypatch, [task("base", 1)], story, slots=1)
    assert reports[0] == moved
    failure = reports[1]
    assert (failure.stage, failure.run, failure.error) == ("playing", "base/plain", "WorkerDiedError")
    assert failure.reason.startswith("worker 0 ended with code -11, 3 times without an episode in between")
