"""Promises of the pool behind `extract --workers` and `train --jobs`."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from probe_kit._execution.process_pool import Ended, ProcessPool
from probe_kit.errors import UsageError
from tests.support.echo_service import DIE, FAIL, LEAVE

SERVICE = "echo_service:serve"
SETUP = b"x" * 1_000_000
"""More than a socket holds before it is read."""


@pytest.fixture(scope="module", autouse=True)
def _importable() -> Iterator[None]:
    """Children find the service by its name alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "support")
        yield


@pytest.fixture(scope="module")
def shared(_importable: None) -> Iterator[ProcessPool]:
    with ProcessPool(SERVICE, SETUP, 2, lambda slot: {"ECHO_SLOT": str(slot)}) as pool:
        yield pool


def answers(pool: ProcessPool, count: int) -> dict[int, Any]:
    """The next message of `count` processes."""
    found: dict[int, Any] = {}
    while len(found) < count:
        found |= dict(pool.receive())
    return found


def is_running(pid: int) -> bool:
    with suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


def test_each_process_gets_the_setup_and_its_own_environment(shared: ProcessPool) -> None:
    for slot in (0, 1):
        shared.send(slot, f"to {slot}")
    assert answers(shared, 2) == {slot: (SETUP, str(slot), f"to {slot}") for slot in (0, 1)}


def test_an_error_of_a_process_is_raised_with_its_class_and_the_process_lives(shared: ProcessPool) -> None:
    shared.send(1, FAIL)
    with pytest.raises(UsageError, match="asked to fail"):
        answers(shared, 1)
    shared.send(1, "next")
    assert answers(shared, 1) == {1: (SETUP, "1", "next")}


@pytest.mark.parametrize(("how", "code"), [(DIE, -signal.SIGKILL), (LEAVE, 0)])
def test_a_process_that_ends_is_named_with_its_code_and_can_be_started_again(
    shared: ProcessPool, how: str, code: int
) -> None:
    before = shared.pid(0)
    shared.send(0, how)
    assert answers(shared, 1) == {0: Ended(code)}
    shared.restart(0)
    shared.send(0, "again")
    assert answers(shared, 1) == {0: (SETUP, "0", "again")}
    assert shared.pid(0) != before


def test_a_message_to_a_dead_process_is_no_error_before_it_is_received(shared: ProcessPool) -> None:
    os.kill(shared.pid(0), signal.SIGKILL)
    time.sleep(0.1)
    shared.send(0, "too late")
    assert answers(shared, 1) == {0: Ended(-signal.SIGKILL)}
    shared.restart(0)


def test_all_processes_end_with_the_pool_and_an_error_in_its_body_is_kept() -> None:
    pids: list[int] = []

    def use() -> None:
        with ProcessPool(SERVICE, None, 2) as pool:
            pids.extend(pool.pid(slot) for slot in (0, 1))
            raise KeyError("body")

    with pytest.raises(KeyError, match="body"):
        use()
    assert not any(map(is_running, pids))


def test_ctrl_c_reaches_the_parent_alone_and_ends_the_processes(tmp_path: Path) -> None:
    """A terminal sends it to the whole group; the pool's processes are in sessions of their own."""
    code = f"""
from probe_kit._execution.process_pool import ProcessPool
with ProcessPool({SERVICE!r}, None, 1) as pool:
    print(pool.pid(0), flush=True)
    pool.send(0, "up")
    print(list(pool.receive()), flush=True)
    list(pool.receive())
"""
    driver = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8",
        start_new_session=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert driver.stdout is not None
    pid = int(driver.stdout.readline())
    assert "up" in driver.stdout.readline()
    assert os.getpgid(pid) != os.getpgid(driver.pid)
    os.killpg(driver.pid, signal.SIGINT)
    _, errors = driver.communicate(timeout=60)
    assert "KeyboardInterrupt" in errors
    assert not is_running(pid)
