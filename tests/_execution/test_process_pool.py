"""Promises of the pool behind `extract --workers`, `train --jobs` and `study run --slots`."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from probe_kit._execution.executor import Idle, Lost, Work
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._system.machine import CORES, cores_here
from probe_kit.errors import UsageError
from tests.support.echo_work import BREAK, DIE, FAIL

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
    assert answers(shared, {0: 2, 1: 2}) == {slot: [(SETUP, str(slot), f"to {slot}"), Idle()] for slot in (0, 1)}


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
    assert answers(shared, {0: 1}) == {0: [Idle()]}
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
    assert "Idle" in driver.stdout.readline()
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
