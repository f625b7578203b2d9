"""Every file of a run: any accident to it is an error that names it with a remedy, or changes no number.

A run that holds whatever a run can hold, probes and interventions included, beside another one of another seed.
"""

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from probe_kit.errors import ProbeKitError
from tests.support.faults import KINDS, Change, Stored, applied, draw_fault
from tests.support.nightly_draws import seeds_of_tonight
from tests.support.reading import readings

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

ACCIDENTS = ("a bit", "cut", "missing", "exchanged", "of another run")
DRAWN = 1000
REMEDY = re.compile(r"Restore|Delete|Remove|Extract|Make|Write|Choose|Give|Take|run the same|with the same|again")


@pytest.fixture(scope="module")
def stored(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Of copies: an accident that was undone may leave an empty folder, and others read these runs too."""
    runs = shutil.copytree(little_runs, tmp_path_factory.mktemp("accidents") / "runs")
    return Stored.of(runs / "run", runs / "other")


def accidents(stored: Stored, accident: str) -> Iterator[Change]:
    """The accident to the first, the middle and the last file of every kind."""
    theirs = stored.files(stored.other)
    for kind, paths in stored.files().items():
        for path in dict.fromkeys((paths[0], paths[len(paths) // 2], paths[-1])):
            content = path.read_bytes()
            if accident == "a bit":
                position = Random(str(path.name)).randrange(len(content))
                yield {path: content[:position] + bytes([content[position] ^ 4]) + content[position + 1 :]}
            elif accident == "cut":
                yield {path: content[: len(content) // 2]}
            elif accident == "missing":
                yield {path: None}
            elif accident == "exchanged":
                equal = [other for other in paths if other != path and other.stat().st_size == len(content)]
                for other in (equal or [other for other in paths if other != path])[:1]:
                    yield {path: other.read_bytes(), other: content}
            else:
                other = stored.other / path.relative_to(stored.run)
                foreign = other if other.is_file() else next(iter(theirs.get(kind, ())), path)
                yield {path: foreign.read_bytes()}


def problem_of(stored: Stored, change: Change) -> str | None:
    """Reading the run under a change: its sentence where it is refused; None where it gives the same."""
    with applied(change):
        try:
            now = readings(stored.run)
        except ProbeKitError as error:
            return str(error)
    return None if now == stored.before else "SILENT"


def names(change: Change, run: Path) -> set[str]:
    """The ways in which a message may name the files of a change: by their key, or a folder that is removed."""
    keys = {path.relative_to(run) for path in change}
    parents = {parent.as_posix() for key in keys for parent in (key, *key.parents)}
    return parents - {".", "data.zarr", "columns.zarr"}


@pytest.mark.parametrize("accident", ACCIDENTS)
def test_an_accident_to_any_kind_of_file_is_named_or_changes_no_number(stored: Stored, accident: str) -> None:
    wrong, refused = [], 0
    for change in accidents(stored, accident):
        if all(path.is_file() and path.read_bytes() == content for path, content in change.items()):
            continue  # two runs of one process share a file, such as their provenance
        problem = problem_of(stored, change)
        refused += problem is not None
        words = ", ".join(sorted(path.relative_to(stored.run).as_posix() for path in change))
        if problem is None:
            continue
        if not (any(name in problem for name in names(change, stored.run)) or "run.json" in words):
            wrong.append(f"{words}: no file is named: {problem}")
        elif not REMEDY.search(problem):
            wrong.append(f"{words}: no remedy: {problem}")
    assert not wrong, "\n".join(wrong)
    assert refused > 20, "reading noticed hardly any accident"


def verdicts(stored: Stored, seeds: range) -> Iterator[tuple[int, str, str]]:
    for seed in seeds:
        fault = draw_fault(stored, seed)
        try:
            verdict = stored.verdict(fault)
        except Exception as error:  # noqa: BLE001 - any other error would be a traceback
            verdict = f"TRACEBACK {type(error).__name__}: {error}"
        yield seed, fault.words, verdict


@pytest.mark.parametrize("seeds", seeds_of_tonight(DRAWN), ids=str)
def test_no_drawn_accident_changes_a_number_that_verification_does_not_see(stored: Stored, seeds: range) -> None:
    came = list(verdicts(stored, seeds))
    print(Counter(verdict.partition(" ")[0].rstrip(":") for _, _, verdict in came), flush=True)
    wrong = [came_of for came_of in came if came_of[2] not in ("found", "harmless")]
    assert not wrong, "\n".join(map(str, wrong))
    assert len(KINDS) > 10
