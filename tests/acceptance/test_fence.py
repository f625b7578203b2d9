"""The numbers of the product: `scripts/fence.py` plays small runs anew, and finds what `fence.json` holds."""

import copy
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.fence_comparison import differences, platform_differences, read

FOLDER = Path(__file__).parent
SCRIPT = FOLDER.parents[1] / "scripts" / "fence.py"
STORED = read(FOLDER / "fence.json")
SLOW_FILE = FOLDER / "fence-slow.json"
STORED_SLOW: dict[str, Any] = read(SLOW_FILE) if SLOW_FILE.exists() else {"runs": {}}


def play(file: Path, *options: str) -> dict[str, Any]:
    """Play in a process of its own: the number of threads is decided before numpy is imported."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    command = [sys.executable, str(SCRIPT), *options, str(file)]
    done = subprocess.run(command, env=environment, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stderr[-4000:] + done.stdout[-2000:]
    return read(file)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return play(tmp_path_factory.mktemp("fence") / "fence.json")


@pytest.fixture(scope="module")
def played_slow(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return play(tmp_path_factory.mktemp("fence") / "fence-slow.json", "--slow")


def check(stored: dict[str, Any], now: dict[str, Any], run: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Fail with every difference of one run; say so where the platform allows a tolerance only."""
    if other := platform_differences(stored, now):
        with capsys.disabled():
            print(
                f"\nfence: {run} was compared with a tolerance, because this platform differs: {'; '.join(other)}"
            )
    lines = differences(stored, now, run)
    listed = "\n".join(lines[:200])
    assert not lines, (
        f"{len(lines)} numbers of the run {run} differ from those in tests/acceptance (old → new):\n{listed}\n"
        "If the change is meant, make the file again with `python scripts/fence.py` and say why in the commit."
    )


@pytest.mark.parametrize("run", STORED["runs"])
def test_a_run_gives_the_numbers_that_are_stored(
    run: str, played: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    check(STORED, played, run, capsys)


@pytest.mark.slow
@pytest.mark.skipif(
    not SLOW_FILE.exists(), reason=f"`python scripts/fence.py --slow {SLOW_FILE.name}` was not run yet"
)
@pytest.mark.parametrize("run", STORED_SLOW["runs"] or ["no file"])
def test_a_larger_run_gives_the_numbers_that_are_stored(
    run: str, played_slow: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    check(STORED_SLOW, played_slow, run, capsys)


def _changed(column: str, change: Any, platform: str | None = None) -> list[str]:
    """Change one column of the first row that has a value in it, and compare."""
    new = copy.deepcopy(STORED)
    tables = [table for run in ("acting", "comparison") for table in new["runs"][run].values()]
    rows = [row for table in tables for row in table.values() if row.get(column) is not None]
    assert rows, f"no row has the column {column}"
    rows[0][column] = change(rows[0][column])
    if platform:
        new["platform"]["torch"] = platform
    return [line for run in ("acting", "comparison") for line in differences(STORED, new, run)]


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("accuracy", lambda value: value + 1e-15),
        ("p_fwe", lambda value: value / 2),
        ("C", lambda value: value.replace("1", "2", 1)),
        ("outcome", lambda value: "wrong" if value == "correct" else "correct"),
        ("bytes_sha256", lambda value: value[::-1]),
        ("success.sr", lambda value: value - 1e-12),
        ("retention.defined", lambda value: not value),
        ("ci_low", lambda value: value + 1e-8),
    ],
)
def test_a_changed_number_is_listed_with_its_path_and_both_values(column: str, change: Any) -> None:
    (line,) = _changed(column, change)
    assert line.startswith(("acting / ", "comparison / "))
    assert f" / {column}: " in line
    assert " → " in line


def test_ends_of_intervals_may_move_by_rounding() -> None:
    assert not _changed("ci_low", lambda value: value + 1e-11)


def test_another_platform_allows_a_tolerance_and_no_hash_but_still_compares() -> None:
    assert not _changed("bytes_sha256", lambda value: value[::-1], platform="another")
    assert not _changed("accuracy", lambda value: value + 1e-6, platform="another")
    assert not _changed("p_fwe", lambda value: value + 1 / 32, platform="another")
    assert _changed("p_fwe", lambda value: value + 0.25, platform="another")
    assert _changed("accuracy", lambda value: value + 0.05, platform="another")
    assert _changed("outcome", lambda value: f"not {value}", platform="another")


def test_a_lost_row_table_and_run_are_listed() -> None:
    new = copy.deepcopy(STORED)
    tables = new["runs"]["acting"]
    tables["episodes"].popitem()
    del tables["sides"], new["runs"]["recording"]
    lines = differences(STORED, new, "acting")
    assert [line.split(": ")[1] for line in lines] == [
        "a row → none",
        f"{len(STORED['runs']['acting']['sides'])} rows → none",
    ]
    assert len(differences(STORED, new, "recording")) == len(STORED["runs"]["recording"])
