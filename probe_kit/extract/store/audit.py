"""Verifying a run: everything the commits promise is compared with what is stored."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from probe_kit.errors import RunDamagedError
from probe_kit.extract.store.columns import find_columns
from probe_kit.extract.store.commits import (
    CHECKSUM,
    Commit,
    commit_checksum,
    commit_key,
    committed_sizes,
    crc32c,
    read_failures,
    stamp_of,
    wrong_size,
)
from probe_kit.extract.store.layout import COMMITS, DATA, PLAN_FILE, RUN_FILE
from probe_kit.extract.store.locate import locate
from probe_kit.extract.store.location import Location
from probe_kit.extract.store.provenance import PROVENANCE, name_of, read_provenances
from probe_kit.extract.store.run import Run, read_card
from probe_kit.identity import sha256_json


@dataclass(frozen=True)
class Audit:
    """What was found.

    committed, planned: episodes. problems: one sentence each. sealed: whether columns belong to these commits.
    deep: whether every byte was read, not only sizes.
    """

    path: str
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


def verify_run(path: Path | str | Location, deep: bool = False) -> Audit:
    """Compare a run with its commits: presence and sizes, and with `deep` the checksum of every object.

    Problems are collected, not raised. Raises RunNotFoundError if there is no run at `path`.
    """
    location = locate(path)
    card = read_card(location)
    planned = json.loads(location.read(PLAN_FILE))["episodes"]
    commits: dict[int, Commit] = {}
    problems = list(_settings_problems(card))
    for name, text in location.read_all(COMMITS, ".json").items():
        try:
            commits[int(name.removesuffix(".json"))] = json.loads(text)
        except ValueError as error:
            problems.append(f"{COMMITS}/{name} is no JSON: {error}")
    sizes = committed_sizes(location, commits)
    for number, commit in commits.items():
        problems += _commit_problems(location, number, commit, sizes, deep)
    problems += _provenance_problems(location, commits)
    columns = find_columns(location, stamp_of(commits))
    if deep and columns is not None and not problems:
        problems += _column_problems(Run(location))
    failed = len(read_failures(location))
    return Audit(str(location), len(commits), len(planned), failed, columns is not None, deep, tuple(problems))


def _settings_problems(card: Commit) -> Iterator[str]:
    if sha256_json(card["settings"]) != card["settings_sha256"]:
        yield f"{RUN_FILE}: the settings do not have the hash stored beside them"


def _commit_problems(
    location: Location, number: int, commit: Commit, sizes: Mapping[str, int], deep: bool
) -> Iterator[str]:
    name = commit_key(number)
    if commit_checksum(commit) != commit.get(CHECKSUM):
        yield f"{name} was changed after it was written"
    for key, (length, checksum) in commit["objects"].items():
        problem = wrong_size(sizes, key, length)
        if problem is None and deep and crc32c(location.read(f"{DATA}/{key}")) != checksum:
            problem = f"has other bytes than were written (crc32c is not {checksum})"
        if problem:
            yield f"{DATA}/{key} of episode {commit['episode_id']} {problem}; delete {name} to redo it"


def _provenance_problems(location: Location, commits: Mapping[int, Commit]) -> Iterator[str]:
    stored = read_provenances(location)
    for name in sorted({commit["provenance"] for commit in commits.values() if "provenance" in commit}):
        if name not in stored:
            yield f"{PROVENANCE}/{name}.json is missing; episodes name it as what they were made with"
        elif name_of(stored[name]) != name:
            yield f"{PROVENANCE}/{name}.json was changed after it was written"


def _column_problems(run: Run) -> Iterator[str]:
    for stream in run.streams:
        for view in run.views(stream):
            for site in run.sites(stream):
                for call in range(run.captured_calls):
                    try:
                        run.column(site, view, call)
                    except RunDamagedError as error:
                        yield str(error)
