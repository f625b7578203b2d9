"""Folders and buckets: one contract, runs in a bucket, and servers that are slow, fail or forget."""

import itertools
import json
import re
import resource
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from datetime import timedelta
from functools import partial
from pathlib import Path
from threading import Thread, Timer
from typing import Any

import numpy as np
import pytest
import zarr
from typer.testing import CliRunner

from probe_kit._system.imports import install_command
from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import (
    DiskSpaceError,
    MissingExtraError,
    ProbeKitError,
    RunDamagedError,
    RunNotFoundError,
    SettingsMismatchError,
    StoreError,
    UsageError,
)
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs import store as buckets
from probe_kit.runs.array_lengths import with_length
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import COLUMNS
from probe_kit.runs.run import NotSealedWarning
from probe_kit.runs.store import Location, begin, check_exclusive, locate
from probe_kit.suite import Suite, build_suite
from probe_kit.train import load_results, train_probes
from tests.runs.contents import objects
from tests.support.little_run import episode, little_plan, little_writer
from tests.support.s3_server import BadServer, now_and_then

BEGINNING = {"plan.json": b"plan", "data.zarr/zarr.json": b"{}", "run.json": b"run"}


def test_an_object_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cut of the power then leaves a whole object or none. Tests else do not wait for the disk."""
    flushed: list[tuple[bytes, bool]] = []

    def note(handle: int) -> None:
        file = Path(f"/proc/self/fd/{handle}").resolve()
        flushed.append((file.read_bytes(), (tmp_path / "object").exists()))

    monkeypatch.setattr("os.fsync", note)
    folder = Folder(tmp_path)
    assert folder.create("object", b"first")
    assert flushed == [(b"first", False)]
    folder.write("object", b"second")
    assert flushed[1:] == [(b"second", True)]
    folder.write("object", b"made again at any time", durable=False)
    assert len(flushed) == 2


class LocationContract:
    """A kind of location passes all of it."""

    @pytest.fixture
    def location(self) -> Location:
        raise AssertionError("a subclass gives the location")

    def test_the_first_object_of_a_key_stays(self, location: Location) -> None:
        begin(location, BEGINNING, "run.json")
        assert location.create("commits/1.json", b"first")
        assert not location.create("commits/1.json", b"second")
        assert location.read("commits/1.json") == b"first"

    def test_writing_an_object_replaces_the_former_one(self, location: Location) -> None:
        location.write("probes/a/settings.json", b"one")
        location.write("probes/a/settings.json", b"another")
        assert location.read("probes/a/settings.json") == b"another"
        assert location.keys("probes") == ["probes/a/settings.json"]

    def test_reading_a_missing_object_says_that_it_is_missing(self, location: Location) -> None:
        assert not location.exists("run.json")
        assert location.keys("commits") == []
        assert location.read_all("commits", ".json") == {}
        for read in (location.read, location.open):
            with pytest.raises(FileNotFoundError):
                read("run.json")

    def test_objects_are_listed_with_their_sizes(self, location: Location) -> None:
        for key, content in {
            "c/2.json": b"22",
            "c/1.json": b"1",
            "c/1.tmp": b"",
            "c/below/3.json": b"333",
        }.items():
            location.write(key, content)
        assert location.read_all("c", ".json") == {"1.json": b"1", "2.json": b"22"}
        assert location.keys("c") == ["c/1.json", "c/1.tmp", "c/2.json", "c/below/3.json"]
        assert location.sizes("c", ["2.json", "below/3.json", "4.json"]) == {"2.json": 2, "below/3.json": 3}

    def test_an_object_can_be_read_here_and_there(self, location: Location) -> None:
        location.write("digits", b"0123456789")
        with location.open("digits") as file:
            file.seek(-3, 2)
            assert file.read(2) == b"78"
            file.seek(1)
            assert file.read() == b"123456789"

    def test_removing_takes_a_folder_and_nothing_else(self, location: Location) -> None:
        location.write("failed/1.json", b"1")
        location.write("failed-not/1.json", b"1")
        location.remove("failed")
        location.remove("failed")
        assert location.keys("failed") == []
        assert location.exists("failed-not/1.json")

    def test_a_run_begins_with_all_its_objects_once(self, location: Location) -> None:
        begin(location, BEGINNING, "run.json")
        begin(location, {**BEGINNING, "run.json": b"of another process, which was second"}, "run.json")
        assert {key: location.read(key) for key in location.keys("")} == BEGINNING

    def test_a_run_begins_though_another_process_has_set_the_length_of_its_arrays(
        self, location: Location
    ) -> None:
        array = {"shape": [1_000_000, 2], "attributes": {}, "node_type": "array"}
        begun = {"data.zarr/x/zarr.json": json.dumps(array, indent=2).encode(), "run.json": b"run"}
        longer = with_length(begun["data.zarr/x/zarr.json"], 12)
        location.write("data.zarr/x/zarr.json", longer)
        begin(location, begun, "run.json")
        assert {key: location.read(key) for key in location.keys("")} == {**begun, "data.zarr/x/zarr.json": longer}

    def test_a_location_that_holds_something_else_is_left_alone(self, location: Location) -> None:
        location.write("thesis.txt", b"do not touch")
        with pytest.raises(SettingsMismatchError, match="choose another --out"):
            begin(location, BEGINNING, "run.json")
        assert location.keys("") == ["thesis.txt"]

    def test_a_group_is_built_as_if_nothing_of_a_killed_process_lay_there(self, location: Location) -> None:
        begin(location, BEGINNING, "run.json")
        for stamp in ("a", "b"):
            store = ArrayStore(location, "columns.zarr/x", {})
            group = zarr.open_group(store, mode="w", zarr_format=3, attributes={"stamp": stamp})
            group.create_array("y", shape=(2,), dtype="f4")[:] = ord(stamp)
            assert {key for key in store.sums if "y" in key} == {"y/zarr.json", "y/c/0"}
        group = zarr.open_group(ArrayStore(location, "columns.zarr/x", store.sums, read_only=True), mode="r")
        assert (group.attrs["stamp"], group["y"][1]) == ("b", ord("b"))
        assert set(location.keys("columns.zarr")) == {f"columns.zarr/x/{key}" for key in store.sums}

    def test_arrays_are_stored_and_a_missing_chunk_is_an_error(self, location: Location) -> None:
        store = ArrayStore(location, "data.zarr", {})
        array = zarr.create_array(store, name="x", shape=(4, 3), chunks=(1, 3), dtype="f4")
        array[:2] = np.ones((2, 3))
        reading = zarr.open_array(
            ArrayStore(location, "data.zarr", store.written, read_only=True),
            path="x",
            mode="r",
            config={"read_missing_chunks": False},
        )
        np.testing.assert_array_equal(reading[1], 1)
        with pytest.raises(zarr.errors.ChunkNotFoundError):
            reading[2]

    def test_another_process_finds_it_by_its_address(
        self, location: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        location.write("x", b"1")
        address = location.address
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        assert locate(address).read("x") == b"1"
        assert locate(address).name == location.name == "run"


class TestFolder(LocationContract):
    @pytest.fixture
    def location(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Location:
        monkeypatch.chdir(tmp_path)
        return locate("runs/run")

    def test_free_space_is_that_of_the_disk_where_it_will_lie(self, location: Location) -> None:
        assert location.free_bytes() > 0


class TestBucket(LocationContract):
    @pytest.fixture
    def location(self, bucket: str) -> Location:
        return locate(f"{bucket}/prefix/run/")

    def test_the_beginning_of_another_run_is_refused(self, location: Location) -> None:
        location.write("plan.json", b"another plan")
        with pytest.raises(SettingsMismatchError, match=r"another plan\.json"):
            begin(location, BEGINNING, "run.json")
        assert not location.exists("run.json")

    def test_a_bucket_that_does_not_exist_is_named_in_words(self, location: Location) -> None:  # noqa: ARG002
        with pytest.raises(
            StoreError,
            match=r"s3://no-such-bucket/run cannot be used: there is no bucket 'no-such-bucket'\. Create it",
        ):
            locate("s3://no-such-bucket/run").create("x", b"")

    def test_it_has_neither_a_folder_nor_a_full_disk(self, location: Location) -> None:
        assert location.free_bytes() is None
        assert location.path_of_export("run.h5") == Path("run.h5")
        with pytest.raises(UsageError, match="object store"):
            _ = location.path


class TestOtherStores(LocationContract):
    """Stores that say of an object that is gone that it is not found, as those of Google and Azure do."""

    @pytest.fixture(params=["gs", "az"])
    def location(
        self, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> Location:
        stores = pytest.importorskip("obstore.store", reason="obstore is not installed (extra `remote`)")
        (tmp_path / "objects").mkdir()
        stored = stores.MemoryStore() if request.param == "gs" else stores.LocalStore(tmp_path / "objects")
        monkeypatch.setattr(buckets.Bucket, "_objects", stored)
        return locate(f"{request.param}://bucket/prefix/run")

    def test_removing_a_missing_object_is_no_error(self, location: Location) -> None:
        for key in ("c/1.json", "c/3.json"):
            location.write(key, b"")
        location._delete(["c/1.json", "c/2.json", "c/3.json"])
        location.delete("c/1.json")
        assert location.keys("") == []


def test_an_invalid_address_of_a_run_is_refused_with_the_reason() -> None:
    for where, why in {
        "https://host/run": "s3://",
        "s3://bucket": "names no run",
        "s3:///run": "names no run",
        "s3://bucket/": "names no run",
        "s3://bucket//run": "two slashes in a row",
        "s3://bucket/a//run": "two slashes in a row",
        "s3://bucket/run//": "two slashes in a row",
        "s3://bucket/a/../run": r"has the part '\.\.'",
        "s3://bucket/./run": r"has the part '\.'",
        "s3://bucket/a\nb": r"has the part 'a\\nb'",
        "s3://somebody@bucket/run": "'somebody@bucket' is no name of a bucket",
        "s3://bucket:80/run": "'bucket:80' is no name of a bucket",
    }.items():
        with pytest.raises(UsageError, match=why):
            locate(where)
    with pytest.raises(UsageError, match="give it as text"):
        locate(Path("s3://bucket/run"))
    assert isinstance(locate(Path("s3-results")), Folder)


TYPED = (
    "run",
    "run#2",
    "run?2",
    "run?x=2#y",
    "run%202",
    "run 2",
    "run%2F2",
    "run+2",
    "rún",
    "run;2",
    "run@2",
    "~run",
)


@pytest.mark.parametrize("scheme", ["s3", "gs", "az"])
def test_an_address_is_a_place_as_it_is_typed(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "account")
    for typed in TYPED:
        location = locate(f"{scheme}://bucket/a/{typed}")
        assert location._objects.prefix == f"a/{typed}"
        assert (str(location), location.name) == (location.address, typed)
        assert str(locate(f"{location}/")) == location.address == f"{scheme}://bucket/a/{typed}"


def test_two_addresses_are_two_runs(bucket: str) -> None:
    for typed in TYPED:
        locate(f"{bucket}/{typed}").write("run.json", typed.encode())
    assert [locate(f"{bucket}/{typed}").read("run.json").decode() for typed in TYPED] == list(TYPED)
    assert [locate(f"{bucket}/{typed}").keys("") for typed in TYPED] == [["run.json"]] * len(TYPED)


def test_a_key_that_leads_out_of_a_run_is_read_nowhere(tmp_path: Path, bucket: str) -> None:
    for location in (locate(tmp_path / "run"), locate(f"{bucket}/run")):
        for key in ("../other", "/etc/hostname", "a//b", "a/./b", "a\nb", ""):
            assert not location.exists(key)
            with pytest.raises(FileNotFoundError):
                location.read(key)
            for change in (partial(location.write, key, b""), partial(location.delete, key)):
                with pytest.raises(RunDamagedError, match="leads out of its folder"):
                    change()


def test_without_obstore_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "obstore", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("remote"))):
        locate("s3://bucket/run")


def test_a_process_that_may_write_no_larger_file_has_a_full_disk(tmp_path: Path) -> None:
    """As under `ulimit -f`: the system then says EFBIG."""
    location, before = locate(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(DiskSpaceError, match=r"takes no file so large"), location.explained_errors():
            location.write("frames/a.webp", bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert location.keys("") == []


ROOT = Path(__file__).parents[2]
KILLING = ("-m", "tests.runs.killing")
SHORT = SceneSpec(max_steps=2)
SITE = Site("expert", 1, iteration=3)


def start(run: str | Path, suite: Suite, *point: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *KILLING, str(run), str(suite.folder), *point], cwd=ROOT)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


@pytest.fixture(scope="module")
def reference_run(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Synthetic episodes in a folder."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert start(run, suite).wait() == 0
    return run


def copy_to(bucket: str, source: Location) -> Run:
    """The run without its probes in a bucket, sealed there."""
    target = locate(f"{bucket}/run")
    for key in source.keys(""):
        if not key.startswith((COLUMNS, "probes", "interventions")):
            target.write(key, source.read(key))
    assert seal(target)
    return open_run(target)


@pytest.fixture
def copied(recorded_run: Run, bucket: str) -> Run:
    """A real run, with all tokens, in a bucket."""
    return copy_to(bucket, recorded_run.location)


@pytest.mark.slow
def test_a_run_in_a_bucket_has_the_same_bytes_as_one_in_a_folder(
    suite: Suite, tmp_path: Path, bucket: str
) -> None:
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, items=2, scene=SHORT, tokens="all", env_workers=0)
    local = extract_run(settings, tmp_path / "run")
    remote = extract_run(settings, f"{bucket}/prefix/run")
    assert (remote.stamp, remote.settings_sha256, remote.sealed) == (local.stamp, local.settings_sha256, True)
    in_bucket, in_local_folder = (
        {key: content for key, content in objects(location).items() if not key.startswith("times/")}
        for location in (f"{bucket}/prefix/run", tmp_path / "run")
    )
    assert in_bucket == in_local_folder


@pytest.mark.slow
def test_three_writers_at_once_give_the_same_store_in_a_bucket(
    suite: Suite, reference_run: Path, bucket: str
) -> None:
    run = f"{bucket}/run"
    writers = [start(run, suite) for _ in range(3)]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert objects(run) == objects(reference_run)


@pytest.mark.slow
def test_worker_processes_share_a_bucket(suite: Suite, tmp_path: Path, bucket: str) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, scene=SHORT, env_workers=0)
    alone = extract_run(settings, tmp_path / "run")
    together = extract_run(settings.changed(workers=2), f"{bucket}/run")
    assert together.stamp == alone.stamp


@pytest.mark.slow
def test_other_settings_are_refused_in_a_bucket_too(suite: Suite, bucket: str) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, items=2, scene=SHORT)
    extract_run(settings, f"{bucket}/run")
    with pytest.raises(SettingsMismatchError, match=r"seed: stored 0, asked 1"):
        extract_run(settings.changed(seed=1), f"{bucket}/run")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_store_that_ignores_conditions_is_refused_before_a_run_is_begun(
    suite: Suite, deaf_bucket: str, workers: int
) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, items=2, scene=SHORT, workers=workers)
    with pytest.raises(StoreError, match=r"ignores conditional puts.*Use another store, or a folder"):
        extract_run(settings, f"{deaf_bucket}/run")
    assert not locate(f"{deaf_bucket}/run").exists("run.json")


def test_a_run_is_not_continued_in_a_store_that_ignores_conditions(in_folder: Run, deaf_bucket: str) -> None:
    source, target = in_folder.location, locate(f"{deaf_bucket}/run")
    for key in source.keys(""):
        target.write(key, source.read(key))
    with pytest.raises(StoreError, match=r"created run\.json a second time"):
        check_exclusive(target, "run.json")
    check_exclusive(source, "run.json")


@pytest.mark.slow
def test_numbers_and_probes_of_a_bucket_are_those_of_a_folder(trainable_run: Run, bucket: str) -> None:
    copied = copy_to(bucket, trainable_run.location)
    assert copied.sealed
    np.testing.assert_array_equal(copied.column(SITE), trainable_run.column(SITE))
    for ours, theirs in zip(copied.tokens(SITE), trainable_run.tokens(SITE), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert copied.xarray().sizes == trainable_run.xarray().sizes
    options = {"categories": ["color"], "views": ["mean"], "permutations": 0}
    results = train_probes(copied, **options)
    expected = train_probes(trainable_run, **options)
    again = load_results(open_run(copied.location))
    assert again.key == results.key == expected.key
    np.testing.assert_array_equal(again.scores["accuracy"], expected.scores["accuracy"])
    direction_key = next(iter(expected.directions))
    np.testing.assert_array_equal(
        again.directions[direction_key].weights, expected.directions[direction_key].weights
    )


def flip_a_bit(location: Location, key: str) -> None:
    content = bytearray(location.read(key))
    content[len(content) // 2] ^= 1
    location.write(key, bytes(content))


@pytest.mark.slow
def test_damage_in_a_bucket_is_found_and_never_read_as_numbers(little_runs: Path, bucket: str) -> None:
    copied = copy_to(bucket, locate(little_runs / "run"))
    shard = next(key for key in copied.location.keys("data.zarr/expert/tokens") if "/c/7/" in key)
    flip_a_bit(copied.location, shard)
    assert verify_run(copied.location).ok
    (problem,) = verify_run(copied.location, deep=True).problems
    assert shard in problem
    with pytest.raises(RunDamagedError):
        copied.rows("expert", "tokens")[7]
    copied.location.remove(shard.rpartition("/")[0])
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(copied.location)


@pytest.mark.slow
def test_the_commands_take_urls(copied: Run, tmp_path: Path, bucket: str) -> None:
    def probe_kit(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "probe_kit", *arguments]
        return subprocess.run(command, capture_output=True, encoding="utf-8", check=False, cwd=tmp_path)

    run = str(copied.location)
    answer = probe_kit("extract", "--model", "expert", "--categories", "color", "--items", "2", "--max-steps", "2",
                     "--out", f"{bucket}/scripted")  # fmt: skip
    assert (answer.returncode, answer.stdout.strip()) == (0, f"{bucket}/scripted"), answer.stderr
    assert f"probe-kit retention {bucket}/scripted" in answer.stderr
    verified = probe_kit("run", "verify", run, "--deep")
    assert (verified.returncode, "sealed; every byte checked" in verified.stdout) == (0, True), verified.stderr
    assert "nothing to seal" in probe_kit("run", "verify", run, "--seal").stderr
    assert probe_kit("run", "export", run, "--format", "safetensors").returncode == 0
    assert {path.name for path in tmp_path.iterdir()} >= {"run.safetensors", "run.safetensors.sha256"}
    table = probe_kit("retention", f"{bucket}/scripted", "--format", "json")
    assert (table.returncode, f"{bucket}/scripted" in table.stdout) == (0, True), table.stderr


def test_a_url_without_a_run_is_named(bucket: str) -> None:
    with pytest.raises(RunNotFoundError, match=f"{bucket}/nothing is not a run"):
        open_run(f"{bucket}/nothing")


@pytest.mark.usefixtures("bucket")
def test_a_bucket_that_is_not_there_is_named() -> None:
    with pytest.raises(StoreError, match="there is no bucket 'no-such-bucket-anywhere'"):
        open_run("s3://no-such-bucket-anywhere/run")
    with pytest.raises(StoreError, match="there is no bucket 'no-such-bucket-anywhere'"):
        locate("s3://no-such-bucket-anywhere/run").create("run.json", b"{}")


def test_missing_credentials_are_named_and_not_the_address_that_was_asked_for_them() -> None:
    from obstore.exceptions import GenericError

    server_message = "Error performing PUT http://169.254.169.254/latest/api/token in 23ms - Server returned 403"
    with (
        pytest.raises(StoreError, match=r"no credentials.*AWS_ACCESS_KEY_ID") as caught,
        locate("s3://b/r").explained_errors(),
    ):
        raise GenericError(server_message)
    assert "169.254" not in str(caught.value)


EPISODES = 2
PROBED_SITE = Site("expert", 0, iteration=1)
TRANSIENT = ("busy", "torn", "unanswered", "cut", "slow")


def write(run: Path | str, server_suite: Suite) -> Run:
    """What an extraction does with its episodes."""
    plan = little_plan(server_suite, episodes=EPISODES)
    writer = little_writer(locate(run), plan)
    with writer.claim():
        for number in writer.remaining():
            writer.write(episode(plan, number))
        seal(run)
    return open_run(run)


@pytest.fixture(scope="module")
def server_suite(small_suite: Suite) -> Suite:
    return small_suite.select(["color"])


@pytest.fixture(scope="module")
def in_folder(server_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return write(tmp_path_factory.mktemp("whole") / "run", server_suite)


@pytest.fixture(scope="module")
def whole_run(in_folder: Run) -> dict[str, bytes]:
    """The objects of a run in a folder."""
    return objects(in_folder.path)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Retries without the minute of pauses; a late answer is no failure."""
    monkeypatch.setattr(buckets, "PATIENCE", timedelta(seconds=1))
    monkeypatch.setattr(buckets, "_QUICK", timedelta(seconds=1))
    if "silent" in request.node.name:
        monkeypatch.setenv("AWS_TIMEOUT", "3s")


def every(count: int, ills: Sequence[str], method: str = "") -> Callable[[str, str], str | None]:
    """Every so many requests of this method have one of these, in turn; a repeated one has not."""
    request_count, turns = itertools.count(1), itertools.cycle(ills)
    return lambda kind, _path: (
        next(turns) if kind.startswith(method) and next(request_count) % count == 0 else None
    )


@pytest.mark.slow
def test_what_a_server_does_now_and_then_changes_no_byte(
    server_suite: Suite, whole_run: dict[str, bytes], bad_server: BadServer
) -> None:
    open_nothing(bad_server)
    bad_server.day.ail = every(13, TRANSIENT)
    write(f"{bad_server.url}/run", server_suite)
    assert set(bad_server.day.seen) == set(TRANSIENT)
    bad_server.day.ail = lambda *_: None
    assert objects(f"{bad_server.url}/run") == whole_run


def open_nothing(server: BadServer) -> None:
    """A first request that is answered."""
    assert not locate(f"{server.url}/run").exists("run.json")


@pytest.mark.slow
def test_requests_that_nobody_answers_are_repeated(
    server_suite: Suite, whole_run: dict[str, bytes], bad_server: BadServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_TIMEOUT", "500ms")
    run = f"{bad_server.url}/run"
    bad_server.day.ail = every(7, ["silent"], "PUT")
    write(run, server_suite)
    bad_server.day.ail = lambda *_: None
    assert bad_server.day.seen["silent"] > 0
    assert objects(run) == whole_run


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    "ill", ["busy", *(pytest.param(ill, marks=pytest.mark.slow) for ill in ("torn", "unanswered", "silent"))]
)
def test_a_server_that_stays_bad_is_one_error_and_the_same_command_continues(
    ill: str, server_suite: Suite, whole_run: dict[str, bytes], bad_server: BadServer
) -> None:
    run = f"{bad_server.url}/run"
    committed = [0]

    def ail(method: str, path: str) -> str | None:
        committed[0] += method == "PUT" and "/commits/" in path
        return ill if committed[0] >= 2 else None

    bad_server.day.ail = ail
    with pytest.raises(StoreError, match=r"cannot be used.*the same command continues") as caught:
        write(run, server_suite)
    assert caught.value.exit_code == 3
    bad_server.day.ail = lambda *_: None
    assert verify_run(run, deep=True).ok
    assert verify_run(run).committed == (2 if ill == "unanswered" else 1)
    write(run, server_suite)
    assert objects(run) == whole_run


@pytest.mark.slow
def test_a_server_that_dies_and_returns_is_waited_for(
    server_suite: Suite, whole_run: dict[str, bytes], bad_server: BadServer
) -> None:
    run = f"{bad_server.url}/run"
    plan = little_plan(server_suite, episodes=EPISODES)
    writer = little_writer(locate(run), plan)
    for number in writer.remaining():
        bad_server.stop()
        Timer(0.2, bad_server.start).start()
        writer.write(episode(plan, number))
    seal(run)
    assert objects(run) == whole_run


@pytest.fixture
def remote_run(little_runs: Path, bad_server: BadServer) -> Run:
    """A run with probes on a server that was well when it was made."""
    source, target = locate(little_runs / "run"), locate(f"{bad_server.url}/run")
    for key in source.keys(""):
        target.write(key, source.read(key))
    return open_run(target)


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("ill", ["busy", pytest.param("silent", marks=pytest.mark.slow)])
def test_reading_from_a_server_that_fails_says_what_to_do(
    ill: str, remote_run: Run, bad_server: BadServer
) -> None:
    asks: tuple[Callable[[], object], ...] = (
        partial(remote_run.column, PROBED_SITE, "mean"),
        partial(remote_run.rows("expert", "tokens").__getitem__, 1),
        lambda: remote_run.xarray()["expert"].values,
        partial(load_results, remote_run),
        partial(verify_run, remote_run.location, deep=True),
        partial(open_run, str(remote_run.location)),
    )
    bad_server.day.ail = lambda *_: ill
    for ask in asks:
        with pytest.raises(StoreError, match="cannot be used"):
            ask()


@pytest.mark.slow
def test_reading_from_a_server_on_a_bad_day_gives_the_same_numbers(remote_run: Run, bad_server: BadServer) -> None:
    column, tokens = remote_run.column(PROBED_SITE, "mean"), remote_run.rows("expert", "tokens")[1]
    scores = load_results(remote_run).scores
    bad_server.day.ail = now_and_then(("busy", "torn", "unanswered", "cut"), 0.3, seed=1)
    again = open_run(remote_run.location)
    np.testing.assert_array_equal(again.column(PROBED_SITE, "mean"), column)
    np.testing.assert_array_equal(again.rows("expert", "tokens")[1], tokens)
    assert load_results(again).scores.equals(scores)
    assert verify_run(remote_run.location, deep=True).ok
    assert bad_server.day.seen.total() > 5


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
def test_a_store_that_never_answered_is_given_up_soon(bad_server: BadServer) -> None:
    bad_server.stop()
    try:
        result = CliRunner().invoke(app, ["run", "show", f"{bad_server.url}/run"])
    finally:
        bad_server.start()
    assert isinstance(result.exception, StoreError) or result.exit_code == 3, result.output


@pytest.mark.parametrize("where", ["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def test_who_reads_while_another_writes_sees_whole_episodes_only(
    where: str, server_suite: Suite, in_folder: Run, whole_run: dict[str, bytes], tmp_path: Path, request: Any
) -> None:
    run = f"{request.getfixturevalue('bucket')}/run" if where == "bucket" else str(tmp_path / "run")
    expected = in_folder.rows("expert", "tokens")
    little_writer(locate(run), little_plan(server_suite, episodes=EPISODES))
    writing = Thread(target=write, args=(run, server_suite), daemon=True)
    writing.start()
    lengths, alive = set[int](), True
    while alive:
        writing.join(0.02)  # the writer has a core too
        alive = writing.is_alive()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotSealedWarning)
            opened = open_run(run, allow_partial=True)
            lengths.add(len(opened.episodes))
            if len(opened.episodes):
                assert opened.column(PROBED_SITE, "mean").shape == (len(opened.episodes), 4)
        for row, number in enumerate(opened.episodes["episode"]):
            np.testing.assert_array_equal(opened.rows("expert", "tokens")[row], expected[number])
        assert verify_run(run, deep=True).problems == ()
    assert EPISODES in lengths
    assert objects(run) == whole_run


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_a_third_of_all_requests_failing_changes_no_byte(
    seed: int,
    server_suite: Suite,
    whole_run: dict[str, bytes],
    bad_server: BadServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However often the command must be given."""
    monkeypatch.setenv("AWS_TIMEOUT", "1s")
    run = f"{bad_server.url}/run"
    open_nothing(bad_server)
    bad_server.day.ail = now_and_then((*TRANSIENT, "silent"), 0.33, seed)
    errors = []
    for _ in range(100):
        try:
            write(run, server_suite)
            break
        except ProbeKitError as error:
            errors.append(str(error))
    bad_server.day.ail = lambda *_: None
    print(f"seed {seed}: {dict(bad_server.day.seen)}, {len(errors)} errors")
    assert objects(run) == whole_run
