"""Kills at random moments of everything that writes into a run: nothing is lost, and the bytes are the same.

Writing is killed at single points in `test_crashes`.
"""

import json
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from probe_kit.runs import verify_run
from probe_kit.runs.store import locate
from probe_kit.suite import Suite, build_suite
from tests.runs import contents

ROOT = Path(__file__).parents[2]
KILLS = 50
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:.*is not sealed")]


class Nursery:
    """The process that forks and kills."""

    def __init__(self, suite: Suite) -> None:
        self._suite = str(suite.folder)
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore::DeprecationWarning", "-m", "tests.runs.nursery"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
        )

    def __call__(self, task: str, run: Path | str, *patience: float | None) -> dict[str, Any]:
        assert self._process.stdin
        assert self._process.stdout
        job = {"task": task, "run": str(run), "suite": self._suite, "patience": patience or (None,)}
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def close(self) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        assert self._process.wait() == 0


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "twelve", ["color"], 12)


@pytest.fixture
def nursery(suite: Suite) -> Iterator[Nursery]:
    started = Nursery(suite)
    yield started
    started.close()


def objects(run: Path | str) -> dict[str, bytes]:
    """Every object by key; of probes, all but the record that tells the time."""
    return {
        key: content
        for key, content in contents.objects(run).items()
        if not (key.startswith("probes/") and key.endswith("/times.json"))
    }


def committed(run: Path | str) -> set[str]:
    location = locate(run)
    return set(location.read_all("commits", ".json")) if location.exists("run.json") else set()


def kill_often(
    nursery: Nursery, task: str, begin: Any, expected: dict[str, bytes], workers: int, seed: int
) -> None:
    """Rounds of kills until there were enough; each round ends undisturbed and must give the expected bytes."""
    draw, kills, rounds = random.Random(seed), 0, 0
    usual = nursery(task, begin(rounds))["seconds"]
    while kills < KILLS:
        rounds += 1
        run, before = begin(rounds), set[str]()
        finished = False
        while not finished:
            often = [draw.uniform(0, 1.1) * usual if kills < KILLS else None for _ in range(workers)]
            ends = nursery(task, run, *often)["ended"]
            kills += ends.count(False)
            now = committed(run)
            assert before <= now, "a commit was lost"
            before = now
            if now:
                verification = verify_run(run, deep=True)
                assert verification.ok, verification.problems
            finished = True in ends
        if workers > 1:
            nursery(task, run)  # one may have been killed when the other was done; the next one clears
        assert objects(run) == expected
    print(f"{task}, {workers} at once, seed {seed}: {kills} kills in {rounds} rounds, usually {usual:.2f} s")


@pytest.mark.parametrize("workers", [1, 2])
def test_kills_of_writers(nursery: Nursery, tmp_path: Path, workers: int) -> None:
    nursery("extract", tmp_path / "whole")
    expected = objects(tmp_path / "whole")
    kill_often(nursery, "extract", lambda number: tmp_path / str(number), expected, workers, seed=1)


@pytest.mark.parametrize("task", ["seal", "train"])
def test_kills_of_what_is_derived(nursery: Nursery, tmp_path: Path, task: str) -> None:
    nursery("extract", tmp_path / "begun")
    if task == "seal":
        for folder in ("columns.zarr", "sealed"):
            shutil.rmtree(tmp_path / "begun" / folder)

    def begin(number: int) -> Path:
        return Path(shutil.copytree(tmp_path / "begun", tmp_path / str(number)))

    uninterrupted = begin(-1)
    nursery(task, uninterrupted)
    kill_often(nursery, task, begin, objects(uninterrupted), workers=1, seed=2)


def test_kills_in_an_object_store(suite: Suite, tmp_path: Path, bucket: str) -> None:
    nursery = Nursery(suite)
    nursery("extract", tmp_path / "whole")
    kill_often(
        nursery, "extract", lambda number: f"{bucket}/{number}", objects(tmp_path / "whole"), workers=1, seed=3
    )
    nursery.close()
