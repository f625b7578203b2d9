"""Runs of the first schema stay readable, and give the numbers they gave then."""

import hashlib
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import RunDamagedError, SettingsMismatchError
from probe_kit.extract import Run, open_run, verify_run
from probe_kit.extract.plan import Plan
from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.writer import RunWriter
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.suite import Suite
from probe_kit.train.results.inventory import inventory

STORED = Path(__file__).parents[2] / "golden" / "run-schema-1"
EXPECTED: dict[str, dict[str, Any]] = json.loads((STORED / "expected.json").read_text())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(STORED / "runs.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def sha256(array: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("name", ["pooled", "tokens", "expert"])
def test_a_run_of_the_first_schema_gives_the_same_numbers(runs: Path, name: str) -> None:
    run, then = open_run(runs / name), EXPECTED[name]
    assert (run.settings_sha256, run.stamp, run.model) == (then["settings_sha256"], then["stamp"], then["model"])
    assert run.episodes["outcome"].tolist() == then["outcomes"]
    assert run.episodes["cube_x"].tolist() == then["cube_x"]
    assert run.sealed == then["sealed"]
    columns = {
        f"{site} {view} {call}": sha256(run.column(site, view, call))
        for stream in run.streams
        for site in run.sites(stream)
        for view in run.views(stream)
        for call in range(run.settings["captured_calls"])
    }
    assert columns == then["columns"]
    assert verify_run(runs / name, deep=True).ok


def test_tokens_of_the_first_schema_are_read_by_role(runs: Path) -> None:
    run, then = open_run(runs / "tokens"), EXPECTED["tokens"]
    for name, hashes in then["tokens"].items():
        site, call = name.split()
        assert [sha256(array) for array in run.tokens(Site.parse(site), None, int(call))] == hashes
    assert sha256(run.tokens(run.sites("backbone")[1], "language")[0]) == then["language"]


def test_an_old_run_has_no_provenance_and_is_not_mixed(runs: Path) -> None:
    run = open_run(runs / "pooled")
    assert (run.provenances, run.mixed) == ({}, ())
    assert run.certificate["hooks_on_equals_hooks_off"] is True
    assert run.certificate["versions"]["torch"]


def test_an_old_run_labels_its_axes_as_new_ones_do(runs: Path) -> None:
    dataset = open_run(runs / "pooled").xarray()
    assert dataset["expert_pooled"].dims[:3] == ("episode", "call", "expert_iteration")
    assert dataset.sizes["call"] == 2


def test_an_old_run_still_makes_a_table(runs: Path) -> None:
    run = open_run(runs / "pooled")
    table = retention_table([run])
    assert {row.category for row in table.rows} == {"color"}
    assert table.rows[0].success.n_episodes == len(EXPECTED["pooled"]["outcomes"])


def test_an_old_run_is_marked_as_not_protected(runs: Path) -> None:
    run = open_run(runs / "pooled")
    assert not run.protected
    assert "not protected" in repr(run)
    assert "not protected" in run._repr_html_()
    assert not inventory(run).protected
    assert not verify_run(runs / "pooled").protected
    said = CliRunner().invoke(app, ["run", "verify", str(runs / "pooled")])
    assert (said.exit_code, "not protected" in said.output) == (0, True)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[" * 99_999,
        b"[]",
        b"{}",
        b"\xff\xfe",
        b'{"schema_version": 1}',
        b'{"schema_version": "x"}',
        b'{"schema_version": 2, "settings": 3, "settings_sha256": "", "streams": []}',
    ],
)
@pytest.mark.parametrize("file", ["run.json", "plan.json", "commits/00000001.json"])
def test_damaged_json_of_an_old_run_is_named(runs: Path, tmp_path: Path, file: str, content: bytes) -> None:
    """By whoever reads it; `run verify` never ends in a traceback either."""
    copy = Path(shutil.copytree(runs / "expert", tmp_path / "run"))
    (copy / file).write_bytes(content)
    with pytest.raises(RunDamagedError):
        open_run(copy)
    assert not verify_run(copy, deep=True).ok


def test_an_old_run_is_not_continued(runs: Path, small_suite: Suite) -> None:
    run = Run(locate(runs / "pooled"))
    plan = Plan(small_suite, (), tuple(run.stored(name) for name in run.streams), 0)
    with pytest.raises(SettingsMismatchError, match="schema_version: stored 1, asked 3"):
        RunWriter(run.location, plan, run.settings)


def test_an_old_run_has_no_success_rate_by_rules_that_need_trajectories(runs: Path) -> None:
    run = open_run(runs / "pooled")
    assert not run.has_trajectories
    table = retention_table([run], rule="box")
    assert (table.rows[0].success.sr, table.rows[0].rules.rule) == (None, "box")
    assert "keeps no trajectories" in " ".join(table.notes)
    assert retention_table([run], rule="disc").rows[0].success.sr is not None
