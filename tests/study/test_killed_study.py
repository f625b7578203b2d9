"""`study run` killed at drawn moments and given again: nothing stored is lost, and the bytes are the same."""

from pathlib import Path

import pytest

from probe_kit.suite import Suite
from tests.study.small_study import SCRIPTED, TEXT, bytes_of, run_folders, small_study
from tests.support.killed_commands import KilledCommand, committed, kill_often, run_problems

KILLS = {SCRIPTED: 20, TEXT: 6}
"""Of each study. A command of the one with networks takes a minute of processor time, twenty kills ten minutes."""


def command(suite: Suite, text: str, items: int, *options: str) -> KilledCommand:
    def runs(folder: Path) -> list[Path]:
        return run_folders(folder / "study.toml")

    return KilledCommand(
        "study run",
        lambda folder: small_study(folder, suite, text, items),
        lambda folder: ["study", "run", str(folder / "study.toml"), *options],
        lambda folder: bytes_of(folder / "study.toml"),
        lambda folder: committed(*runs(folder)),
        lambda folder: run_problems(*runs(folder)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("text", "items"), [(SCRIPTED, 6), (TEXT, 10)], ids=["scripted", "probed"])
@pytest.mark.parametrize("options", [(), ("--slots", "2")], ids=["here", "processes"])
def test_kills_lose_nothing_and_change_no_byte(
    text: str, items: int, options: tuple[str, ...], small_suite: Suite, tmp_path: Path
) -> None:
    print(kill_often(command(small_suite, text, items, *options), tmp_path, KILLS[text], seed=len(options)))
