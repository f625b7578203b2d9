"""Verification of a run: everything that the root and the commits list is compared with what is stored."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from probe_kit.errors import RunDamagedError
from probe_kit.runs.certificates import read_certificate
from probe_kit.runs.columns import Columns, find_columns
from probe_kit.runs.commits import (
    Commit,
    committed_sizes,
    numbered,
    picture_problems,
    read_commit,
    read_failures,
    redo,
    stamp_of,
    wrong_size,
)
from probe_kit.runs.deep import content_problems, reading_problems
from probe_kit.runs.label import read_label
from probe_kit.runs.layout import COMMITS, DATA, PROVENANCE
from probe_kit.runs.left_out import is_left_out
from probe_kit.runs.orphans import stray_keys
from probe_kit.runs.plans import RESTORE, count_plans
from probe_kit.runs.provenance import read_provenances
from probe_kit.runs.results import bundle_problems
from probe_kit.runs.root import Root, read_root
from probe_kit.runs.seconds import seconds_problems
from probe_kit.runs.store import Location, locate


@dataclass(frozen=True)
class Audit:
    """What was found.

    committed, planned: episodes. problems: one sentence each. sealed: whether columns belong to these commits.
    deep: whether every byte was read, not only sizes. strays: objects that belong to no part of the run and that
    nothing reads, such as copies made by hand. left_out: arrays that the run, a copy, was made without.
    """

    path: str
    committed: int
    planned: int
    failed: int
    sealed: bool
    deep: bool
    problems: tuple[str, ...]
    strays: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing is damaged; an unfinished run can be whole as far as it goes."""
        return not self.problems

    @property
    def finished(self) -> bool:
        """Whether every planned episode is committed; an older state of a run is whole, but not finished."""
        return self.ok and 0 < self.planned == self.committed


def verify_run(path: Path | str | Location, deep: bool = False) -> Audit:
    """Compare a run with what it says of itself.

    Structure, plan, metadata, commits, sizes, and what is derived; with `deep` every byte, columns against rows,
    and every reader of the run and of its stored results. Problems are collected, not raised.
    Raises RunNotFoundError if there is no run at `path`.
    """
    location = locate(path)
    while True:
        before = count_plans(location)
        found = _audit(location, deep)
        if found.ok or count_plans(location) == before:  # else it grew while it was compared
            return found


def _audit(location: Location, deep: bool) -> Audit:
    try:
        root = read_root(location)
        planned, _ = len(root.plan), root.streams
    except RunDamagedError as error:  # nothing can be said of the rest
        return Audit(str(location), 0, 0, 0, False, deep, (str(error),))
    problems = list(_root_problems(root))
    commits: dict[int, Commit] = {}
    for number, key, raw in numbered(location, COMMITS):
        try:
            commits[number] = read_commit(root, number, key, raw)
        except RunDamagedError as error:
            problems.append(str(error))
    problems += [] if problems else _caught(partial(root.check_room, commits))
    problems += _commit_problems(root, commits)
    problems += picture_problems(location, commits)
    problems += seconds_problems(root, commits)
    problems += _caught(partial(read_label, root))
    problems += _caught(lambda: root.left_out)
    problems += _provenance_problems(root, commits)
    if not planned:
        return Audit(str(location), 0, 0, 0, False, deep, tuple(problems))
    if commits:
        problems += _caught(partial(read_certificate, root))
    failures: dict[str, str] = {}
    problems += _caught(lambda: failures.update(read_failures(root)))
    columns = _columns(root, commits, problems)
    if columns is not None:
        problems += columns.problems()
    problems += bundle_problems(location, deep, root.left_out)
    if deep:
        problems += content_problems(root, commits, columns, sound=not problems)
        problems += [] if problems else reading_problems(root)
    return Audit(
        path=str(location),
        committed=len(commits),
        planned=planned,
        failed=len(failures),
        sealed=columns is not None,
        deep=deep,
        problems=tuple(problems),
        strays=() if problems else tuple(stray_keys(root, commits, columns, stamp_of(commits))),
        left_out=tuple(sorted(root.left_out)),
    )


def _caught(look: Callable[[], object]) -> list[str]:
    """What a look at a part of the run complains of."""
    try:
        look()
    except RunDamagedError as error:
        return [str(error)]
    return []


def _root_problems(root: Root) -> Iterator[str]:
    for key in root.sums:
        yield from _caught(partial(root.read, key))


def _commit_problems(root: Root, commits: Mapping[int, Commit]) -> Iterator[str]:
    sizes = committed_sizes(root.location, commits)
    for number, commit in commits.items():
        for key, (length, *_) in commit["objects"].items():
            problem = wrong_size(sizes, key, length)
            if problem and not is_left_out(key, root.left_out):
                yield f"{DATA}/{key} of episode {commit['episode_id']} {problem}. {redo(number)}"


def _provenance_problems(root: Root, commits: Mapping[int, Commit]) -> Iterator[str]:
    try:
        stored = read_provenances(root)
    except RunDamagedError as error:
        yield str(error)
        return
    for name in sorted({commit["provenance"] for commit in commits.values()}):
        if name not in stored:
            yield f"{PROVENANCE}/{name}.json is missing; episodes name it as what they were made with. {RESTORE}"


def _columns(root: Root, commits: Mapping[int, Commit], problems: list[str]) -> Columns | None:
    try:
        return find_columns(root, commits)
    except RunDamagedError as error:
        problems.append(str(error))
        return None
