"""The executor: every task is done once, whatever dies; what is lost too often is given up by name."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe_kit._execution.executor import GivenUp, IdleMessage, Lost, TaskQueue, Work, WorkerLostWarning, work_off
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._system.machine import CORES, cores_here
from probe_kit.errors import UsageError, WorkerDiedError
from tests.support.echo_work import BREAK, DIE, FAIL


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
                yield slot, IdleMessage()
            elif self._held[slot] and (lost := self._dies(slot, self._held[slot][0])):
                yield slot, lost
            elif self._held[slot]:
                yield slot, self._held[slot].pop(0)
                self._asking.add(slot)


def done_by(workers: Workers, queue: TaskQueue[int]) -> tuple[list[int], list[GivenUp[int]]]:
    """The tasks that were done, and those that were given up."""
    completed: list[int] = []
    given_up: list[GivenUp[int]] = []
    for slot, event in work_off(workers, queue):
        if isinstance(event, GivenUp):
            given_up.append(event)
        else:
            queue.end(slot, event)
            completed.append(event)
    assert not workers.opened
    return completed, given_up


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
    pending_accidents = list(accidents)

    def dies(_slot: int, task: int) -> Lost | None:
        accident = task in pending_accidents and task not in deadly
        if accident:
            pending_accidents[:] = [other for other in pending_accidents if other != task]
        return Lost("worker", "died", counts=not accident) if accident or task in deadly else None

    completed, given_up = done_by(Workers(size, dies, holding), numbers(count))
    tasks = set(range(count))
    assert sorted(completed) == sorted(tasks - deadly)
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


def test_a_retried_task_returns_only_what_is_left_of_it() -> None:
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

    warning = r"worker 0 ended with code -9; 4 episodes it held \(2, 3, 4, …\) will be tried again"
    with pytest.warns(WorkerLostWarning, match=warning):
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


SETUP = b"x" * 1_000_000
"""More than a socket holds before it is read."""


@pytest.fixture(scope="module")
def echo() -> Iterator[Work]:
    """The function under a name by which children find it too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "support")
        yield import_module("echo_work").echo


@pytest.fixture(scope="module")
def shared(echo: Work) -> Iterator[ProcessPool]:
    exits = {-signal.SIGTERM: "was terminated"}
    with ProcessPool(echo, SETUP, 2, lambda slot: {"ECHO_SLOT": str(slot)}, exits) as pool:
        answers(pool, {0: 1, 1: 1})
        yield pool


def answers(pool: ProcessPool, counts: dict[int, int]) -> dict[int, list[Any]]:
    """The next messages of each worker, as many as given."""
    messages: dict[int, list[Any]] = {slot: [] for slot in counts}
    while any(len(messages[slot]) < count for slot, count in counts.items()):
        for slot, message in pool.receive():
            messages[slot].append(message)
    return messages


def is_running(pid: int) -> bool:
    with suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


def test_each_worker_gets_the_setup_its_own_environment_and_task_after_task(shared: ProcessPool) -> None:
    for slot in (0, 1):
        shared.send(slot, f"to {slot}")
    assert answers(shared, {0: 2, 1: 2}) == {
        slot: [(SETUP, str(slot), f"to {slot}"), IdleMessage()] for slot in (0, 1)
    }


@pytest.mark.parametrize(
    ("task", "lost"),
    [(DIE, Lost("worker 0", "ended with code -9")), (BREAK, Lost("worker 0", "ended with code 1"))],
)
def test_a_worker_that_ends_is_named_with_its_code_and_can_be_started_again(
    shared: ProcessPool, task: str, lost: Lost
) -> None:
    before = shared.pid(0)
    shared.send(0, task)
    assert answers(shared, {0: 1}) == {0: [lost]}
    shared.start(0)
    assert answers(shared, {0: 1}) == {0: [IdleMessage()]}
    assert shared.pid(0) != before


def test_an_error_of_ours_is_a_message(shared: ProcessPool) -> None:
    shared.send(1, FAIL)
    (error, lost) = answers(shared, {1: 2})[1]
    assert isinstance(error, UsageError)
    assert str(error) == "asked to fail"
    assert lost == Lost("worker 1", "ended with code 0")
    shared.start(1)
    answers(shared, {1: 1})


def test_a_message_to_a_dead_worker_is_no_error_before_it_is_received(shared: ProcessPool) -> None:
    os.kill(shared.pid(0), signal.SIGTERM)
    time.sleep(0.1)
    shared.send(0, "too late")
    assert answers(shared, {0: 1}) == {0: [Lost("worker 0", "was terminated")]}
    shared.start(0)
    answers(shared, {0: 1})


def test_all_workers_end_with_the_pool_and_an_error_in_its_body_is_kept(echo: Work) -> None:
    pids: list[int] = []

    def use() -> None:
        with ProcessPool(echo, None, 2) as pool:
            pids.extend(pool.pid(slot) for slot in (0, 1))
            pool.stop(0)
            assert pool.slots == {1}
            raise KeyError("body")

    with pytest.raises(KeyError, match="body"):
        use()
    assert not any(map(is_running, pids))


@pytest.mark.usefixtures("echo")
def test_ctrl_c_reaches_the_parent_alone_and_ends_the_workers(tmp_path: Path) -> None:
    """A terminal sends it to the whole group; the pool's processes are in sessions of their own."""
    code = """
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._system.machine import CORES, cores_here
from echo_work import echo
with ProcessPool(echo, None, 1) as pool:
    print(pool.pid(0), flush=True)
    print(list(pool.receive()), flush=True)
    list(pool.receive())
"""
    driver = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8",
        start_new_session=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert driver.stdout is not None
    pid = int(driver.stdout.readline())
    assert "IdleMessage" in driver.stdout.readline()
    assert os.getpgid(pid) != os.getpgid(driver.pid)
    os.killpg(driver.pid, signal.SIGINT)
    _, errors = driver.communicate(timeout=60)
    assert "KeyboardInterrupt" in errors
    assert not is_running(pid)


def test_a_pool_inside_a_worker_divides_the_share_of_that_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.delenv(CORES, raising=False)
    outer = share_of_machine(0, 2, "cpu")
    assert outer == {"OMP_NUM_THREADS": "8", CORES: "8"}
    monkeypatch.setenv(CORES, outer[CORES])
    assert cores_here() == 8
    assert [share_of_machine(slot, 4, "cpu")["OMP_NUM_THREADS"] for slot in range(4)] == ["2"] * 4
    assert share_of_machine(0, 99, "cpu")[CORES] == "1"


@pytest.mark.parametrize(("visible", "gpus"), [("2,5", ["2", "5", "2"]), ("GPU-ab", ["GPU-ab"] * 3)])
def test_workers_share_the_gpus_that_this_process_was_given(
    visible: str, gpus: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert [share_of_machine(slot, 3, "cuda")["CUDA_VISIBLE_DEVICES"] for slot in range(3)] == gpus
