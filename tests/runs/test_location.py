"""What every location of a run keeps, whether a folder or an object store."""

import re
import resource
from pathlib import Path

import numpy as np
import pytest
import zarr

from probe_kit._system.imports import install_command
from probe_kit.errors import DiskSpaceError, MissingExtraError, SettingsMismatchError, StoreError, UsageError
from probe_kit.runs.checking import BlankStore
from probe_kit.runs.folder import Folder
from probe_kit.runs.store import Location, locate

BEGINNING = {"plan.json": b"plan", "data.zarr/zarr.json": b"{}", "run.json": b"run"}


class LocationContract:
    """A kind of location passes all of it."""

    @pytest.fixture
    def location(self) -> Location:
        raise AssertionError("a subclass gives the location")

    def test_the_first_object_of_a_key_stays(self, location: Location) -> None:
        location.begin(BEGINNING, "run.json")
        assert location.create("commits/1.json", b"first")
        assert not location.create("commits/1.json", b"second")
        assert location.read("commits/1.json") == b"first"

    def test_writing_replaces(self, location: Location) -> None:
        location.write("probes/a/settings.json", b"one")
        location.write("probes/a/settings.json", b"another")
        assert location.read("probes/a/settings.json") == b"another"
        assert location.keys("probes") == ["probes/a/settings.json"]

    def test_what_is_not_there_is_said_to_be_missing(self, location: Location) -> None:
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
        location.begin(BEGINNING, "run.json")
        location.begin({**BEGINNING, "run.json": b"of another process, which was second"}, "run.json")
        assert {key: location.read(key) for key in location.keys("")} == BEGINNING

    def test_a_location_that_holds_something_else_is_left_alone(self, location: Location) -> None:
        location.write("thesis.txt", b"do not touch")
        with pytest.raises(SettingsMismatchError, match="choose another --out"):
            location.begin(BEGINNING, "run.json")
        assert location.keys("") == ["thesis.txt"]

    def test_a_group_is_built_as_if_nothing_of_a_killed_process_lay_there(self, location: Location) -> None:
        location.begin(BEGINNING, "run.json")
        for stamp in ("a", "b"):
            store = BlankStore(location.store("columns.zarr/x"))
            group = zarr.open_group(store, mode="w", zarr_format=3, attributes={"stamp": stamp})
            group.create_array("y", shape=(2,), dtype="f4")[:] = ord(stamp)
            assert {key for key in store.sums if "y" in key} == {"y/zarr.json", "y/c/0"}
        group = zarr.open_group(location.store("columns.zarr/x", read_only=True), mode="r")
        assert (group.attrs["stamp"], group["y"][1]) == ("b", ord("b"))
        assert set(location.keys("columns.zarr")) == {f"columns.zarr/x/{key}" for key in store.sums}

    def test_arrays_are_stored_and_a_missing_chunk_is_an_error(self, location: Location) -> None:
        array = zarr.create_array(location.store("data.zarr"), name="x", shape=(4, 3), chunks=(1, 3), dtype="f4")
        array[:2] = np.ones((2, 3))
        reading = zarr.open_array(
            location.store("data.zarr", read_only=True), path="x", mode="r", config={"read_missing_chunks": False}
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
            location.begin(BEGINNING, "run.json")
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


def test_what_is_no_location_is_refused_and_says_why() -> None:
    for where, why in {
        "https://host/run": "s3://",
        "s3://bucket": "names no run",
        "s3:///run": "names no run",
    }.items():
        with pytest.raises(UsageError, match=why):
            locate(where)
    with pytest.raises(UsageError, match="give it as text"):
        locate(Path("s3://bucket/run"))
    assert isinstance(locate(Path("s3-results")), Folder)


def test_without_obstore_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "obstore", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("remote"))):
        locate("s3://bucket/run")


def test_a_process_that_may_write_no_larger_file_has_a_full_disk(tmp_path: Path) -> None:
    """As under `ulimit -f`: the system then says EFBIG."""
    location, before = locate(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(DiskSpaceError, match=r"takes no file so large"), location.in_words():
            location.write("frames/a.webp", bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert location.keys("") == []
