"""The executor: every task is done once, whatever dies; what is lost too often is given up by name."""

from collections.abc import Callable, Iterator
from typing import Any, Self

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit._execution.executor import GivenUp, Idle, Lost, TaskQueue, WorkerLostWarning, work_off
from probe_kit.errors import UsageError, WorkerDiedError


class Workers:
    """A pool whose workers take what they can hold, do the oldest task, and die where `dies` says so.

    dies: by slot and task, the loss. deaf: that many starts end before the first task.
    """

    def __init__(
        self, size: int, dies: Callable[[int, Any], Lost | None] = lambda *_: None, holding: int = 1, deaf: int = 0
    ) -> None:
        self.slots: set[int] = set()
        self._size, self._dies, self._holding, self._deaf = size, dies, holding, deaf
        self._held: dict[int, list[Any]] = {}
        self._asking: set[int] = set()
        self.opened = False

    def __enter__(self) -> Self:
        self.opened = True
        for slot in range(self._size):
            self.start(slot)
        return self

    def __exit__(self, *_: object) -> None:
        self.opened = False

    def start(self, slot: int) -> None:
        self.slots.add(slot)
        self._held[slot] = []
        self._asking.add(slot)

    def stop(self, slot: int) -> None:
        assert not self._held[slot]
        self.slots.remove(slot)

    def send(self, slot: int, message: object) -> None:
        if message is not None:
            self._held[slot].append(message)
            if len(self._held[slot]) < self._holding:
                self._asking.add(slot)

    def receive(self) -> Iterator[tuple[int, Any]]:
        assert self.slots, "it waits for nobody"
        for slot in sorted(self.slots):
            if self._deaf and slot in self._asking:
                self._deaf -= 1
                self._asking.discard(slot)
                yield slot, Lost(f"worker {slot}", "ended with code 9")
            elif slot in self._asking:
                self._asking.discard(slot)
                yield slot, Idle()
            elif self._held[slot] and (lost := self._dies(slot, self._held[slot][0])):
                yield slot, lost
            elif self._held[slot]:
                yield slot, self._held[slot].pop(0)
                self._asking.add(slot)


def done_by(workers: Workers, queue: TaskQueue[int]) -> tuple[list[int], list[GivenUp[int]]]:
    """The tasks that were done, and those that were given up."""
    done: list[int] = []
    given_up: list[GivenUp[int]] = []
    for slot, event in work_off(workers, queue):
        if isinstance(event, GivenUp):
            given_up.append(event)
        else:
            queue.end(slot, event)
            done.append(event)
    assert not workers.opened
    return done, given_up


def numbers(count: int, tries: int = 2) -> TaskQueue[int]:
    return TaskQueue(((number, number) for number in range(count)), "episode", tries)


@pytest.mark.filterwarnings("ignore::probe_kit._execution.executor.WorkerLostWarning")
@settings(deadline=None)
@given(
    st.integers(1, 4), st.integers(1, 4), st.integers(1, 20), st.sets(st.integers(0, 19)),
    st.lists(st.integers(0, 19), max_size=6),
)  # fmt: skip
def test_every_task_is_done_once_unless_it_kills_two_workers(
    size: int, holding: int, count: int, deadly: set[int], accidents: list[int]
) -> None:
    left = list(accidents)

    def dies(_slot: int, task: int) -> Lost | None:
        accident = task in left and task not in deadly
        if accident:
            left[:] = [other for other in left if other != task]
        return Lost("worker", "died", counts=not accident) if accident or task in deadly else None

    done, given_up = done_by(Workers(size, dies, holding), numbers(count))
    tasks = set(range(count))
    assert sorted(done) == sorted(tasks - deadly)
    assert {event.task for event in given_up} == tasks & deadly


def test_a_suspect_is_tried_last_and_alone() -> None:
    queue = numbers(3)
    assert [queue.take(0), queue.take(0)] == [0, 1]
    assert queue.retry(0, 0)
    assert [queue.take(1), queue.take(0), queue.take(1)] == [2, None, None], "both hold something"
    queue.end(0, 1)
    assert queue.take(0) == 0
    assert queue.take(0) is None, "nothing beside a suspect"
    assert not queue.retry(0, 0)
    assert not queue.finished
    queue.end(1, 2)
    assert queue.finished


def test_failures_before_an_advance_count_no_longer_and_nor_does_the_loss_of_a_node() -> None:
    queue = numbers(1, tries=3)
    for counts in (True, True, False):
        queue.take(0)
        assert queue.retry(0, 0, counts)
    queue.take(0)
    queue.advanced(0)
    for _ in range(2):
        assert queue.retry(0, 0)
        queue.take(0)
    assert not queue.retry(0, 0)


def test_what_is_left_of_a_task_is_what_comes_back() -> None:
    queue = TaskQueue([("a", "ab"), ("b", "c")], "model")
    queue.take(0)
    queue.replace(0, "a", "b")
    queue.replace(1, "a", "of a worker that does not hold it")
    queue.retry(0, "a")
    assert [queue.take(0), queue.take(1)] == ["c", "b"]


def test_tasks_are_read_one_ahead() -> None:
    read: list[int] = []
    queue = TaskQueue(((number, read.append(number) or number) for number in range(9)), "column")
    assert queue.take(0) == 0
    queue.read_ahead()
    queue.read_ahead()
    assert read == [0, 1]


def test_a_task_goes_only_to_a_worker_that_it_fits() -> None:
    queue = TaskQueue([("big", 2), ("small", 1)], "model", fits=lambda slot, task: slot >= task)
    assert [queue.take(1), queue.take(1), queue.take(2)] == [1, None, 2]
    unfit = TaskQueue([("big", 2)], "model", fits=lambda slot, task: slot >= task)
    with pytest.raises(UsageError, match="no worker can take a model that is left"):
        done_by(Workers(2), unfit)


def test_a_lost_worker_is_named_with_what_it_held() -> None:
    losses = iter([Lost("worker 0", "ended with code -9")])

    def dies(_slot: int, task: int) -> Lost | None:
        return next(losses, None) if task == 2 else None

    said = r"worker 0 ended with code -9; 4 episodes it held \(2, 3, 4, …\) will be tried again"
    with pytest.warns(WorkerLostWarning, match=said):
        assert sorted(done_by(Workers(1, dies, holding=4), numbers(6))[0]) == list(range(6))


def test_workers_that_die_before_they_begin_end_the_work_unless_their_nodes_are_lost() -> None:
    with (
        pytest.warns(WorkerLostWarning, match="it held no episode"),
        pytest.raises(WorkerDiedError, match=r"3 workers in a row ended .*worker 0 ended with code 9\. Their"),
    ):
        done_by(Workers(1, deaf=3), numbers(2))
    with pytest.warns(WorkerLostWarning):
        assert done_by(Workers(2, deaf=2), numbers(2))[0] == [0, 1]


def test_an_error_of_a_worker_is_raised_as_it_is() -> None:
    def dies(_slot: int, _task: int) -> Any:
        return UsageError("nothing there")

    with pytest.raises(UsageError, match="nothing there"):
        done_by(Workers(1, dies), numbers(1))


def test_no_worker_is_started_for_no_task() -> None:
    assert list(work_off(Workers(0), numbers(0))) == []
