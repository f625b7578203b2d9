"""Archives of a study: every table from the archive alone, and nothing that was left out by mistake."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from shutil import copytree, rmtree
from zipfile import ZipFile

import pandas as pd
import pytest
import yaml
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import NoTrajectoryError, RunDamagedError, StoreError, UsageError
from probe_kit.retention import retention_table
from probe_kit.runs import copy_run, open_run, verify_run
from probe_kit.study import (
    LoadedStudy,
    load_study,
    make_table,
    pack_study,
    plan_study,
    publish_data_set,
    write_data_set,
)
from probe_kit.study.archive import table_of_record, table_record
from probe_kit.study.pack import data_set_version
from tests.support.hub_stand_in import Hub, hub


@pytest.fixture(scope="module")
def archive(played: LoadedStudy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("packed") / "study.zip"
    pack_study(played, out)
    return out


@pytest.mark.slow
def test_every_table_is_the_same_from_the_archive_alone(
    played: LoadedStudy, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither runs nor suite are where they were."""
    before = {name: make_table(played, name) for name in played.study.tables}
    home = Path(played.study.folder)
    away = tmp_path / "away"
    home.rename(away)
    monkeypatch.setattr("probe_kit.study.reading.planned_suite", None)
    try:
        packed = load_study(archive)
        assert {name: make_table(packed, name) for name in packed.study.tables} == before
        assert {planned.state for planned in plan_study(packed).cells} == {"whole"}
    finally:
        away.rename(home)


def test_an_archive_holds_no_picture_no_activation_and_no_name_of_this_machine(
    played: LoadedStudy, archive: Path
) -> None:
    with ZipFile(archive) as packed:
        names = packed.namelist()
    assert not [name for name in names if name.endswith((".png", ".jpg", ".gif", ".mp4"))]
    assert not [name for name in names if "/c/" in name and "/data.zarr/" in name and "pooled" in name]
    assert {name.split("/")[0] for name in names} == {"study.toml", "pack.json", "runs", "tables", "SHA256SUMS"}
    assert not [name for name in names if "/trajectory/c/" in name]
    assert {f"tables/{name}.{end}" for name in played.study.tables for end in ("json", "md", "tex")} <= set(names)


@pytest.mark.slow
def test_the_same_study_gives_the_same_bytes(played: LoadedStudy, archive: Path, tmp_path: Path) -> None:
    pack_study(played, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == archive.read_bytes()


@pytest.mark.slow
def test_an_archive_without_trajectories_judges_by_their_absence_and_with_them_as_before(
    played: LoadedStudy, archive: Path, tmp_path: Path
) -> None:
    pack_study(played, tmp_path / "pack", extras=["trajectories"])
    rates = []
    for study in (played, load_study(tmp_path / "pack")):
        run = open_run(study.cells[0].location(study.study.folder))
        rates.append(retention_table([run], rule="box").means[0].success.sr)
    assert rates[0] == rates[1] is not None
    bare = load_study(archive)
    run = open_run(bare.cells[0].location(bare.study.folder))
    assert verify_run(run.location, deep=True).ok
    assert retention_table([run], rule="box").means[0].success.sr is None
    with pytest.raises(NoTrajectoryError, match="is a copy without them"):
        run.trajectory(0)


@pytest.mark.slow
def test_a_pack_names_files_that_were_changed_added_or_lost(played: LoadedStudy, tmp_path: Path) -> None:
    folder = tmp_path / "pack"
    pack_study(played, folder)
    changed = copytree(folder, tmp_path / "changed")
    (changed / "tables" / "main.md").write_text("other", encoding="utf-8")
    with pytest.raises(RunDamagedError, match=r"main\.md has other bytes than were packed"):
        load_study(changed)
    more = copytree(folder, tmp_path / "more")
    (more / "runs" / "added.json").touch()
    with pytest.raises(RunDamagedError, match=r"added\.json was not packed"):
        load_study(more)
    lost = copytree(folder, tmp_path / "lost")
    rmtree(lost / "runs" / "idle")
    with pytest.raises(RunDamagedError, match=r"runs/idle/.* is missing\. Fetch the archive again"):
        load_study(lost)
    with pytest.raises(UsageError, match="exists; choose another --out"):
        pack_study(played, folder)
    (tmp_path / "broken.zip").write_bytes(b"PK no zip")
    with pytest.raises(RunDamagedError, match="no whole zip file"):
        load_study(tmp_path / "broken.zip")


@pytest.mark.slow
def test_missing_runs_are_refused_or_named(played: LoadedStudy, tmp_path: Path) -> None:
    file = tmp_path / "more.toml"
    text = played.file.read_text(encoding="utf-8").replace("light_level = 0.7", "light_level = 0.6")
    file.write_text(text, encoding="utf-8")
    run = CliRunner()
    refused = run.invoke(app, ["study", "pack", str(file), "--out", str(tmp_path / "a.zip")])
    assert refused.exit_code != 0
    assert not (tmp_path / "a.zip").exists()
    result = run.invoke(app, ["study", "pack", str(file), "--out", str(tmp_path / "a.zip"), "--partial"])
    assert result.exit_code == 0, result.output
    assert "2 runs, without activations, pictures, trajectories, directions" in result.stdout
    assert "not packed: idle/dark: " in result.stdout
    assert run.invoke(app, ["study", "table", str(tmp_path / "a.zip"), "main"]).exit_code == 0
    assert run.invoke(app, ["study", "run", str(tmp_path / "a.zip")]).exit_code == 2


def test_a_table_is_the_same_after_its_record(played: LoadedStudy) -> None:
    table = make_table(played, "score")
    again = table_of_record(json.loads(json.dumps(table_record(table))))
    assert again.to_markdown() == table.to_markdown()
    assert json.dumps(again.numbers) == json.dumps(table.numbers)


@pytest.mark.slow
def test_a_run_is_whole_without_what_an_archive_leaves_out(little_runs: Path, tmp_path: Path) -> None:
    """With probes, whose directions stay behind as activations do."""
    copy = tmp_path / "copy"
    copy_run(little_runs / "run", copy, directions=False)
    names = {path.name for path in copy.rglob("*") if "probes" in path.parts}
    assert any("settings" in name for name in names)
    assert not any("directions" in name for name in names)
    audit = verify_run(copy, deep=True)
    assert (audit.problems, audit.committed) == ((), audit.planned)
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--deep"])
    assert (answer.exit_code, answer.exception) == (0, None), answer.stderr
    (probed,) = [path for path in copy.rglob("*") if "scores" in path.name and "probes" in path.parts][:1]
    probed.write_bytes(b"")
    assert verify_run(copy, deep=True).problems


TOKEN = "hf_secretsecretsecretsecretsecretsec"


@pytest.fixture(scope="module")
def folder(played: LoadedStudy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("published") / "set"
    write_data_set(played, out, licence="cc-by-4.0")
    return out


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    with hub() as endpoint:
        monkeypatch.setenv("HF_ENDPOINT", endpoint.address)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield endpoint


@pytest.mark.slow
def test_the_data_set_holds_every_episode_table_and_hash(played: LoadedStudy, folder: Path) -> None:
    table = pd.read_parquet(folder / "episodes.parquet")
    runs = {cell.name: open_run(cell.location(played.study.folder)) for cell in played.cells}
    assert table.groupby("run").size().to_dict() == {name: len(run.episodes) for name, run in runs.items()}
    rows = table[table["run"] == "expert/short"]
    assert rows["outcome"].tolist() == runs["expert/short"].episodes["outcome"].tolist()
    assert not {"instruction", "target", "distractor"} & set(table)
    _, front, words = (folder / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    head = yaml.safe_load(front)
    assert head["license"] == "cc-by-4.0"
    assert head["dataset_info"]["splits"] == [{"name": "train", "num_examples": len(table)}]
    assert [feature["name"] for feature in head["dataset_info"]["features"]] == list(table.columns)
    assert make_table(played, "main").title in words
    for line in (folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert make_table(load_study(folder / "study.zip"), "main").texts == make_table(played, "main").texts


def test_an_upload_sends_every_file_once_and_tags_the_version(folder: Path, server: Hub) -> None:
    address = publish_data_set(folder, "lab/study")
    assert address.startswith(f"{server.address}/datasets/lab/study/commit/")
    assert server.files == {
        file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()
    }
    assert server.commits == 1
    assert ("POST", "/api/datasets/lab/study/tag/main") in [request[:2] for request in server.requests]
    assert len(data_set_version(folder)) == 12


@pytest.mark.slow
@pytest.mark.parametrize("failures", [[429], [0, 503]], ids=["too many requests", "cut connection"])
def test_an_upload_that_fails_for_now_is_tried_again(folder: Path, server: Hub, failures: list[int]) -> None:
    server.failures = list(failures)
    publish_data_set(folder, "lab/study", pause=0.01)
    assert (server.failures, server.commits) == ([], 1)


def test_a_refusal_is_said_at_once_and_no_message_holds_the_token(
    folder: Path, server: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    server.failures = [403]
    with pytest.raises(StoreError, match=r"the hub refuses lab/study: status 403\. Log in") as caught:
        publish_data_set(folder, "lab/study", pause=0.01)
    assert server.failures == []
    assert TOKEN not in f"{caught.value}{caplog.text}"
    assert any(TOKEN in token for *_, token in server.requests), "it was sent to the hub alone"


@pytest.mark.slow
def test_a_pull_request_is_opened_once_and_creates_and_tags_nothing(folder: Path, server: Hub) -> None:
    server.failures = [0, 503]
    address = publish_data_set(folder, "lab/study", pull_request=True, pause=0.01)
    assert address == f"{server.address}/datasets/lab/study/discussions/1"
    paths = [f"{method} {path}" for method, path, _ in server.requests]
    assert not [path for path in paths if "repos/create" in path or "/tag/" in path]
    assert paths.count("POST /api/datasets/lab/study/discussions") == 1
    assert any(path.endswith("/commit/refs%2Fpr%2F1") for path in paths)
    assert server.commits == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--private"], "--private is of an upload; give --publish OWNER/NAME too"),
        (["--pr", "--data-set"], "--pr is of an upload; give --publish OWNER/NAME too"),
        (["--license", "cc-by-4.0"], "--license is of a data set; give --data-set or --publish OWNER/NAME too"),
        (["--data-set", "--pictures"], "--pictures is not for a data set; leave it out"),
        (["--publish", "lab/study", "--directions"], "--directions is not for a data set; leave it out"),
    ],
)
def test_options_that_do_not_go_together_are_refused_before_anything_is_written(
    options: list[str], words: str, played: LoadedStudy, tmp_path: Path
) -> None:
    answer = CliRunner().invoke(app, ["study", "pack", str(played.file), "--out", str(tmp_path / "set"), *options])
    assert answer.exit_code == 2
    assert words in " ".join(answer.stderr.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_writes_the_folder_first_and_never_over_another(played: LoadedStudy, tmp_path: Path) -> None:
    out = tmp_path / "set"
    arguments = ["study", "pack", str(played.file), "--out", str(out), "--data-set"]
    result = CliRunner().invoke(app, arguments)
    assert (result.exit_code, result.stdout.strip()) == (0, str(out))
    assert (out / "study.zip").is_file()
    with pytest.raises(UsageError, match="exists; choose another"):
        write_data_set(played, out)
