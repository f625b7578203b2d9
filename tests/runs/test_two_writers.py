"""Two processes on one run at once, at the moments that matter: no object of a finished episode is another's."""

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import zarr

from probe_kit.extract.plan import Plan
from probe_kit.runs import open_run, verify_run
from probe_kit.runs import writer as writers
from probe_kit.runs.commits import commit_key
from probe_kit.runs.results import Pieces
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord
from probe_kit.suite import Suite
from tests.support.little_run import episode, little_plan, little_writer

ARRAYS = 4
"""That are opened one after the other for an episode: pooled rows and tokens of two streams."""


@pytest.fixture
def plan(small_suite: Suite) -> Plan:
    return little_plan(small_suite.select(["color"]), episodes=2)


@pytest.fixture
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "bucket":
        return f"{request.getfixturevalue('bucket')}/run"
    return str(tmp_path / "run")


def rounded_otherwise(record: EpisodeRecord) -> EpisodeRecord:
    """The same episode as a batch of another size, or another processor, computes it."""
    arrays = {kind: dict(by_stream) for kind, by_stream in record.arrays.items()}
    arrays["pooled"] = {name: np.nextafter(rows, np.float32(9)) for name, rows in arrays["pooled"].items()}
    arrays["tokens"] = {name: np.where(rows > 0, rows - 1, rows) for name, rows in arrays["tokens"].items()}
    return replace(record, arrays=arrays, outcome={**record.outcome, "cube_x": record.outcome["cube_x"] / 2})


def interrupt(number: int, act: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """`act` once, before array `number` of the next episode is written, or after all of them before its commit."""
    counted, open_array, write_commit = itertools.count(), zarr.open_array, writers.write_commit

    def open_later(*given: Any, **options: Any) -> Any:
        if next(counted) == number:
            act()
        return open_array(*given, **options)

    def commit_later(*given: Any) -> bool:
        if number == ARRAYS and next(counted) == number:
            act()
        return write_commit(*given)

    monkeypatch.setattr(zarr, "open_array", open_later)
    monkeypatch.setattr(writers, "write_commit", commit_later)


@pytest.mark.parametrize("where", ["folder", pytest.param("bucket", marks=pytest.mark.slow)], indirect=True)
@pytest.mark.parametrize("number", range(ARRAYS + 1))
def test_an_episode_that_two_processes_write_at_once_is_that_of_one_of_them(
    number: int, where: str, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one plays and finishes it while the first is in the middle of its objects."""
    first, second = (little_writer(locate(where), plan) for _ in range(2))
    interrupt(number, lambda: second.write(rounded_otherwise(episode(plan, 0))), monkeypatch)
    first.write(episode(plan, 0))
    assert verify_run(where, deep=True).problems == ()
    found = open_run(where, allow_partial=True)
    stored_outcome = json.loads(locate(where).read(commit_key(0)))["outcome"]
    possible = episode(plan, 0), rounded_otherwise(episode(plan, 0))
    (written,) = [record for record in possible if record.outcome == stored_outcome]
    np.testing.assert_array_equal(found.rows("backbone")[0], written.arrays["pooled"]["backbone"])
    np.testing.assert_array_equal(found.rows("expert", "tokens")[0], written.arrays["tokens"]["expert"])


def test_equal_numbers_of_two_processes_leave_the_first_commit(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = str(tmp_path / "run")
    first, second = (little_writer(locate(where), plan) for _ in range(2))
    interrupt(2, lambda: second.write(episode(plan, 0)), monkeypatch)
    seen = []
    create = writers.write_commit

    def create_and_look(*given: Any) -> bool:
        written = create(*given)
        seen.append((tmp_path / "run" / commit_key(0)).stat().st_ino)
        return written

    monkeypatch.setattr(writers, "write_commit", create_and_look)
    first.write(episode(plan, 0))
    assert len(seen) == 2
    assert (tmp_path / "run" / commit_key(0)).stat().st_ino == seen[0] == seen[1]


def test_work_goes_on_while_another_process_clears_the_same_unfinished_work(tmp_path: Path) -> None:
    """The one that is done first discards the pieces that both of them keep."""
    pieces = Pieces.of(locate(tmp_path), "probes", "0123456789ab", "stamp", "redo")
    over = Event()

    def clear() -> None:
        while not over.wait(0.001):
            pieces.discard()

    clearing = Thread(target=clear)
    clearing.start()
    try:
        for number in range(1500):
            pieces.keep(f"{number % 7}", {"values": np.arange(3)})
    finally:
        over.set()
        clearing.join()
