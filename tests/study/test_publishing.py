"""Data sets of a study, and their upload to a stand-in of the hub."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
import yaml
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import StoreError, UsageError
from probe_kit.runs import open_run
from probe_kit.study import LoadedStudy, load_study, make_table, publish_data_set, write_data_set
from probe_kit.study.pack import data_set_version
from tests.support.hub_stand_in import Hub, hub

TOKEN = "hf_secretsecretsecretsecretsecretsec"


@pytest.fixture(scope="module")
def folder(played: LoadedStudy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("published") / "set"
    write_data_set(played, out, licence="cc-by-4.0")
    return out


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    with hub() as found:
        monkeypatch.setenv("HF_ENDPOINT", found.address)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield found


def test_the_data_set_holds_every_episode_table_and_hash(played: LoadedStudy, folder: Path) -> None:
    table = pd.read_parquet(folder / "episodes.parquet")
    runs = {cell.name: open_run(cell.location(played.study.folder)) for cell in played.cells}
    assert table.groupby("run").size().to_dict() == {name: len(run.episodes) for name, run in runs.items()}
    own = table[table["run"] == "expert/short"]
    assert own["outcome"].tolist() == runs["expert/short"].episodes["outcome"].tolist()
    assert not {"instruction", "target", "distractor"} & set(table)
    _, front, words = (folder / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    head = yaml.safe_load(front)
    assert head["license"] == "cc-by-4.0"
    assert head["dataset_info"]["splits"] == [{"name": "train", "num_examples": len(table)}]
    assert [one["name"] for one in head["dataset_info"]["features"]] == list(table.columns)
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


@pytest.mark.parametrize("failures", [[429], [0, 503]], ids=["too many requests", "cut connection"])
def test_what_fails_for_now_is_tried_again(folder: Path, server: Hub, failures: list[int]) -> None:
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


def test_the_command_writes_the_folder_first_and_never_over_another(played: LoadedStudy, tmp_path: Path) -> None:
    out = tmp_path / "set"
    arguments = ["study", "pack", str(played.file), "--out", str(out), "--data-set"]
    made = CliRunner().invoke(app, arguments)
    assert (made.exit_code, made.stdout.strip()) == (0, str(out))
    assert (out / "study.zip").is_file()
    with pytest.raises(UsageError, match="exists; choose another"):
        write_data_set(played, out)
