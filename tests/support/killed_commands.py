"""Commands of `probe-kit` in processes of their own, killed with SIGKILL at drawn moments and given again.

A moment is a share of the time that the whole command usually takes, or of the changes that it makes to its files,
so that kills also hit the short stretch in which a command writes.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from uuid import uuid4

from probe_kit.runs import verify_run
from probe_kit.runs.layout import CERTIFICATES, COMMITS, RUN_FILE
from probe_kit.runs.layout import TIMES as TIMES_OF_EPISODES
from probe_kit.runs.results import HEAD, PARTIAL
from probe_kit.runs.results import TIMES as TIMES_OF_RESULTS

LONGEST_S = 900
"""Seconds that one command may take."""
ORPHANS_END_S = 30
"""Seconds in which the children of a killed command have to end."""
_TICK_S = 0.02
_MARK = "PROBE_KIT_TEST_MARK"
_TIMES = ("created", "requested", "blake2b")
"""What a result's record of times says of the clock, and the hash over it."""
_UNFINISHED = (".tmp", ".partial", ".unfinished", ".writing")


@dataclass(frozen=True)
class Moment:
    """When a command is killed: after a share of its usual time, or of the changes that it makes."""

    share: float
    of_changes: bool


@dataclass(frozen=True)
class Course:
    """How one command went. code: its exit status, -9 for killed. output: what it printed, both streams."""

    code: int
    seconds: float
    changes: int
    output: str


@dataclass(frozen=True)
class KilledCommand:
    """A command to be killed.

    begin: fills an empty folder with what the command finds. arguments: of `probe-kit`, for this folder. made:
    what the command has made there, by name, without what may differ between two runs. finished: what must never
    be lost again. problems: what is wrong in the folder at any moment.
    """

    name: str
    begin: Callable[[Path], object]
    arguments: Callable[[Path], list[str]]
    results: Callable[[Path], Mapping[str, bytes]]
    finished: Callable[[Path], set[str]] = lambda _: set()
    problems: Callable[[Path], tuple[str, ...]] = lambda _: ()


def run_command(
    arguments: list[str], watched: Path, kill_at: Callable[[float, int], bool] | None = None
) -> Course:
    """Run `probe-kit` with these arguments, and kill it as soon as `kill_at(seconds, changes)` says so.

    changes: of files anywhere below `watched`, since the command began. Only the command itself is killed; its
    children have to notice.
    """
    mark = uuid4().hex
    log = watched.with_name(f"{watched.name}.log")
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "probe_kit", *arguments],
            env={**os.environ, _MARK: mark, "OMP_NUM_THREADS": "1"},
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        began, before, changes = time.monotonic(), _files(watched), 0
        while process.poll() is None:
            now = _files(watched)
            changes, before = changes + len(now ^ before), now
            seconds = time.monotonic() - began
            if seconds > LONGEST_S or (kill_at is not None and kill_at(seconds, changes)):
                process.send_signal(signal.SIGKILL)
                break
            time.sleep(_TICK_S)
        code = process.wait()
    return Course(code, time.monotonic() - began, changes, f"{mark}\n{log.read_text(encoding='utf-8')}")


def run_together(commands: Sequence[Sequence[str]], path: Path, ready: Callable[[], bool]) -> list[str]:
    """Run these at once, each further one as soon as `ready()`; what was printed by those that failed."""
    logs = [path.with_name(f"{path.name}-{number}.log") for number in range(len(commands))]
    running: list[subprocess.Popen[bytes]] = []
    for command, log in zip(commands, logs, strict=True):
        while running and running[0].poll() is None and not ready():
            time.sleep(_TICK_S)
        with log.open("w", encoding="utf-8") as output:
            command_line = [sys.executable, "-m", "probe_kit", *command]
            running.append(subprocess.Popen(command_line, stdout=output, stderr=subprocess.STDOUT))
    codes = [process.wait(LONGEST_S) for process in running]
    return [log.read_text(encoding="utf-8") for log, code in zip(logs, codes, strict=True) if code]


def orphans(course: Course) -> list[str]:
    """Commands of the processes that outlive this one by `ORPHANS_END_S`."""
    mark = f"{_MARK}={course.output.partition(chr(10))[0]}".encode()
    end = time.monotonic() + ORPHANS_END_S
    while (alive := list(_marked(mark))) and time.monotonic() < end:
        time.sleep(0.1)
    return alive


def _marked(mark: bytes) -> Iterator[str]:
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (process / "environ").read_bytes():
                yield (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:  # it has ended meanwhile, or is not ours
            continue


def _files(folder: Path) -> set[tuple[str, int, int]]:
    entries = set()
    for path, _, names in os.walk(folder):
        for name in names:
            try:
                status = Path(path, name).stat()
            except OSError:
                continue
            entries.add((f"{path}/{name}", status.st_ino, status.st_mtime_ns))
    return entries


def kill_often(command: KilledCommand, folder: Path, kills: int, seed: int) -> str:
    """Kill a command until it was killed so often; the table row of what was found.

    Each round begins anew, resumes after every kill with the same command, and must end with what an undisturbed
    command makes.
    """
    draw, killed, rounds = Random(seed), 0, 0
    uninterrupted = begun(command, folder / "whole")
    usual = run_command(command.arguments(uninterrupted), uninterrupted)
    assert usual.code == 0, usual.output
    expected = dict(command.results(uninterrupted))
    assert expected
    while killed < kills:
        rounds += 1
        round_folder = begun(command, folder / str(rounds))
        killed += _kill_until_done(command, round_folder, usual, expected, draw, kills - killed)
    return f"{command.name}: {killed} kills in {rounds} rounds, {len(expected)} objects compared, seed {seed}"


def begun(command: KilledCommand, folder: Path) -> Path:
    """A new folder with what the command finds."""
    folder.mkdir(parents=True)
    command.begin(folder)
    return folder


def _kill_until_done(
    command: KilledCommand, folder: Path, usual: Course, expected: Mapping[str, bytes], draw: Random, most: int
) -> int:
    before, courses = command.finished(folder), []
    for number in range(most + 1):
        moment = Moment(draw.random(), draw.random() < 0.5) if number < most else None
        course = run_command(command.arguments(folder), folder, None if moment is None else _at(moment, usual))
        courses.append(course)
        assert course.code in (0, -signal.SIGKILL), f"after {number} kills: {course.output}"
        assert "InternalError" not in course.output, course.output
        now = command.finished(folder)
        lost = sorted(path for path in before - now if _head_of(path) not in now)
        assert lost == [], f"{command.name} lost {lost[:5]} by a kill at {moment}"
        before = now
        assert command.problems(folder) == (), f"{command.name}, killed at {moment}: {command.problems(folder)}"
        if course.code == 0:
            break
    assert not [process for course in courses for process in orphans(course)]
    results = dict(command.results(folder))
    assert results.keys() == expected.keys()
    different = [name for name in expected if results[name] != expected[name]]
    assert not different, f"{command.name}, killed {len(courses) - 1} times: {different}"
    assert leftovers(folder) == []
    return len(courses) - 1


def _head_of(piece: str) -> str:
    """Where the head of the results lies that a piece of work has become a part of."""
    folder = Path(piece).parent
    return str(folder.with_name(folder.name.removeprefix(".").removesuffix(PARTIAL)) / HEAD)


def _at(moment: Moment, usual: Course) -> Callable[[float, int], bool]:
    if moment.of_changes:
        return lambda _, changes: changes > moment.share * usual.changes
    return lambda seconds, _: seconds > moment.share * usual.seconds


def leftovers(folder: Path) -> list[str]:
    """Files and folders whose names say that they are not finished."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if _unfinished(path.name))


def _unfinished(name: str) -> bool:
    return any(part in name for part in _UNFINISHED)


# -- what commands make -----------------------------------------------------------------------------------


def files_of(folder: Path) -> dict[str, bytes]:
    """Every file by its path."""
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def run_files(run: Path) -> dict[str, bytes]:
    """Every object of a run, without certificates of processes, seconds of episodes and the clock of results."""
    return {
        key: _timeless(content) if key.endswith(f"/{TIMES_OF_RESULTS}") else content
        for key, content in files_of(run).items()
        if not key.startswith((f"{CERTIFICATES}/", f"{TIMES_OF_EPISODES}/"))
    }


def _timeless(record: bytes) -> bytes:
    return json.dumps({name: value for name, value in json.loads(record).items() if name not in _TIMES}).encode()


def committed(*runs: Path) -> set[str]:
    """What has been finished in runs: commits, and results with a head."""
    return {
        str(path)
        for run in runs
        for pattern in (f"{COMMITS}/*.json", f"*/*/{HEAD}", "*/.*/*.npz")
        for path in run.glob(pattern)
    }


def run_problems(*runs: Path) -> tuple[str, ...]:
    """What `run verify --deep` finds in those that were begun.

    `run.json` is the last object of a beginning: a folder that was killed before it has no episode either.
    """
    begun = [run for run in runs if (run / RUN_FILE).exists() or committed(run)]
    return tuple(problem for run in begun for problem in verify_run(run, deep=True).problems)
