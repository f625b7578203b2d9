"""Copies without activations: every table, and no column."""

import json
import shutil
from pathlib import Path

import pytest

from probe_kit.errors import ActivationsLeftOutError, RunDamagedError, UsageError
from probe_kit.retention import retention_table
from probe_kit.runs import Run, copy_run, open_run, seal, verify_run
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from tests.support.little_run import little_plan, little_settings


@pytest.fixture(scope="module")
def copies(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """A run and its copy."""
    run = open_run(little_runs / "run")
    return run, copy_run(run.location, tmp_path_factory.mktemp("copy") / "run")


def table_of(run: Run) -> object:
    return json.loads(retention_table([run]).to_json().replace(str(run.location), "RUN"))


def test_every_number_of_a_table_is_that_of_the_run(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    assert table_of(copy) == table_of(run)
    assert (copy.stamp, copy.settings_sha256, copy.label) == (run.stamp, run.settings_sha256, run.label)
    assert copy.episodes.equals(run.episodes)
    assert (copy.trajectory(0).tool == run.trajectory(0).tool).all() if run.has_trajectories else True


def test_what_it_lacks_is_refused_by_name(copies: tuple[Run, Run]) -> None:
    _, copy = copies
    site = copy.sites("backbone")[0]
    with pytest.raises(ActivationsLeftOutError, match=str(site)):
        copy.column(site)
    with pytest.raises(ActivationsLeftOutError, match="tokens of backbone"):
        copy.tokens(site)
    with pytest.raises(ActivationsLeftOutError, match="nothing to seal"):
        seal(copy.location)


def test_it_is_small_whole_and_says_what_it_is(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    audit = verify_run(copy.location, deep=True)
    assert audit.ok
    assert audit.finished
    assert audit.left_out == ("backbone/pooled", "backbone/tokens", "expert/pooled", "expert/tokens")
    assert audit.strays == verify_run(run.location).left_out == ()
    assert not [file for file in copy.path.glob("data.zarr/*/*/c/**") if "trajectory" not in file.parts]
    assert not (copy.path / "columns.zarr").exists()
    assert not (copy.path / "frames").exists()


def test_nothing_can_be_added_to_it(copies: tuple[Run, Run], small_suite: Suite) -> None:
    plan = little_plan(small_suite.select(["color"]))
    with pytest.raises(ActivationsLeftOutError, match="nothing can be added"):
        RunWriter(copies[1].location, plan, little_settings())


def test_damage_is_still_damage(copies: tuple[Run, Run], tmp_path: Path) -> None:
    copy = Path(shutil.copytree(copies[1].path, tmp_path / "copy"))
    record = copy / "left-out.json"
    content = record.read_text(encoding="utf-8")
    record.write_text(content.replace("backbone/pooled", "backbone/poolex"), encoding="utf-8")
    with pytest.raises(RunDamagedError, match="left-out"):
        open_run(copy)
    record.unlink()
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(copy)
    record.write_text(content, encoding="utf-8")
    trajectories = [file for file in copy.rglob("data.zarr/trajectory/c/*/*/*") if file.is_file()]
    trajectories[0].unlink()
    with pytest.raises(RunDamagedError, match="trajectory"):
        open_run(copy)


def test_a_place_that_is_not_empty_is_refused(copies: tuple[Run, Run]) -> None:
    run, copy = copies
    with pytest.raises(UsageError, match="not empty"):
        copy_run(run.location, copy.location)
