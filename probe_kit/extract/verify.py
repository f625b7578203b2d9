"""Verifying a run: everything the commits promise is compared with what lies on the disk."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from probe_kit.errors import RunDamagedError, RunNotFoundError
from probe_kit.extract.columns import find_columns
from probe_kit.extract.commits import (
    CHECKSUM,
    Commit,
    commit_checksum,
    crc32c,
    read_failures,
    stamp_of,
    wrong_size,
)
from probe_kit.extract.layout import COMMITS, DATA, PLAN_FILE, RUN_FILE
from probe_kit.extract.run import Run
from probe_kit.identity import sha256_json


@dataclass(frozen=True)
class Verification:
    """What was found.

    committed, planned: episodes. problems: one sentence each. sealed: whether columns belong to these commits.
    deep: whether every byte was read, not only sizes.
    """

    path: Path
    committed: int
    planned: int
    failed: int
    sealed: bool
    deep: bool
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is damaged; an unfinished run can be whole as far as it goes."""
        return not self.problems


def verify_run(path: Path | str, deep: bool = False) -> Verification:
    """Compare a run with its commits: presence and sizes, and with `deep` the checksum of every object.

    Problems are collected, not raised. Raises RunNotFoundError if there is no run at `path`.
    """
    path = Path(path)
    if not (path / RUN_FILE).is_file():
        raise RunNotFoundError(f"{path} is not a run: it has no {RUN_FILE}")
    card = json.loads((path / RUN_FILE).read_text())
    planned = json.loads((path / PLAN_FILE).read_text())["episodes"]
    commits: dict[int, Commit] = {}
    problems = list(_settings_problems(card))
    for file in sorted((path / COMMITS).glob("*.json")):
        try:
            commits[int(file.stem)] = commit = json.loads(file.read_text())
        except ValueError as error:
            problems.append(f"{COMMITS}/{file.name} is no JSON: {error}")
        else:
            problems += _commit_problems(path, file.name, commit, deep)
    columns = find_columns(path, stamp_of(commits))
    if deep and columns is not None and not problems:
        problems += _column_problems(Run(path))
    return Verification(
        path, len(commits), len(planned), len(read_failures(path)), columns is not None, deep, tuple(problems)
    )


def _settings_problems(card: Commit) -> Iterator[str]:
    if sha256_json(card["settings"]) != card["settings_sha256"]:
        yield f"{RUN_FILE}: the settings do not have the hash stored beside them"


def _commit_problems(run: Path, name: str, commit: Commit, deep: bool) -> Iterator[str]:
    if commit_checksum(commit) != commit.get(CHECKSUM):
        yield f"{COMMITS}/{name} was changed after it was written"
    for key, (length, checksum) in commit["objects"].items():
        problem = wrong_size(run, key, length)
        if problem is None and deep and crc32c((run / DATA / key).read_bytes()) != checksum:
            problem = f"has other bytes than were written (crc32c is not {checksum})"
        if problem:
            yield f"{DATA}/{key} of episode {commit['episode_id']} {problem}; delete {COMMITS}/{name} to redo it"


def _column_problems(run: Run) -> Iterator[str]:
    for stream in run.streams:
        for view in run.views(stream):
            for site in run.sites(stream):
                try:
                    run.column(site, view)
                except RunDamagedError as error:
                    yield str(error)
