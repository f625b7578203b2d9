"""What items are enough for, and how many would be, is known before any work."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.statistics.sufficiency import (
    GROUPS_FOR_PROBES,
    groups_for_absence,
    groups_for_interventions,
    groups_for_not_used,
    groups_for_signal,
)
from probe_kit.suite import Suite
from probe_kit.suite.sufficiency import Smallest, Sufficiency, sufficiencies


def by_name(suite: Suite, scored: bool = True, probed: bool = True) -> dict[str, Sufficiency]:
    return {one.name: one for one in sufficiencies(suite, scored, probed)}


@pytest.mark.parametrize("items", [2, 6, 8, 10, 12])
def test_every_use_is_enough_exactly_from_its_number_of_groups(items: int, small_suite: Suite) -> None:
    suite = small_suite.select(None, items)
    groups = min(len({one.group_id for one in suite.items if one.category == name}) for name in suite.categories)
    said = by_name(suite)
    assert list(said) == [
        "success rate", "probes", "retention", "shown", "absent", "interventions", "not used",
    ]  # fmt: skip
    assert said["probes"].enough == said["retention"].enough == (groups >= GROUPS_FOR_PROBES)
    assert said["shown"].enough == (groups >= groups_for_signal())
    assert said["interventions"].enough == (groups >= groups_for_interventions())
    assert said["not used"].enough == (groups >= groups_for_not_used())
    assert said["absent"].enough == (groups >= groups_for_absence(round(2 * items / groups)))
    assert said["success rate"].enough is (False if items < 4 else None)
    for one in said.values():
        if one.enough is False and one.name != "success rate":
            assert one.words.startswith(f"no, {groups} groups of ")
            assert re.search(r"; (take \d+ (items|or more)|the suite has \d+)$", one.words)
            assert len(one.words) < 64  # a line of a terminal of 80 columns


@pytest.mark.parametrize("category", ["color", "shape"])
def test_the_number_of_items_that_would_do_is_the_smallest_that_can_be_selected(
    category: str, small_suite: Suite
) -> None:
    smallest = Smallest.of(small_suite.select([category], 2))
    for groups in range(1, 7):
        items = smallest.items_for(groups)
        if items is None:
            assert Smallest.of(small_suite.select([category])).groups < groups
            continue
        assert Smallest.of(small_suite.select([category], items)).groups >= groups
        if items > 2:
            assert Smallest.of(small_suite.select([category], items - 2)).groups < groups


def test_the_category_with_the_fewest_groups_decides_and_is_named(small_suite: Suite) -> None:
    few = small_suite.select(["shape"], 4).items
    suite = Suite(
        small_suite.name, small_suite.version,
        tuple(item for item in small_suite.items if item.category == "color" or item in few),
        small_suite.folder, small_suite.card,
    )  # fmt: skip
    assert Smallest.of(suite).words.startswith("shape: 4 items in ")


def test_a_use_that_a_run_cannot_have_is_not_mentioned(small_suite: Suite) -> None:
    suite = small_suite.select(None, 4)
    assert list(by_name(suite, probed=False)) == ["success rate"]
    assert next(iter(by_name(suite, scored=False))) == "probes"


def test_the_command_says_it_before_any_work_in_few_lines(small_suite: Suite, tmp_path: Path) -> None:
    command = ["extract", "--model", "idle", "--suite", str(small_suite.folder), "--items", "4", "--dry-run"]
    answer = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "run")])
    assert answer.exit_code == 0, answer.output
    lines = answer.output.splitlines()
    at = next(number for number, line in enumerate(lines) if "enough for" in line)
    assert "4 items in" in lines[at]
    assert "Δ = ± 49.0 points; ± 10 takes 97 items" in lines[at + 1]
    assert len(lines) - at <= 8
    assert not (tmp_path / "run").exists()
