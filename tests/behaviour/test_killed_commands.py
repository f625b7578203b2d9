"""Kills of every command that writes: nothing finished is lost, and the same command ends with the same bytes."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.runs import verify_run
from probe_kit.suite import Suite, build_suite
from tests.suite.converters.conftest import picture, save, write_json
from tests.support.killed_commands import (
    KilledCommand,
    begun,
    committed,
    files_of,
    kill_often,
    leftovers,
    run_files,
    run_problems,
    run_together,
)
from tests.support.reading import readings

KILLS = 20
CATEGORIES = ("--categories", "color")


@pytest.fixture(scope="session")
def six(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """Six Color items in three groups."""
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


@pytest.fixture(scope="session")
def acted(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of twelve Color items whose policy acted twice per episode, with all tokens."""
    suite = small_suite.select(["color"])
    settings = ExtractSettings(
        "pi0-tiny", suite=suite.folder, categories=("color",), scene=SceneSpec(max_steps=2), tokens="all"
    )
    return extract_run(settings, tmp_path_factory.mktemp("acted") / "run").path


def _comparisons(root: Path) -> None:
    """Sixteen pairs of a benchmark, with pictures of our own."""
    rows = []
    for number in range(16):
        names = [f"fer-2013/test/happy/im{number}_{side}.png" for side in "ab"]
        for offset, name in enumerate(names):
            save(picture(2 * number + offset, (48, 48)), root / name)
        question = "Based on these images, which person is more smiling?"
        rows.append({"image_1": names[0], "image_2": names[1], "question": question, "answer": "Left"})
    write_json(rows, root / "Labeled_data" / "fer2013_label" / "fer2013_0_720_rebalanced.json")


def _on_a_copy(of: Path, folder: Path) -> None:
    shutil.copytree(of, folder / "run")


def _unsealed(of: Path, target: Path) -> None:
    _on_a_copy(of, target)
    for folder in ("columns.zarr", "sealed"):
        shutil.rmtree(target / "run" / folder)


def _of_run(name: str, begin: object, *arguments: str) -> KilledCommand:
    """A command on the run that lies in `run`."""
    first = arguments[: 2 if arguments[0] == "run" else 1]
    options = arguments[len(first) :]
    assert callable(begin)
    return KilledCommand(
        name,
        begin,
        lambda folder: [*first, str(folder / "run"), *options],
        lambda folder: run_files(folder / "run"),
        lambda folder: committed(folder / "run"),
        lambda folder: run_problems(folder / "run"),
    )


def _of_extract(name: str, *arguments: str) -> KilledCommand:
    return KilledCommand(
        name,
        lambda _: None,
        lambda folder: [*arguments, "--out", str(folder / "run")],
        lambda folder: _without_first_observation(run_files(folder / "run")),
        lambda folder: committed(folder / "run"),
        lambda folder: run_problems(folder / "run"),
    )


def _without_first_observation(files: dict[str, bytes]) -> dict[str, bytes]:
    """Two workers race for `certificate.json`, whose capture check is of the winner's first observation.

    Verification compares the whole file with the workers' own records.
    """
    certificate = json.loads(files["certificate.json"])
    assert certificate.pop("capture_check")["observations"] == 1
    del certificate["blake2b"]
    return {**files, "certificate.json": json.dumps(certificate).encode()}


def _of_ask(suite: Suite) -> KilledCommand:
    def runs(folder: Path) -> list[Path]:
        return [folder / "asked" / "p1-224x224", folder / "asked" / "seen-224x224"]

    return KilledCommand(
        "ask",
        lambda _: None,
        lambda folder: [
            *("ask", "--model", "vlm-tiny", "--prompt", "p1,seen", "--suite", str(suite.folder)),
            *("--out", str(folder / "asked")),
        ],
        lambda folder: {
            f"{run.name}/{key}": content for run in runs(folder) for key, content in run_files(run).items()
        },
        lambda folder: committed(*runs(folder)),
        lambda folder: run_problems(*runs(folder)),
    )


def _of_suite(name: str, begin: object, *arguments: str) -> KilledCommand:
    """A command that makes the folder `suite`; its arguments may name `{place}`."""
    assert callable(begin)
    return KilledCommand(
        name,
        begin,
        lambda folder: [argument.format(place=folder) for argument in arguments],
        lambda folder: files_of(folder / "suite"),
        lambda folder: set(files_of(folder / "suite")) if (folder / "suite").is_dir() else set(),
    )


def _command(name: str, request: pytest.FixtureRequest) -> KilledCommand:
    match name:
        case "suite build":
            return _of_suite(name, lambda _: None, "suite", "build", "{place}/suite", *CATEGORIES, "--n", "12")
        case "suite convert":
            options = ("--root", "{place}/root", "--out", "{place}/suite", "--emit-curation", "{place}/review.csv")
            return _of_suite(
                name, lambda target: _comparisons(target / "root"), "suite", "convert", "mllm-compbench", *options
            )
        case "ask":
            return _of_ask(request.getfixturevalue("six"))
        case "extract":
            suite: Suite = request.getfixturevalue("six")
            extract_options = ("--model", "pi0-tiny", "--suite", str(suite.folder), "--no-act", "--tokens", "all")
            return _of_extract(name, "extract", *extract_options, "--workers", "2")
        case "run verify --seal":
            return _of_run(
                name, partial(_unsealed, request.getfixturevalue("little_runs") / "run"), "run", "verify", "--seal"
            )
    acted, folder = request.getfixturevalue("acted"), str(request.getfixturevalue("small_suite").folder)
    match name:
        case "train":
            options = ("--views", "mean,tokens", "--permutations", "2", "--token-permutations", "2")
            return _of_run(name, partial(_on_a_copy, acted), "train", *options, "--suite", folder)
        case "intervene":
            return _of_run(name, partial(_on_a_copy, acted), "intervene", "--suite", folder)
    raise LookupError(name)


ALL = ("suite build", "suite convert", "run verify --seal", "train", "intervene", "ask", "extract")


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_twenty_kills_lose_nothing_and_change_no_byte(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    print(kill_often(_command(name, request), tmp_path, KILLS, seed=ALL.index(name)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["suite build", "train", "intervene", "ask", "extract"])
def test_the_same_command_twice_at_once_makes_the_same(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    command = _command(name, request)
    alone, together = begun(command, tmp_path / "alone"), begun(command, tmp_path / "together")
    assert run_together([command.arguments(alone)], alone, lambda: True) == []
    assert run_together([command.arguments(together)] * 2, together, lambda: True) == []
    assert command.results(together) == command.results(alone)
    assert command.problems(together) == ()
    assert leftovers(together) == []


@pytest.mark.slow
def test_sealing_while_another_process_extracts_changes_no_byte(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    command = _command("extract", request)
    alone, together = tmp_path / "alone", tmp_path / "together"
    run_together([command.arguments(alone)], alone, lambda: True)
    seal = ["run", "verify", "--seal", str(together / "run")]
    commands = [command.arguments(together), seal, seal]
    assert run_together(commands, together, lambda: any(together.glob("run/commits/*.json"))) == []
    assert command.results(together) == command.results(alone)
    assert command.problems(together) == ()
    assert leftovers(together) == []


def mount(*arguments: str) -> None:
    completed = subprocess.run(["mount", *arguments], capture_output=True, encoding="utf-8", check=False)
    if completed.returncode != 0:
        pytest.skip(f"cannot mount here: {completed.stderr.strip()}")


@pytest.fixture(scope="module")
def disk(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A real file system, mounted read-only, with a whole run and one without columns on it."""
    folder = tmp_path_factory.mktemp("disk")
    if shutil.which("mount") is None:
        pytest.skip("there is no mount here")
    mount("-t", "tmpfs", "-o", "size=50m", "none", str(folder))
    try:
        shutil.copytree(little_runs / "run", folder / "run")
        shutil.copytree(
            little_runs / "run", folder / "bare", ignore=shutil.ignore_patterns("columns.zarr", "sealed")
        )
        mount("-o", "remount,ro", str(folder))
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_run_on_a_read_only_disk_is_read_and_verified(disk: Path, little_runs: Path) -> None:
    assert verify_run(disk / "run", deep=True).ok
    assert readings(disk / "run") == readings(little_runs / "run")
    assert CliRunner().invoke(app, ["run", "show", str(disk / "run")]).exit_code == 0


@pytest.mark.parametrize(
    "command",
    [
        "extract --model expert --items 2 --suite {suite} --out {}/new",
        "run verify {}/bare --seal",
        "train {}/run --permutations 7",
    ],
    ids=lambda command: command.split(" -")[0].split(" {")[0],
)
def test_whatever_writes_there_says_that_the_disk_is_read_only(
    disk: Path, command: str, small_suite: Suite
) -> None:
    answer = CliRunner().invoke(app, command.format(disk, suite=small_suite.folder).split())
    assert answer.exit_code == 3, answer.output
    assert "is read-only" in " ".join(answer.output.split())
    assert "Traceback" not in answer.output
    assert {path.name for path in disk.iterdir()} == {"run", "bare"}
