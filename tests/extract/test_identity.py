"""What a run is made of: a run is continued only where numbers come out the same, or says that it was not."""

import json
import os
import shutil
from importlib.metadata import version
from pathlib import Path

import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import RunDamagedError, SettingsMismatchError, UsageError
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.hashing import sha256_json
from probe_kit.retention import retention_table
from probe_kit.retention.report import report_html
from probe_kit.runs import Run, open_run, provenance, verify_run
from probe_kit.runs.records import HASH
from probe_kit.runs.store import locate
from probe_kit.suite import Suite, build_suite

SHORT = SceneSpec(max_steps=2)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)


def expert(suite: Suite) -> ExtractSettings:
    return ExtractSettings("expert", suite=suite.folder, scene=SHORT, env_workers=0)


def begin(settings: ExtractSettings, folder: Path) -> None:
    """Play the first episode only."""

    class EnoughError(Exception):
        pass

    def stop(*_: object) -> None:
        raise EnoughError

    with pytest.raises(EnoughError):
        extract_run(settings, folder, stop)
    assert 0 < len(open_run(folder, allow_partial=True).episodes) < 4


def test_a_scene_run_has_the_identity_and_the_plan_that_it_had(suite: Suite) -> None:
    """A hash that changes by accident would stop runs from being continued."""
    prepared = prepare(expert(suite))
    assert sha256_json(prepared.identity())[:16] == "627e1ff7dbbddd31"
    assert sha256_json(prepared.plan.to_json())[:16] == "f31538462ceed37f"
    assert prepared.default_name() == "expert-d7e6640b"


def elsewhere(monkeypatch: pytest.MonkeyPatch, **changes: object) -> None:
    """Pretend that this process computes somewhere else; versions are changed one by one."""
    here = provenance.provenance_here

    def there(*where: str) -> dict[str, object]:
        record = here(*where)
        versions = {name: value for name, value in changes.items() if name in record["versions"]}
        rest = {name: value for name, value in changes.items() if name not in versions}
        return {**record, **rest, "versions": {**record["versions"], **versions}}

    monkeypatch.setattr("probe_kit.extract.extraction.provenance_here", there)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"device": "cuda"}, r"device: stored 'cpu', here 'cuda'"),
        ({"torch": "1.0"}, r"versions\.torch: stored '.+', here '1\.0'"),
        ({"lerobot": "0.1"}, r"versions\.lerobot"),
        ({"transformers": "4.0"}, r"versions\.transformers"),
        ({"pybullet": "1.0"}, r"versions\.pybullet"),
        ({"dtype": "bfloat16"}, r"dtype"),
    ],
)
def test_a_run_is_not_continued_where_numbers_come_out_otherwise(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], message: str
) -> None:
    begin(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, **change)
    with pytest.raises(SettingsMismatchError, match=message) as caught:
        extract_run(expert(suite), tmp_path / "run")
    assert "--allow-mixed" in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.slow
def test_a_mixed_run_says_so(suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, torch="1.0", device="cuda")
    run = extract_run(expert(suite).changed(allow_mixed=True), tmp_path / "run")
    assert run.mixed == ("device", "versions.torch")
    assert run.certificate["mixed"] == ["device", "versions.torch"]
    assert len(run.provenances) == 2
    assert verify_run(run.path, deep=True).ok
    table = retention_table([run])
    for text in (table.to_markdown(), table.to_latex("all"), str(table.notes), report_html([run], table)):
        assert "versions.torch" in text.replace("\\_", "_")


@pytest.mark.slow
def test_a_copy_of_a_run_does_not_count_beside_it(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    copy = open_run(shutil.copytree(run.path, tmp_path / "copy"))
    with pytest.raises(UsageError, match="once as its copy"):
        retention_table({"a": [run], "b": [copy]})


@pytest.mark.slow
def test_other_writers_interpreters_and_processes_are_no_other_numbers(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, python="3.13.0", machine="aarch64", zarr="9")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    run = extract_run(expert(suite).changed(env_workers=1), tmp_path / "run")
    assert run.mixed == ()
    assert len(run.provenances) == 2


def test_a_finished_run_opens_by_its_command_wherever_that_is(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extract_run(expert(suite), tmp_path / "run")
    elsewhere(monkeypatch, torch="1.0")
    assert extract_run(expert(suite), tmp_path / "run").mixed == ()


def test_provenance_is_stored_once_and_every_commit_names_it(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    (record,) = (run.path / "provenance").glob("*.json")
    commits = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(run.path.glob("commits/*.json"))]
    assert [commit["provenance"] for commit in commits] == [record.stem] * 4
    stored = json.loads(record.read_text(encoding="utf-8"))
    assert stored["device"] == "cpu"
    assert stored["versions"]["torch"] == version("torch")
    del stored[HASH]
    assert provenance.name_of(stored) == record.stem


def test_lost_or_changed_provenance_is_found(suite: Suite, tmp_path: Path) -> None:
    run = extract_run(expert(suite), tmp_path / "run")
    (record,) = (run.path / "provenance").glob("*.json")
    record.write_text(record.read_text(encoding="utf-8").replace('"cpu"', '"tpu"'), encoding="utf-8")
    assert "was changed" in verify_run(run.path).problems[0]
    record.unlink()
    assert "is missing" in verify_run(run.path).problems[0]
    with pytest.raises(RunDamagedError, match="provenance"):
        _ = Run(locate(run.path)).mixed


def test_the_versions_of_the_machine_are_those_of_the_packages() -> None:
    record = provenance.provenance_here()
    assert {part.partition(".")[2] for part in provenance.DECISIVE} - {""} <= record["versions"].keys()
    assert os.sep not in json.dumps(record), "no path of this machine"


def test_who_plans_for_gpus_elsewhere_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    record = provenance.provenance_here("cuda:1", "bfloat16")
    assert (record["device"], record["device_name"], record["dtype"]) == ("cuda", None, "bfloat16")


def test_allowing_a_mix_is_no_part_of_the_identity(suite: Suite) -> None:
    plain, allowed = prepare(expert(suite)), prepare(expert(suite).changed(allow_mixed=True))
    assert plain.identity() == allowed.identity()
