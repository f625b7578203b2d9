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
from probe_kit.intervene import stored_image_swaps
from probe_kit.retention import retention_table
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs.commits import write_failure
from probe_kit.runs.contents import stored_objects, stray_keys
from probe_kit.runs.records import Sum, as_record
from probe_kit.runs.run import Run
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import read_thumbnail, thumbnail_key
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.resume import SweepCheckpoint
from tests.support.faults import Stored
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


def swap(one: Path, other: Path) -> None:
    here, there = one.read_bytes(), other.read_bytes()
    assert here != there
    one.write_bytes(there)
    other.write_bytes(here)


def assert_found(run: Path, *names: str, deep: bool = False) -> None:
    """By reading, which ends at the first wrong object that arrives, and by verification, which names all."""
    either = "|".join(map(re.escape, names))
    with pytest.raises(RunDamagedError, match=either):
        readings(run)
    problems = verify_run(run, deep).problems
    assert all(any(name in problem for problem in problems) for name in names)


# -- the plan ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda plan: [one.update(side_correct={"left": "right"}.get(one["side_correct"], "left")) for one in plan],
        lambda plan: plan[3].update(side_correct="lefft"),
        lambda plan: [one.update(group_id=f"own-{number}") for number, one in enumerate(plan)],
        lambda plan: [one.update(category="shape") for one in plan],
        lambda plan: plan.reverse(),
        lambda plan: plan.__delitem__(slice(20, None)),
        lambda plan: plan[0].update(episode=1) or plan[1].update(episode=0),
        lambda plan: plan[0].update(instruction="Put the cube on nothing"),
    ],
    ids=["flipped labels", "a misspelt label", "unique groups", "another category", "another order",
         "dropped episodes", "exchanged numbers", "another instruction"],
)  # fmt: skip
def test_a_changed_plan_is_found(run: Path, change: Callable[[Any], object]) -> None:
    edit(run / "plan/00000000.json", lambda plan: change(plan["episodes"]))
    assert_found(run, "plan/00000000.json")
    with pytest.raises(RunDamagedError, match=r"plan/00000000\.json"):
        retention_table([open_run(run)])


@pytest.mark.parametrize("left", [0, 20, 23])
def test_episodes_that_a_sealed_run_lost_are_missed(run: Path, left: int) -> None:
    for commit in sorted((run / "commits").glob("*.json"))[left:]:
        commit.unlink()
    if not left:
        (run / "commits").rmdir()
    assert_found(run, f"commits/{left:08d}.json is missing")
    with pytest.raises(RunDamagedError, match=f"{24 - left} are gone"):
        open_run(run, allow_partial=True)


def test_an_older_state_of_a_run_differs_from_a_finished_one(small_suite: Suite, tmp_path: Path) -> None:
    """As a copy made in the middle of the work would be: whole, and less than was planned."""
    plan = little_plan(small_suite.select(["color"]))
    writer = little_writer(locate(tmp_path / "run"), plan)
    for number in writer.remaining()[:20]:
        writer.write(episode(plan, number))
    older = verify_run(tmp_path / "run", deep=True)
    assert (older.ok, older.finished, older.committed, older.planned) == (True, False, 20, 24)
    said = CliRunner().invoke(app, ["run", "verify", str(tmp_path / "run")])
    assert (said.exit_code, "not finished" in said.output) == (0, True)
    with pytest.raises(RunIncompleteError, match="20 of 24"):
        open_run(tmp_path / "run")


def test_a_seal_of_fewer_episodes_is_no_damage_and_is_not_used(small_suite: Suite, tmp_path: Path) -> None:
    """A run that was sealed, continued and killed before it was sealed again."""
    plan = little_plan(small_suite.select(["color"]))
    writer = little_writer(locate(tmp_path / "run"), plan)
    first, *rest = writer.remaining()
    writer.write(episode(plan, first))
    seal(tmp_path / "run")
    for number in rest:
        writer.write(episode(plan, number))
    found = verify_run(tmp_path / "run", deep=True)
    assert (found.ok, found.finished, found.sealed) == (True, True, False)
    assert not open_run(tmp_path / "run").sealed
    (tmp_path / "run/commits/00000000.json").unlink()
    with pytest.raises(RunDamagedError, match=r"commits/00000000\.json is missing"):
        open_run(tmp_path / "run", allow_partial=True)


# -- run.json ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda card: card["settings"].update(random_weights=False),
        lambda card: card["settings"].update(model="pi0"),
        lambda card: card["streams"][0]["views"].reverse(),
        lambda card: card["streams"][0].update(part="action"),
        lambda card: card.update(schema_version=2),
        lambda card: card.pop("objects"),
        lambda card: card.pop("blake2b"),
        lambda card: card["objects"].clear(),
    ],
    ids=["trained after all", "another model", "views reversed", "another part", "an older schema", "no hashes",
         "no own hash", "nothing to check"],
)  # fmt: skip
def test_a_changed_root_is_found(run: Path, change: Edit) -> None:
    edit(run / "run.json", change)
    assert_found(run, "run.json")


def test_the_root_of_another_run_is_found(run: Path, other: Path) -> None:
    shutil.copy(other / "run.json", run / "run.json")
    assert_found(run, "plan/00000000.json")


# -- commits -----------------------------------------------------------------------------------------------


def test_a_changed_outcome_is_found(run: Path) -> None:
    edit(run / "commits/00000004.json", lambda commit: commit["outcome"].update(outcome="correct"))
    assert_found(run, "commits/00000004.json was changed")


def test_a_commit_in_the_place_of_another_is_found(run: Path) -> None:
    shutil.copy(run / "commits/00000004.json", run / "commits/00000005.json")
    assert_found(run, "commits/00000005.json is the commit of")


def test_commits_that_changed_places_are_found(run: Path) -> None:
    swap(run / "commits/00000004.json", run / "commits/00000005.json")
    assert_found(run, "commits/00000004.json is the commit of")


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

ARRAYS = ("backbone/pooled", "backbone/tokens", "expert/pooled", "expert/tokens", "trajectory")


def chunk(run: Path, array: str, episode: int) -> Path:
    (path,) = (path for path in (run / f"data.zarr/{array}/c/{episode}").rglob("*") if path.is_file())
    return path


@pytest.mark.parametrize("array", ARRAYS)
def test_exchanged_objects_of_one_size_are_found(equal_sizes: Path, array: str) -> None:
    swap(chunk(equal_sizes, array, 2), chunk(equal_sizes, array, 9))
    if array.endswith("pooled"):
        shutil.rmtree(equal_sizes / "columns.zarr")  # which would still have the right numbers
    assert verify_run(equal_sizes).ok, "sizes are the same"
    assert_found(equal_sizes, *(f"data.zarr/{array}/c/{episode}" for episode in (2, 9)), deep=True)


@pytest.mark.parametrize("site", [0, 1])
def test_a_part_of_an_exchanged_shard_is_no_number(equal_sizes: Path, site: int) -> None:
    """Reading one layer reads a few kilobytes of a shard, and those are checked."""
    swap(chunk(equal_sizes, "backbone/tokens", 2), chunk(equal_sizes, "backbone/tokens", 9))
    opened = open_run(equal_sizes)
    with pytest.raises(RunDamagedError, match=r"backbone/tokens/c/(2|9)"):
        opened.tokens(opened.sites("backbone")[site])


@pytest.mark.parametrize(
    "array", [ARRAYS[0], *(pytest.param(array, marks=pytest.mark.slow) for array in ARRAYS[1:])]
)
def test_chunks_of_another_seed_are_found(
    equal_sizes: Path, small_suite: Suite, tmp_path: Path, array: str
) -> None:
    another = write_little_run(tmp_path / "another", small_suite.select(["color"]), seed=1, codec="none").path
    shutil.copy(chunk(another, array, 3), chunk(equal_sizes, array, 3))
    shutil.rmtree(equal_sizes / "columns.zarr")
    assert_found(equal_sizes, f"data.zarr/{array}/c/3", deep=True)


def test_seal_makes_no_columns_of_exchanged_rows(equal_sizes: Path) -> None:
    shutil.rmtree(equal_sizes / "columns.zarr")
    swap(chunk(equal_sizes, "backbone/pooled", 2), chunk(equal_sizes, "backbone/pooled", 9))
    with pytest.raises(RunDamagedError, match=r"backbone/pooled/c/(2|9)"):
        seal(equal_sizes)
    assert not (equal_sizes / "columns.zarr").exists()


# -- metadata ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("home", ["data.zarr", "columns.zarr"])
def test_other_endianness_is_found(run: Path, home: str) -> None:
    metadata = run / home / "backbone/pooled/zarr.json"
    metadata.write_text(metadata.read_text(encoding="utf-8").replace('"little"', '"big"'), encoding="utf-8")
    assert_found(run, f"{home}/backbone/pooled/zarr.json", deep=True)


@pytest.mark.parametrize("home", ["data.zarr", "columns.zarr"])
def test_reversed_views_are_found(run: Path, home: str) -> None:
    edit(run / home / "backbone/pooled/zarr.json", lambda array: array["attributes"]["views"].reverse())
    assert_found(run, f"{home}/backbone/pooled/zarr.json", deep=True)


def test_another_type_codec_or_shape_is_found(run: Path) -> None:
    for change in (
        lambda array: array.update(data_type="float64"),
        lambda array: array["codecs"].pop(),
        lambda array: array["shape"].__setitem__(0, 7),
        lambda array: array.update(fill_value=0.0),
    ):
        copy = Path(shutil.copytree(run, run.parent / "copy"))
        edit(copy / "data.zarr/expert/pooled/zarr.json", change)
        assert_found(copy, "data.zarr/expert/pooled/zarr.json")
        shutil.rmtree(copy)


# -- columns -----------------------------------------------------------------------------------------------


def test_columns_of_another_run_are_found(run: Path, other: Path) -> None:
    shutil.rmtree(run / "columns.zarr")
    shutil.copytree(other / "columns.zarr", run / "columns.zarr")
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
    (run / "columns.zarr/zarr.json").unlink()
    assert_found(run, "columns.zarr/zarr.json is missing")
    shutil.rmtree(run / "columns.zarr")
    assert verify_run(run, deep=True).ok
    assert not open_run(run).sealed


def test_exchanged_columns_are_found(equal_sizes: Path) -> None:
    home = "columns.zarr/backbone/pooled/c/0/0"
    exchanged = [f"{home}/{layer}/0/0" for layer in (0, 1)]
    swap(*(equal_sizes / name for name in exchanged))
    assert_found(equal_sizes, *exchanged, deep=True)


def test_columns_that_are_not_the_rows_are_found_though_their_hashes_are_right(run: Path) -> None:
    """As a mistake in `seal` would leave them."""
    (seal,) = (run / "sealed").iterdir()
    home = run / "columns.zarr/backbone/pooled/c/0/0"
    swap(home / "0/0/0", home / "1/0/0")
    content = json.loads(seal.read_text(encoding="utf-8"))
    first, second = (f"backbone/pooled/c/0/0/{layer}/0/0" for layer in (0, 1))
    objects = content["objects"]
    objects[first], objects[second] = objects[second], objects[first]
    del content["blake2b"]
    seal.write_bytes(as_record(content))
    assert any("is not what the rows give" in problem for problem in verify_run(run, deep=True).problems)


# -- certificate, provenance, failures ---------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["certificate", "certificates", "provenance"])
@pytest.mark.parametrize("how", ["edited", "foreign", "lost"])
def test_what_was_said_of_a_run_is_protected(run: Path, other: Path, kind: str, how: str) -> None:
    pattern = "certificate.json" if kind == "certificate" else f"{kind}/*.json"
    (path,), (theirs,) = run.glob(pattern), other.glob(pattern)
    if how == "edited":
        edit(path, lambda content: content.update(python="4", capture_check={}))
    elif how == "foreign" and kind != "provenance":  # two runs made by one process share it
        path.unlink()
        shutil.copy(theirs, path.parent)
    else:
        path.unlink()
    assert_found(run, kind)


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


@pytest.mark.parametrize("how", ["edited", "exchanged", "another's", "cut", "lost alone"])
def test_pictures_of_a_report_are_protected(run: Path, other: Path, how: str) -> None:
    first, second = sorted((run / "frames").iterdir())
    content = bytearray(first.read_bytes())
    if how == "exchanged":
        swap(first, second)
    elif how == "another's":
        shutil.copy(other / "frames" / first.name, first)
    elif how == "lost alone":
        first.unlink()
    else:
        content[len(content) // 2] ^= 1
        first.write_bytes(bytes(content) if how == "edited" else bytes(content[:-9]))
    assert_found(run, f"frames/{first.name}", deep=True)


@pytest.mark.slow
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


@pytest.mark.parametrize(
    "change",
    [
        lambda head: head["settings"].update(permutations=2000),
        lambda head: head["settings"].update(format=1),
        lambda head: head["files"].pop("controls.json", None) or head["files"].pop("scores.csv"),
        lambda head: head.pop("blake2b"),
        lambda head: head.update(stamp=""),
    ],
    ids=["more label permutations", "another format", "a file less", "no hash", "no stamp"],
)
@pytest.mark.parametrize("which", [0, 1])
def test_changed_settings_of_probes_are_found(run: Path, change: Edit, which: int) -> None:
    edit(stored_probes(run)[which] / "settings.json", change)
    assert_found(run, "settings.json")
    with pytest.raises(RunDamagedError, match=r"settings\.json"):
        retention_table([open_run(run)])


@pytest.mark.parametrize("which", [0, 1])
def test_lost_settings_are_found_and_no_older_probes_are_read(run: Path, which: int) -> None:
    (stored_probes(run)[which] / "settings.json").unlink()
    assert_found(run, "settings.json is missing")
    with pytest.raises(RunDamagedError, match="is missing"):
        retention_table([open_run(run)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["decisions", "directions", "controls"])
@pytest.mark.parametrize("how", ["lost", "flipped", "another's"])
def test_changed_files_of_probes_are_found(run: Path, name: str, how: str, other: Path) -> None:
    (path,) = stored_probes(run)[1].glob(f"{name}*")
    if how == "lost":
        path.unlink()
    elif how == "flipped":
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    else:
        (theirs,) = stored_probes(other)[1].glob(f"{name}*")
        if theirs.read_bytes() == path.read_bytes():
            pytest.skip("a control that looks at labels alone is the same for both seeds")
        shutil.copy(theirs, path)
    assert_found(run, name, deep=True)


def test_scores_that_were_edited_are_found_though_nothing_reads_them(run: Path) -> None:
    (path,) = stored_probes(run)[0].glob("scores*.csv")
    path.write_text(path.read_text(encoding="utf-8").replace("0.", "1.", 1), encoding="utf-8")
    assert "scores" in verify_run(run, deep=True).problems[0]


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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_an_interrupted_sweep_is_continued_only_from_what_it_left(run: Path) -> None:
    opened = open_run(run)
    settings = train_probes(opened, permutations=3).settings
    expected = load_results(opened, settings.key).scores
    partial = SweepCheckpoint.of(opened.location, settings.key, opened.stamp)
    shutil.rmtree(run / "probes" / settings.key)
    stop_after(opened, settings.permutations, 4)
    left = sorted((run / partial.folder).iterdir())
    assert len(left) == 4
    shutil.copy(left[0], left[1])
    with pytest.raises(RunDamagedError, match=re.escape(left[1].name)):
        train_probes(opened, permutations=3)
    left[1].unlink()
    again = train_probes(opened, permutations=3).scores
    np.testing.assert_array_equal(again["accuracy"], expected["accuracy"])


def stop_after(run: Run, permutations: int, sites: int) -> None:
    class EnoughError(Exception):
        pass

    def stop(done: int, _total: int, _site: str) -> None:
        if done == sites:
            raise EnoughError

    with pytest.raises(EnoughError):
        train_probes(run, permutations=permutations, progress=stop)


# -- interventions -----------------------------------------------------------------------------------------


def stored_intervention(run: Path) -> Path:
    (folder,) = (run / "interventions").iterdir()
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        lambda head: head["settings"].update(stamp="0" * 64),
        lambda head: head["files"].pop("certificate.json"),
        lambda head: head.pop("blake2b"),
    ],
    ids=["of other episodes", "a file less", "no hash"],
)
def test_changed_settings_of_interventions_are_found(run: Path, change: Edit) -> None:
    edit(stored_intervention(run) / "settings.json", change)
    assert_found(run, "settings.json")
    with pytest.raises(RunDamagedError, match="probe-kit intervene"):
        stored_image_swaps(open_run(run))


def test_changed_or_lost_answers_are_found(run: Path, other: Path) -> None:
    path = stored_intervention(run) / "episodes.npz"
    shutil.copy(stored_intervention(other) / "episodes.npz", path)
    assert_found(run, "episodes.npz", deep=True)
    path.unlink()
    assert_found(run, "episodes.npz is missing")


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
        train_probes(open_run(run), permutations=1, controls=("position",))
    assert victim.read_text(encoding="utf-8") == "do not touch"
    assert any("thesis.txt" in problem for problem in verify_run(run).problems)


@pytest.mark.parametrize("absolute", [False, True])
def test_what_a_commit_names_outside_of_its_run_is_not_there(run: Path, tmp_path: Path, absolute: bool) -> None:
    outside = tmp_path / "outside"
    outside.write_bytes(b"of somebody else")
    key = str(outside) if absolute else "../../outside"
    path = run / "commits" / "00000003.json"
    commit = json.loads(path.read_text(encoding="utf-8"))
    commit["objects"][key] = Sum.of(outside.read_bytes()).to_json()
    write_record(path, commit)
    found = verify_run(run, deep=True)
    assert any("outside" in problem and "no object of this episode" in problem for problem in found.problems)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
@pytest.mark.parametrize(
    "key", ["plan/00000000.json", "commits/00000002.json", "data.zarr/zarr.json", "certificate.json"]
)
def test_a_pipe_or_a_device_in_the_place_of_a_file_is_not_waited_for(run: Path, key: str) -> None:
    (run / key).unlink()
    os.mkfifo(run / key)
    found = verify_run(run, deep=True)
    assert not found.ok or found.committed < found.planned
    with pytest.raises((RunDamagedError, RunIncompleteError)):
        readings(run)


# -- nothing -----------------------------------------------------------------------------------------------


@pytest.mark.slow
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
    found = verify_run(run, deep=True)
    assert found.ok
    assert "commits/00000003 copy.json" in found.strays
    assert f"probes/{probes.name} copy/settings.json" in found.strays


# -- everything --------------------------------------------------------------------------------------------


def unprotected(run: Run) -> set[str]:
    """Files that no hash covers."""
    commits = dict(zip(run.episodes["episode"], run.commits(), strict=True))
    objects = stored_objects(run.root, commits, run.columns)
    return set(stray_keys(run.root, commits, run.columns, objects))


def test_no_file_of_a_run_is_without_protection(little_runs: Path) -> None:
    assert unprotected(open_run(little_runs / "run")) == set()


@pytest.mark.slow
def test_no_file_of_a_real_run_is_without_protection(recorded_run: Run) -> None:
    assert unprotected(recorded_run) == set()


def test_a_flipped_bit_in_any_kind_of_file_is_found(run: Path) -> None:
    kinds = Stored(run, run, {}, verify_run(run)).files()
    assert len(kinds) > 20
    for paths in kinds.values():
        path = paths[len(paths) // 2]
        before = path.read_bytes()
        path.write_bytes(before[:-2] + bytes([before[-2] ^ 4]) + before[-1:])
        assert not verify_run(run, deep=True).ok, path
        path.write_bytes(before)
    assert verify_run(locate(run), deep=True).ok
