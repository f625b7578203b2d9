"""Accidents at random places of a run: reading raises or gives the same, and `run verify` finds them."""

import shutil
from collections import Counter
from pathlib import Path

import pytest

from tests.support.faults import Stored, draw_fault

FAST, SLOW, BLOCK = 15, 5000, 100


@pytest.fixture(scope="module")
def stored(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Of copies: an accident that was undone may leave an empty folder, and others read these runs too."""
    runs = shutil.copytree(little_runs, tmp_path_factory.mktemp("accidents") / "runs")
    return Stored.of(runs / "run", runs / "other")


def assert_nothing_is_silent(stored: Stored, seeds: range) -> None:
    found: Counter[str] = Counter()
    wrong = []
    for seed in seeds:
        fault = draw_fault(stored, seed)
        try:
            verdict = stored.verdict(fault)
        except Exception as error:  # noqa: BLE001 - any other error would be a traceback
            verdict = f"TRACEBACK {type(error).__name__}: {error}"
        found[verdict.partition(" ")[0].rstrip(":")] += 1
        if verdict not in ("found", "harmless"):
            wrong.append(f"seed {seed}: {fault.words}: {verdict}")
    print(f"seeds {seeds.start} to {seeds.stop - 1}: {dict(found)}", flush=True)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_no_accident_changes_a_number_unseen(stored: Stored) -> None:
    assert_nothing_is_silent(stored, range(FAST))


@pytest.mark.slow
@pytest.mark.parametrize("start", range(FAST, FAST + SLOW, BLOCK))
def test_five_thousand_accidents_change_no_number_unseen(stored: Stored, start: int) -> None:
    assert_nothing_is_silent(stored, range(start, start + BLOCK))
