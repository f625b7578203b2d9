"""The queue of models: order, GPUs, losses."""

from probe_kit.extract import ExtractSettings
from probe_kit.study.ledger import Failure, Played
from probe_kit.study.running.model_task import Made, ModelTask, Moved, RunTask
from probe_kit.study.running.task_queue import TaskQueue

SETTINGS = ExtractSettings("expert")
PLAYED = Played(episodes=4, settings_sha256="a", weights_sha256=None, provenance=[])


def task(model: str, size: float, gpus: int = 0) -> ModelTask:
    runs = tuple(RunTask(f"{model}/{way}", SETTINGS, way, 0) for way in ("plain", "dark"))
    return ModelTask(model, runs, gpus, size)


def test_the_longest_model_goes_first_and_one_with_a_gpu_only_where_there_is_one() -> None:
    queue = TaskQueue([task("short", 1), task("long", 3, gpus=1), task("middle", 2)])
    assert [queue.take(place, has_gpu) for place, has_gpu in ((0, False), (1, True), (2, False), (3, True))] == [
        task("middle", 2), task("long", 3, gpus=1), task("short", 1), None,
    ]  # fmt: skip
    for place in range(3):
        assert not queue.finished
        queue.end(place)
    assert queue.finished


def test_a_lost_model_comes_back_without_the_runs_that_are_made() -> None:
    queue = TaskQueue([task("base", 1)])
    queue.take(0)
    queue.note(0, Made("base", "base/plain", PLAYED))
    assert queue.lose(0, "its process ended") is None
    again = queue.take(1)
    assert again is not None
    assert [one.run for one in again.runs] == ["base/dark"]
    queue.note(1, Failure(stage="episodes", model="base", run="base/dark", reason="two of them"))
    assert queue.lose(1, "its process ended") is None
    assert queue.finished


def test_a_model_is_given_up_after_three_losses_without_an_episode_in_between() -> None:
    queue = TaskQueue([task("base", 1)])
    for place in range(2):
        queue.take(place)
        assert queue.lose(place, "its process ended with code -11") is None
    queue.take(2)
    queue.note(2, Moved("base", "base/plain", 1, 4, "correct"))
    for place in range(2, 4):
        assert queue.lose(place, "its process ended with code -11") is None
        queue.take(place + 1)
    assert queue.lose(4, "a node was lost", counts=False) is None
    queue.take(5)
    failure = queue.lose(5, "its process ended with code -11")
    assert failure is not None
    assert (failure.stage, failure.run, failure.error) == ("playing", "base/plain", "WorkerDiedError")
    assert failure.reason.startswith("its process ended with code -11, 3 times without an episode in between")
    assert queue.finished


def test_late_news_of_a_lost_place_changes_nothing() -> None:
    queue = TaskQueue([task("base", 1)])
    queue.take(0)
    queue.lose(0, "a node was lost", counts=False)
    queue.note(0, Made("base", "base/plain", PLAYED))
    again = queue.take(1)
    assert again is not None
    assert len(again.runs) == 2
    assert queue.lose(7, "unknown") is None
