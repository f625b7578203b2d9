"""Writing of a run: alone, by two at once, killed, on a full disk, and for others of a group to read."""

import itertools
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import zarr
from typer.testing import CliRunner

from probe_kit._system.drafts import full_disk_in_words
from probe_kit.cli import app
from probe_kit.errors import DiskSpaceError, RunDamagedError
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs import writer as writers
from probe_kit.runs.commits import commit_key
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Plan
from probe_kit.runs.results import Pieces
from probe_kit.runs.store import locate
from probe_kit.runs.writer import EpisodeRecord, RunWriter
from probe_kit.suite import Suite, build_suite
from tests.runs.contents import hashes
from tests.runs.killing import extract, plan_for
from tests.support.little_run import (
    episode,
    intervene_on_little_run,
    little_plan,
    little_writer,
    probe_little_run,
    write_little_run,
)
from tests.support.plans import make_plan

STREAM = StoredStream("backbone", 2, 8, None, 300, ("mean", "last"))
SETTINGS = {"captured_calls": 1, "tokens": "all", "codec": "zstd", "model": "synthetic"}


@pytest.fixture
def writer(small_suite: Suite, tmp_path: Path) -> RunWriter:
    return RunWriter(locate(tmp_path / "run"), make_plan(small_suite, [STREAM], 0, 1, True), SETTINGS)


def rollout(writer: RunWriter, number: int, language: int) -> EpisodeRecord:
    """Ones on the first `language` tokens, padding after them."""
    buffers = EpisodeBuffers([STREAM], 1, True, pinned=False)
    buffers.pooled["backbone"][:] = 1
    buffers.tokens["backbone"][..., :language, :] = 0x3F80
    spans = [("language", 0, language), ("padding", language, 300)]
    buffers.roles.append({"backbone": spans if language else spans[1:]})
    steps = range(len(buffers.roles))
    return buffers.record(writer.plan.episodes[number], {"outcome": "oob"}, control_steps=steps)


def test_a_stored_stream_gives_back_all_that_the_model_declared() -> None:
    declared = Stream("expert", 3, 8, 10, "action", "the expert", ("residual", "mlp"), probed=False, sums=False)
    stored = StoredStream.of(declared, 5, ("mean",))
    assert stored.stream == declared


@pytest.mark.slow
def test_a_block_of_padding_and_an_empty_row_are_stored_and_not_merely_missing(writer: RunWriter) -> None:
    full, buffers = rollout(writer, 0, 20), EpisodeBuffers([STREAM], 1, True, pinned=False)
    buffers.roles += full.roles
    writer.write(full)
    writer.write(buffers.record(writer.plan.episodes[1], {"outcome": "oob"}, control_steps=[0]))
    seal(writer.location)
    run = open_run(writer.location, allow_partial=True)
    column = run.column(Site("backbone", 1))
    assert (column[0] == 1).all()
    assert np.isnan(column[1]).all()
    np.testing.assert_array_equal(run.rows("backbone", "tokens").read(0, (0, 1, slice(256, 384))), 0)
    assert verify_run(writer.location, deep=True).ok


def test_only_blocks_of_a_role_are_read(writer: RunWriter) -> None:
    for number, language in enumerate((20, 140)):
        writer.write(rollout(writer, number, language))
    run = open_run(writer.location, allow_partial=True)
    blocks = list(run.iter_token_blocks(Site("backbone", 0), "language"))
    assert [block.start for block in blocks] == [0, 128]
    np.testing.assert_array_equal(sum(block.mask.sum(axis=1) for block in blocks), [20, 140])
    np.testing.assert_allclose(
        run.gram(Site("backbone", 0)), 8 * np.array([[1, 20 / 2800**0.5], [20 / 2800**0.5, 1]])
    )


def test_a_second_commit_of_the_same_episode_changes_nothing(writer: RunWriter) -> None:
    writer.write(rollout(writer, 0, 20))
    commit = writer.location.read("commits/00000000.json")
    writer.write(rollout(writer, 0, 20))
    assert writer.location.read("commits/00000000.json") == commit
    assert verify_run(writer.location, deep=True).ok


ARRAYS = 4
"""That are opened one after the other for an episode: pooled rows and tokens of two streams."""


@pytest.fixture
def plan(small_suite: Suite) -> Plan:
    return little_plan(small_suite.select(["color"]), episodes=2)


@pytest.fixture
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "bucket":
        return f"{request.getfixturevalue('bucket')}/run"
    return str(tmp_path / "run")


def rounded_otherwise(record: EpisodeRecord) -> EpisodeRecord:
    """The same episode as a batch of another size, or another processor, computes it."""
    arrays = {kind: dict(by_stream) for kind, by_stream in record.arrays.items()}
    arrays["pooled"] = {name: np.nextafter(rows, np.float32(9)) for name, rows in arrays["pooled"].items()}
    arrays["tokens"] = {name: np.where(rows > 0, rows - 1, rows) for name, rows in arrays["tokens"].items()}
    return replace(record, arrays=arrays, outcome={**record.outcome, "cube_x": record.outcome["cube_x"] / 2})


def interrupt(number: int, act: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """`act` once, before array `number` of the next episode is written, or after all of them before its commit."""
    counted, open_array, write_commit = itertools.count(), zarr.open_array, writers.write_commit

    def open_later(*arguments: Any, **options: Any) -> Any:
        if next(counted) == number:
            act()
        return open_array(*arguments, **options)

    def commit_later(*arguments: Any) -> bool:
        if number == ARRAYS and next(counted) == number:
            act()
        return write_commit(*arguments)

    monkeypatch.setattr(zarr, "open_array", open_later)
    monkeypatch.setattr(writers, "write_commit", commit_later)


@pytest.mark.parametrize("where", ["folder", pytest.param("bucket", marks=pytest.mark.slow)], indirect=True)
@pytest.mark.parametrize("number", range(ARRAYS + 1))
def test_an_episode_that_two_processes_write_at_once_is_that_of_one_of_them(
    number: int, where: str, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one plays and finishes it while the first is in the middle of its objects."""
    first, second = (little_writer(locate(where), plan) for _ in range(2))
    interrupt(number, lambda: second.write(rounded_otherwise(episode(plan, 0))), monkeypatch)
    first.write(episode(plan, 0))
    assert verify_run(where, deep=True).problems == ()
    opened = open_run(where, allow_partial=True)
    stored_outcome = json.loads(locate(where).read(commit_key(0)))["outcome"]
    possible = episode(plan, 0), rounded_otherwise(episode(plan, 0))
    (written,) = [record for record in possible if record.outcome == stored_outcome]
    np.testing.assert_array_equal(opened.rows("backbone")[0], written.arrays["pooled"]["backbone"])
    np.testing.assert_array_equal(opened.rows("expert", "tokens")[0], written.arrays["tokens"]["expert"])


def test_equal_numbers_of_two_processes_leave_the_first_commit(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = str(tmp_path / "run")
    first, second = (little_writer(locate(where), plan) for _ in range(2))
    interrupt(2, lambda: second.write(episode(plan, 0)), monkeypatch)
    stamps = []
    create = writers.write_commit

    def create_and_look(*arguments: Any) -> bool:
        written = create(*arguments)
        stamps.append((tmp_path / "run" / commit_key(0)).stat().st_ino)
        return written

    monkeypatch.setattr(writers, "write_commit", create_and_look)
    first.write(episode(plan, 0))
    assert len(stamps) == 2
    assert (tmp_path / "run" / commit_key(0)).stat().st_ino == stamps[0] == stamps[1]


@dataclass
class Measured:
    score: float
    null: float | None = None


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (("color/score",), ""),
        (("color/score", "color/null"), ""),
        (("color/accuracy",), "lacks score and holds accuracy"),
        (("color/null",), "lacks score"),
    ],
)
def test_pieces_of_another_version_are_refused_with_what_to_do(
    tmp_path: Path, names: tuple[str, ...], problem: str
) -> None:
    pieces = Pieces.of(locate(tmp_path), "probes", "0123456789ab", "stamp", "the same command then starts again")
    arrays = dict.fromkeys(names, np.arange(3))
    pieces.keep("site", arrays)
    if not problem:
        assert (pieces.read("site", Measured) or {}).keys() == arrays.keys()
        return
    with pytest.raises(RunDamagedError) as refusal:
        pieces.read("site", Measured)
    assert str(refusal.value).endswith(
        f"site.npz {problem}: another version of probe_kit began this. Remove probes/.0123456789ab.partial; "
        "the same command then starts again"
    )


@pytest.mark.slow
def test_work_goes_on_while_another_process_clears_the_same_unfinished_work(tmp_path: Path) -> None:
    """The one that is done first discards the pieces that both of them keep."""
    pieces = Pieces.of(locate(tmp_path), "probes", "0123456789ab", "stamp", "redo")
    over = Event()

    def clear() -> None:
        while not over.wait(0.001):
            pieces.discard()

    clearing = Thread(target=clear)
    clearing.start()
    try:
        for number in range(1500):
            pieces.keep(f"{number % 7}", {"values": np.arange(3)})
    finally:
        over.set()
        clearing.join()


ROOT = Path(__file__).parents[2]
KILLING = ("-m", "tests.runs.killing")


def start(run: Path, suite: Suite, point: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *KILLING, str(run), str(suite.folder), point], cwd=ROOT)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


@pytest.fixture(scope="module")
def reference_run(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run."""
    run = tmp_path_factory.mktemp("whole") / "run"
    extract(str(run), plan_for(suite.folder))
    return run


@pytest.mark.slow
@pytest.mark.parametrize("point", ["before-commit", "after-commit", "before-put", "after-put"])
def test_a_kill_at_any_point_of_an_episode_costs_at_most_that_episode(
    point: str, suite: Suite, reference_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert start(run, suite, point).wait() == -signal.SIGKILL
    committed = 3 if point == "after-commit" else 2
    assert len(open_run(run, allow_partial=True).episodes) == committed
    assert verify_run(run, deep=True).ok
    extract(str(run), plan_for(suite.folder))
    assert hashes(run) == hashes(reference_run)


def test_a_draft_that_its_writer_removes_while_leftovers_are_cleared_is_no_error(
    little_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that begins a run writes `run.json` before it can lock it."""
    run = Path(shutil.copytree(little_runs / "run", tmp_path / "run"))
    (run / "0123456789abcdef.tmp").write_bytes(b"run.json of a process that begins")
    listed_by_glob = Path.glob

    def removed_after_listing(folder: Path, pattern: str) -> Iterator[Path]:
        for path in list(listed_by_glob(folder, pattern)):
            path.unlink()
            yield path

    monkeypatch.setattr(Path, "glob", removed_after_listing)
    with locate(run).locked(lambda: None):
        pass
    assert not (run / "0123456789abcdef.tmp").exists()


@pytest.mark.slow
def test_leftovers_of_a_killed_process_are_cleared_by_the_next_owner(
    suite: Suite, reference_run: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(reference_run, tmp_path / "run"))
    aside = ("commits", "times", "failed", "certificates", "provenance", "sealed", "frames", "videos")
    data = ("data.zarr/backbone/pooled/c/0/x.tmp", "columns.zarr/x/zarr.json")
    for orphan in (*(f"{folder}/abc.tmp" for folder in aside), *data):
        (run / orphan).parent.mkdir(parents=True, exist_ok=True)
        (run / orphan).write_text("torn", encoding="utf-8")
    extract(str(run), plan_for(suite.folder))
    assert hashes(run) == hashes(reference_run)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 700 kB, about half of what the run needs."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=700k", "none", str(disk)],
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs here: {mounted.stderr.strip()}")
    yield disk
    # Lazily: a file that an error still holds open would make the disk busy.
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="mounts a tmpfs")
def test_a_full_disk_is_named_and_leaves_a_store_that_resumes(
    suite: Suite, reference_run: Path, small_disk: Path
) -> None:
    run = small_disk / "run"
    process = subprocess.run(
        [sys.executable, *KILLING, str(run), str(suite.folder)],
        cwd=ROOT,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert "is full" in process.stderr
    verification = verify_run(run, deep=True)
    assert verification.ok
    assert 0 < verification.committed < 12
    assert not list(run.rglob("*.tmp"))
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    extract(str(run), plan_for(suite.folder))
    assert hashes(run) == hashes(reference_run)


def test_other_errors_of_the_disk_keep_their_name(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), locate(tmp_path).explained_errors():
        raise PermissionError
    with pytest.raises(DiskSpaceError), locate(tmp_path).explained_errors():
        raise OSError(28, "No space left on device")


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 kB, less than any export needs."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k", "none", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True, encoding="utf-8", check=False)
    except FileNotFoundError:
        pytest.skip("there is no command `mount` here")
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.parametrize(
    "words",
    ["export --format h5"]
    + [
        pytest.param(words, marks=pytest.mark.slow)
        for words in ("export --format sae", "export --format safetensors", "export --format parquet", "copy")
    ],
)
def test_a_full_disk_is_named_and_nothing_is_left(little_runs: Path, full_disk: Path, words: str) -> None:
    name, *options = words.split()
    out = ["--out", str(full_disk / "out")] if name == "export" else [str(full_disk / "out")]
    command = ["run", name, str(little_runs / "run"), *options, *out]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == DiskSpaceError.exit_code, result.stderr
    assert "DiskSpaceError" in result.stderr
    assert "is full; nothing was written there" in " ".join(result.stderr.split())
    assert list(full_disk.iterdir()) == []
    subprocess.run(["mount", "-o", "remount,size=40m", str(full_disk)], check=True)
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 0, again.stderr


def test_an_error_of_a_part_of_a_draft_names_the_path_that_was_requested(tmp_path: Path) -> None:
    path = tmp_path / "study.zip"
    message = r"disk of \S*/study\.zip is full; nothing was written"
    with pytest.raises(DiskSpaceError, match=message), full_disk_in_words(path):
        raise DiskSpaceError(f"the disk of {tmp_path}/.study.zip.abc.tmp/pack/runs/a is full")


@pytest.fixture(
    params=[pytest.param(0o002, marks=pytest.mark.slow), 0o027, pytest.param(0o077, marks=pytest.mark.slow)],
    ids=oct,
)
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    mask: int = request.param
    before = os.umask(mask)
    yield mask
    os.umask(before)


@pytest.mark.slow
def test_files_and_folders_of_runs_copies_and_exports_follow_the_umask(
    small_suite: Suite, tmp_path: Path, umask: int
) -> None:
    little_run = write_little_run(tmp_path / "made" / "run", small_suite.select(["color"]), 0)
    probe_little_run(little_run)
    intervene_on_little_run(little_run)
    run = str(tmp_path / "made" / "run")
    for command in (
        ["run", "copy", run, str(tmp_path / "made" / "copy")],
        ["run", "export", run, "--format", "safetensors", "--out", str(tmp_path / "made" / "run.safetensors")],
        ["run", "export", run, "--format", "sae", "--out", str(tmp_path / "made" / "sae")],
        ["run", "export", run, "--format", "h5", "--out", str(tmp_path / "made" / "run.h5")],
        ["view", run, "--export", str(tmp_path / "made" / "page")],
    ):
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
    entries = sorted((tmp_path / "made").rglob("*"))
    assert len(entries) > 40
    wrong_modes = {
        str(entry.relative_to(tmp_path)): oct(stat.S_IMODE(entry.stat().st_mode))
        for entry in entries
        if stat.S_IMODE(entry.stat().st_mode) != (0o777 if entry.is_dir() else 0o666) & ~umask
    }
    assert not wrong_modes
