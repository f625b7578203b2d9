"""A process that has imported everything and forks others, which it kills: hundreds of kills take minutes.

Usage: python -m tests.runs.nursery, in the root of the repository. A line of JSON on standard input is a job: what
to do with which run, by how many processes, and after how many seconds each of them is killed (null: not at all).
The answer says how each ended: true if it was done, false if it was killed. Nothing here may use Zarr or obstore
before it forks, because both have threads.
"""

import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from probe_kit.runs import open_run, seal
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import load_suite
from probe_kit.train import train_probes
from tests.support.little_run import certify, episode, little_plan, little_settings


def extract(run: str, suite: str) -> None:
    """What an extraction does with its episodes."""
    plan = little_plan(load_suite(Path(suite)))
    writer = RunWriter(locate(run), plan, little_settings())
    with writer.claim():
        certify(writer)
        for number in writer.remaining():
            writer.write(episode(plan, number))
        seal(run)


def train(run: str, _suite: str) -> None:
    """Probes, then a control that is added to them."""
    opened = open_run(run)
    train_probes(opened, permutations=1)
    train_probes(opened, permutations=1, controls=("position",))


TASKS: dict[str, Callable[[str, str], object]] = {
    "extract": extract, "seal": lambda run, _suite: seal(run), "train": train
}  # fmt: skip


def start(task: str, run: str, suite: str) -> int:
    pid = os.fork()
    if pid:
        return pid
    try:
        TASKS[task](run, suite)
    except BaseException:  # noqa: BLE001 - a forked process must never return into the loop
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def ended(pid: int, deadline: float | None) -> bool:
    """Whether a process ended by itself, and well; it is killed at the deadline."""
    while True:
        finished_pid, status = os.waitpid(pid, os.WNOHANG)
        if finished_pid:
            break
        if deadline is not None and time.monotonic() > deadline:
            os.kill(pid, signal.SIGKILL)
            _, status = os.waitpid(pid, 0)
            break
        time.sleep(0.001)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, -signal.SIGKILL):
        raise SystemExit(f"a process ended with {code}")
    return code == 0


def main() -> None:
    for line in sys.stdin:
        job = json.loads(line)
        began = time.monotonic()
        pids = [start(job["task"], job["run"], job["suite"]) for _ in job["patience"]]
        deadlines = [None if seconds is None else began + seconds for seconds in job["patience"]]
        ends = [ended(pid, deadline) for pid, deadline in zip(pids, deadlines, strict=True)]
        print(json.dumps({"ended": ends, "seconds": time.monotonic() - began}), flush=True)


if __name__ == "__main__":
    main()
