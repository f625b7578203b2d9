"""What was once done to a run unseen: each is an error that names the object, on reading and to `run verify`."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import RunDamagedError, RunIncompleteError
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs.commits import write_failure
from probe_kit.runs.contents import stored_objects, stray_keys
from probe_kit.runs.records import Checksum, as_record
from probe_kit.runs.results import RepeatedWorkWarning
from probe_kit.runs.run import Run
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import read_thumbnail, thumbnail_key
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.store import SweepCheckpoint
from tests.support.little_run import episode, little_plan, little_writer, write_little_run
from tests.support.reading import readings
from tests.support.rehashing import rehash, write_record

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def other(little_runs: Path) -> Path:
    return little_runs / "other"


@pytest.fixture
def run(little_runs: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(little_runs / "run", tmp_path / "run"))


@pytest.fixture(scope="module")
def uncompressed(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without compression: all objects of an array have one size."""
    folder = tmp_path_factory.mktemp("uncompressed") / "run"
    return write_little_run(folder, small_suite.select(["color"]), codec="none").path


@pytest.fixture
def equal_sizes(uncompressed: Path, tmp_path: Path) -> Path:
    """A copy of the uncompressed run that a test may damage."""
    return Path(shutil.copytree(uncompressed, tmp_path / "plain"))


def edit(path: Path, change: Edit) -> None:
    """A value by hand, written as it was written before."""
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")


def swap(first: Path, other: Path) -> None:
    first_bytes, other_bytes = first.read_bytes(), other.read_bytes()
    assert first_bytes != other_bytes
    first.write_bytes(other_bytes)
    other.write_bytes(first_bytes)


def assert_found(run: Path, *names: str, deep: bool = False) -> None:
    """By reading, which ends at the first wrong object that arrives, and by verification, which names all."""
    either = "|".join(map(re.escape, names))
    with pytest.raises(RunDamagedError, match=either):
        readings(run)
    problems = verify_run(run, deep).problems
    assert all(any(name in problem for problem in problems) for name in names)


# -- the plan ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("remaining", [0, 20, 23])
def test_episodes_that_a_sealed_run_lost_are_missed(run: Path, remaining: int) -> None:
    for commit in sorted((run / "commits").glob("*.json"))[remaining:]:
        commit.unlink()
    if not remaining:
        (run / "commits").rmdir()
    assert_found(run, f"commits/{remaining:08d}.json is missing")
    with pytest.raises(RunDamagedError, match=f"{24 - remaining} are gone"):
        open_run(run, allow_partial=True)


def test_an_older_state_of_a_run_differs_from_a_finished_one(small_suite: Suite, tmp_path: Path) -> None:
    """As a copy made in the middle of the work would be: whole, and less than was planned."""
    plan = little_plan(small_suite.select(["color"]))
    writer = little_writer(locate(tmp_path / "run"), plan)
    for number in writer.remaining()[:20]:
        writer.write(episode(plan, number))
    older = verify_run(tmp_path / "run", deep=True)
    assert (older.ok, older.finished, older.committed, older.planned) == (True, False, 20, 24)
    result = CliRunner().invoke(app, ["run", "verify", str(tmp_path / "run")])
    assert (result.exit_code, "not finished" in result.output) == (0, True)
    with pytest.raises(RunIncompleteError, match="20 of 24"):
        open_run(tmp_path / "run")


def test_a_seal_of_fewer_episodes_is_no_damage_and_is_not_used(small_suite: Suite, tmp_path: Path) -> None:
    """A run that was sealed, continued and killed before it was sealed again."""
    plan = little_plan(small_suite.select(["color"]))
    writer = little_writer(locate(tmp_path / "run"), plan)
    first, *later = writer.remaining()
    writer.write(episode(plan, first))
    seal(tmp_path / "run")
    for number in later:
        writer.write(episode(plan, number))
    verification = verify_run(tmp_path / "run", deep=True)
    assert (verification.ok, verification.finished, verification.sealed) == (True, True, False)
    assert not open_run(tmp_path / "run").sealed
    (tmp_path / "run/commits/00000000.json").unlink()
    with pytest.raises(RunDamagedError, match=r"commits/00000000\.json is missing"):
        open_run(tmp_path / "run", allow_partial=True)


# -- run.json ----------------------------------------------------------------------------------------------


# -- commits -----------------------------------------------------------------------------------------------


def test_commits_of_another_run_are_found(run: Path, other: Path) -> None:
    shutil.copytree(other / "commits", run / "commits", dirs_exist_ok=True)
    assert_found(run, "commits/00000000.json is the commit of run")


def test_commits_and_objects_of_another_run_are_found(run: Path, other: Path) -> None:
    for folder in ("commits", "data.zarr", "columns.zarr", "sealed", "provenance", "certificates"):
        shutil.copytree(other / folder, run / folder, dirs_exist_ok=True)
    assert_found(run, "commits/00000000.json is the commit of run")


def test_more_commits_than_planned_are_found(run: Path) -> None:
    shutil.copy(run / "commits/00000004.json", run / "commits/00000024.json")
    assert_found(run, "commits/00000024.json commits an episode that the run does not plan")


# -- chunks ------------------------------------------------------------------------------------------------


def chunk(run: Path, array: str, episode: int) -> Path:
    (path,) = (path for path in (run / f"data.zarr/{array}/c/{episode}").rglob("*") if path.is_file())
    return path


@pytest.mark.parametrize("site", [0, 1])
def test_a_part_of_an_exchanged_shard_is_no_number(equal_sizes: Path, site: int) -> None:
    """Reading one layer reads a few kilobytes of a shard, and those are checked."""
    swap(chunk(equal_sizes, "backbone/tokens", 2), chunk(equal_sizes, "backbone/tokens", 9))
    opened = open_run(equal_sizes)
    with pytest.raises(RunDamagedError, match=r"backbone/tokens/c/(2|9)"):
        opened.tokens(opened.sites("backbone")[site])


def test_seal_makes_no_columns_of_exchanged_rows(equal_sizes: Path) -> None:
    shutil.rmtree(equal_sizes / "columns.zarr")
    swap(chunk(equal_sizes, "backbone/pooled", 2), chunk(equal_sizes, "backbone/pooled", 9))
    with pytest.raises(RunDamagedError, match=r"backbone/pooled/c/(2|9)"):
        seal(equal_sizes)
    assert not open_run(equal_sizes).sealed


# -- metadata ----------------------------------------------------------------------------------------------


# -- columns -----------------------------------------------------------------------------------------------


def test_columns_of_another_run_are_found(run: Path, other: Path) -> None:
    (ours,), (theirs,) = ([*(folder / "columns.zarr").iterdir()] for folder in (run, other))
    shutil.rmtree(ours)
    shutil.copytree(theirs, ours)
    assert_found(run, "columns.zarr", deep=True)


def test_columns_of_another_run_with_their_hashes_are_found(run: Path, other: Path) -> None:
    stamp = open_run(run).stamp
    for folder in ("columns.zarr", "sealed"):
        shutil.rmtree(run / folder)
        shutil.copytree(other / folder, run / folder)
    assert_found(run, "sealed")
    shutil.move(next((run / "sealed").iterdir()), run / "sealed" / f"{stamp[:16]}.json")
    assert_found(run, "sealed")


def test_the_metadata_of_columns_are_missed_alone_and_not_with_all_of_them(run: Path) -> None:
    (columns,) = (run / "columns.zarr").iterdir()
    (columns / "zarr.json").unlink()
    assert_found(run, f"columns.zarr/{columns.name}/zarr.json is missing")
    shutil.rmtree(run / "columns.zarr")
    assert verify_run(run, deep=True).ok
    assert not open_run(run).sealed


def test_columns_that_are_not_the_rows_are_found_though_their_hashes_are_right(run: Path) -> None:
    """As a mistake in `seal` would leave them."""
    (seal,) = (run / "sealed").iterdir()
    home = next(run.glob("columns.zarr/*/backbone/pooled/c/0/0"))
    swap(home / "0/0/0", home / "1/0/0")
    content = json.loads(seal.read_text(encoding="utf-8"))
    first, second = (f"backbone/pooled/c/0/0/{layer}/0/0" for layer in (0, 1))
    objects = content["objects"]
    objects[first], objects[second] = objects[second], objects[first]
    del content["blake2b"]
    seal.write_bytes(as_record(content))
    assert any("is not what the rows give" in problem for problem in verify_run(run, deep=True).problems)


# -- certificate, provenance, failures ---------------------------------------------------------------------


def test_reasons_of_failures_are_protected(run: Path) -> None:
    opened = open_run(run)
    (run / "commits/00000003.json").unlink()
    shutil.rmtree(run / "sealed")
    write_failure(opened.root, 3, "the gripper broke")
    assert list(open_run(run, allow_partial=True).failed.values()) == ["the gripper broke"]
    assert verify_run(run).failed == 1
    edit(run / "failed/00000003.json", lambda failure: failure.update(episode_id="another"))
    assert "failed/00000003.json" in verify_run(run).problems[0]
    with pytest.raises(RunDamagedError, match=r"failed/00000003\.json"):
        open_run(run, allow_partial=True)


# -- pictures ----------------------------------------------------------------------------------------------


def test_whoever_wants_no_pictures_may_delete_all_of_them(run: Path, little_runs: Path) -> None:
    shutil.rmtree(run / "frames")
    assert read_thumbnail(run, 0) is None
    assert verify_run(run, deep=True).ok
    after, before = readings(run), readings(little_runs / "run")
    assert {name for name in after if after[name] != before[name]} == {"pictures"}


def test_a_picture_that_no_commit_names_is_not_shown(run: Path) -> None:
    shutil.copy(run / thumbnail_key(0), run / thumbnail_key(7))
    assert read_thumbnail(run, 7) is None
    assert verify_run(run, deep=True).ok


# -- probes ------------------------------------------------------------------------------------------------


def stored_probes(run: Path) -> list[Path]:
    """Oldest first: without controls, then with them."""
    folders = [path for path in (run / "probes").iterdir() if not path.name.startswith(".")]
    return sorted(
        folders, key=lambda path: json.loads((path / "times.json").read_text(encoding="utf-8"))["created"]
    )


def test_probes_in_the_place_of_others_are_found(run: Path) -> None:
    first, second = stored_probes(run)
    shutil.rmtree(first)
    shutil.copytree(second, first)
    assert_found(run, f"probes/{first.name}/settings.json")


def test_probes_of_another_run_are_found(run: Path, other: Path) -> None:
    shutil.rmtree(run / "probes")
    shutil.copytree(other / "probes", run / "probes")
    assert_found(run, "probes/")


def test_probes_of_activations_that_are_no_more_are_found(run: Path) -> None:
    """The same episodes with other numbers, as another machine would give with `--batch 8`."""
    swap(run / "data.zarr/backbone/pooled/c/2/0/0/0/0", run / "data.zarr/backbone/pooled/c/9/0/0/0/0")
    rehash(run)
    identity = open_run(run).root.identity
    for folder in stored_probes(run):
        write_record(
            folder / "settings.json",
            {**json.loads((folder / "settings.json").read_text(encoding="utf-8")), "run": identity},
        )
    with pytest.raises(RunDamagedError, match="other activations"):
        load_results(open_run(run))


@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_an_interrupted_sweep_is_continued_only_from_what_it_left(run: Path) -> None:
    opened = open_run(run)
    settings = train_probes(opened, permutations=3).settings
    expected = load_results(opened, settings.key).scores
    partial = SweepCheckpoint.of(opened.location, settings.key, opened.stamp)
    shutil.rmtree(run / "probes" / settings.key)
    stop_after(opened, settings.permutations, 4)
    partial_files = sorted((run / partial.folder).iterdir())
    assert len(partial_files) == 4
    shutil.copy(partial_files[0], partial_files[1])
    with pytest.warns(RepeatedWorkWarning, match=re.escape(partial_files[1].name)):
        again = train_probes(opened, permutations=3).scores
    np.testing.assert_array_equal(again["accuracy"], expected["accuracy"])


def stop_after(run: Run, permutations: int, sites: int) -> None:
    class EnoughError(Exception):
        pass

    def stop(finished: int, _total: int, _site: str) -> None:
        if finished == sites:
            raise EnoughError

    with pytest.raises(EnoughError):
        train_probes(run, permutations=permutations, progress=stop)


# -- interventions -----------------------------------------------------------------------------------------


def test_interventions_of_another_run_are_found(run: Path, other: Path) -> None:
    shutil.rmtree(run / "interventions")
    shutil.copytree(other / "interventions", run / "interventions")
    assert_found(run, "interventions/")


# -- records that lead elsewhere ---------------------------------------------------------------------------


def test_no_record_of_results_makes_a_training_remove_a_file_elsewhere(run: Path, tmp_path: Path) -> None:
    victim = tmp_path / "thesis.txt"
    victim.write_text("do not touch", encoding="utf-8")
    for folder in stored_probes(run):
        head = json.loads((folder / "settings.json").read_text(encoding="utf-8"))
        head["files"]["scores.csv"] = ["../../../thesis.txt", *head["files"]["scores.csv"][1:]]
        write_record(folder / "settings.json", head)
    with pytest.raises(RunDamagedError, match=r"thesis\.txt.*not a file in the same folder"):
        train_probes(open_run(run), permutations=2, controls=("position",))
    assert victim.read_text(encoding="utf-8") == "do not touch"
    assert any("thesis.txt" in problem for problem in verify_run(run).problems)


@pytest.mark.parametrize("absolute", [False, True])
def test_what_a_commit_names_outside_of_its_run_is_not_there(run: Path, tmp_path: Path, absolute: bool) -> None:
    outside = tmp_path / "outside"
    outside.write_bytes(b"of somebody else")
    key = str(outside) if absolute else "../../outside"
    path = run / "commits" / "00000003.json"
    commit = json.loads(path.read_text(encoding="utf-8"))
    commit["objects"][key] = Checksum.of(outside.read_bytes()).to_json()
    write_record(path, commit)
    verification = verify_run(run, deep=True)
    assert any(
        "outside" in problem and "no object of this episode" in problem for problem in verification.problems
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
@pytest.mark.parametrize(
    "key", ["plan/00000000.json", "commits/00000002.json", "data.zarr/zarr.json", "certificate.json"]
)
def test_a_pipe_or_a_device_in_the_place_of_a_file_is_not_waited_for(run: Path, key: str) -> None:
    (run / key).unlink()
    os.mkfifo(run / key)
    verification = verify_run(run, deep=True)
    assert not verification.ok or verification.committed < verification.planned
    if key != "certificate.json":  # which other records repeat
        with pytest.raises((RunDamagedError, RunIncompleteError)):
            readings(run)


# -- nothing -----------------------------------------------------------------------------------------------


def test_copies_that_lie_about_change_nothing_and_are_named(run: Path, little_runs: Path) -> None:
    (settings,) = (run / "sealed").iterdir()
    probes = stored_probes(run)[0]
    names = (
        "run.json",
        "plan/00000000.json",
        "commits/00000003.json",
        "certificate.json",
        "data.zarr/expert/pooled/zarr.json",
    )
    for path in (*(run / name for name in names), settings, probes / "settings.json"):
        for name in (f"{path.stem} copy.json", f"{path.name}~", f"._{path.name}", f"{path.name}.bak"):
            shutil.copy(path, path.with_name(name))
    shutil.copytree(probes, probes.with_name(f"{probes.name} copy"))
    assert readings(run) == readings(little_runs / "run")
    verification = verify_run(run, deep=True)
    assert verification.ok
    assert "commits/00000003 copy.json" in verification.strays
    assert f"probes/{probes.name} copy/settings.json" in verification.strays


# -- everything --------------------------------------------------------------------------------------------


def unprotected(run: Run) -> set[str]:
    """Files that no hash covers."""
    commits = dict(zip(run.episodes["episode"], run.commits(), strict=True))
    objects = stored_objects(run.root, commits, run.columns)
    return set(stray_keys(run.root, commits, run.columns, objects))


def test_no_file_of_a_run_is_without_protection(little_runs: Path) -> None:
    assert unprotected(open_run(little_runs / "run")) == set()


def test_no_file_of_a_real_run_is_without_protection(recorded_run: Run) -> None:
    assert unprotected(recorded_run) == set()
