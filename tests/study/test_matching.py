"""Runs of suites that ask the same and are not the same are never joined."""

from collections.abc import Callable
from pathlib import Path

import pytest

from probe_kit.errors import SettingsMismatchError
from probe_kit.extract import ExtractSettings
from probe_kit.retention.compare.compare import common_items
from probe_kit.runs import Run, open_run
from probe_kit.runs.store import locate
from probe_kit.study.cells import PlannedRun, planned_suite
from probe_kit.study.schema import SuiteTable
from probe_kit.study.stored import check_same_items, check_same_weights, differences
from probe_kit.suite import Suite
from tests.support.changed_suites import other_version, save_changed, without_twins
from tests.support.little_run import episode, little_plan, little_writer


def run_of(suite: Suite, where: Path) -> Run:
    plan = little_plan(suite.select(["color"], 2))
    writer = little_writer(locate(where), plan)
    for number in writer.remaining():
        writer.write(episode(plan, number))
    return open_run(where)


def test_runs_whose_items_have_other_twins_share_no_item(small_suite: Suite, tmp_path: Path) -> None:
    runs = [run_of(small_suite, tmp_path / "one"), run_of(without_twins(small_suite), tmp_path / "other")]
    assert runs[0].suite != runs[1].suite
    assert runs[0].seed_text == runs[1].seed_text
    assert [category.n_items for category in common_items(runs).values()] == [0]
    with pytest.raises(SettingsMismatchError, match="hold different items as"):
        check_same_items(runs)


def test_runs_of_two_versions_share_the_items_that_stayed(small_suite: Suite, tmp_path: Path) -> None:
    """The version stands in the hash of the suite, and not in that of an item, by which runs are paired."""
    runs = [run_of(small_suite, tmp_path / "one"), run_of(other_version(small_suite), tmp_path / "other")]
    assert runs[0].suite.partition("#")[2] != runs[1].suite.partition("#")[2]
    assert [category.n_items for category in common_items(runs).values()] == [2]
    check_same_items(runs)


@pytest.mark.parametrize(("change", "items_differ"), [(without_twins, True), (other_version, False)])
def test_a_study_sees_that_the_suite_in_its_folder_was_changed(
    change: Callable[[Suite], Suite], items_differ: bool, small_suite: Suite, tmp_path: Path
) -> None:
    changed = save_changed(change(small_suite), tmp_path / "changed")
    before, after = (planned_suite(SuiteTable(path=str(suite.folder)))[0] for suite in (small_suite, changed))
    assert (before.contents != after.contents) is items_differ
    assert (before.identity != after.identity) is not items_differ


@pytest.mark.parametrize(
    ("checkpoint", "differs"),
    [
        ("lab/first", False), ("lab/first@v1", False), ("lab/second", True), ("lab/second@v1", True),
        ("lab/first/inner", True), (f"lab/first@{'c' * 40}", False), (f"lab/first@{'d' * 40}", True),
    ],
)  # fmt: skip
def test_a_run_of_another_checkpoint_of_the_hub_is_seen_though_its_card_has_a_commit(
    checkpoint: str, differs: bool, small_suite: Suite, tmp_path: Path
) -> None:
    run = run_of(small_suite, tmp_path / "run")
    run.__dict__["certificate"] = {"policy": {"checkpoint": f"lab/first@{'c' * 40}"}}
    suite = planned_suite(SuiteTable(path=str(small_suite.folder)))[0]
    cell = PlannedRun("base", "plain", 0, ExtractSettings("pi0", checkpoint), {}, suite)
    assert any(words.startswith("checkpoint: stored 'lab/first") for words in differences(run, cell)) is differs


def cell_of(suite: Suite, checkpoint: Path | None, way: str = "plain") -> PlannedRun:
    planned = planned_suite(SuiteTable(path=str(suite.folder)))[0]
    return PlannedRun("base", way, 0, ExtractSettings("pi0", checkpoint and str(checkpoint)), {}, planned)


def test_a_run_of_another_folder_of_weights_is_seen_unless_the_folder_was_moved(
    small_suite: Suite, tmp_path: Path
) -> None:
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
        (folder / "model.safetensors").write_bytes(folder.name.encode())
    run = run_of(small_suite, tmp_path / "run")
    run.__dict__["certificate"] = {"policy": {"checkpoint": str(folders[0])}}
    reasons = [
        [words for words in differences(run, cell_of(small_suite, folder)) if words.startswith("checkpoint")]
        for folder in (*folders, None)
    ]
    assert [len(words) for words in reasons] == [0, 1, 0]
    folders[0].rename(tmp_path / "moved")
    moved = cell_of(small_suite, tmp_path / "moved")
    assert not [words for words in differences(run, moved) if words.startswith("checkpoint")]


def test_runs_of_one_model_have_one_hash_of_weights(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [run_of(small_suite, tmp_path / name) for name in ("one", "other")]
    cells = [cell_of(small_suite, None, way) for way in ("plain", "dark")]
    check_same_weights(list(zip(cells, runs, strict=True)))
    monkeypatch.setattr(Run, "weights_sha256", property(lambda run: run.location.name))
    with pytest.raises(SettingsMismatchError, match="are runs of 'base' with different weights"):
        check_same_weights(list(zip(cells, runs, strict=True)))
