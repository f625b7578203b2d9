"""Bundles: results that are stored with a run, found complete or not at all."""

from collections import Counter
from pathlib import Path

import pytest

from probe_kit.errors import RunDamagedError
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.results import HEAD, Head, find_bundle, is_complete, read_bundle, write_bundle
from probe_kit.runs.store import locate

KEY = "0123456789ab"
HOME = f"{DIAGNOSES}/{KEY}"


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A folder with one bundle of one file."""
    files = {"diagnosis.json": b'{"frames": 6}'}
    write_bundle(locate(tmp_path), DIAGNOSES, KEY, {"settings": {"format": 1}}, files, {"created": "now"})
    return tmp_path


def test_head_times_and_run_are_read_once(stored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads, read = Counter[str](), Folder.read

    def counted(folder: Folder, key: str, *part: object, **more: object) -> bytes:
        reads[key.rpartition("/")[2]] += 1
        return read(folder, key, *part, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(Folder, "read", counted)
    bundle = find_bundle(locate(stored), DIAGNOSES, KEY)
    assert bundle is not None
    assert bundle.times == {"created": "now"}
    assert reads == {HEAD: 1, "times.json": 1, "run.json": 1}


def test_a_bundle_that_lost_a_file_is_made_again(stored: Path) -> None:
    (stored / HOME / "diagnosis.json").unlink()
    assert find_bundle(locate(stored), DIAGNOSES, KEY) is None
    assert not is_complete(locate(stored), DIAGNOSES, KEY)
    assert find_bundle(locate(stored), DIAGNOSES, "ba9876543210") is None


def test_a_bundle_of_another_run_is_refused_by_name(stored: Path) -> None:
    location = locate(stored)
    head = Head.read(location, f"{HOME}/{HEAD}", "", key=KEY)
    other = Head.model_validate({**head.content, "run": "f" * 64})
    location.write(f"{HOME}/{HEAD}", other.to_bytes())
    for read in (find_bundle, read_bundle):
        with pytest.raises(RunDamagedError, match=f"is the head of run {'f' * 64}; here belongs that of run None"):
            read(location, DIAGNOSES, KEY)


def test_a_file_is_read_by_its_format_and_its_reader(stored: Path) -> None:
    bundle = read_bundle(locate(stored), DIAGNOSES, KEY)

    def refuse(values: object) -> None:
        raise ValueError(values)

    assert bundle.read_as("diagnosis.json", dict, 1) == {"frames": 6}
    with pytest.raises(RunDamagedError, match=r"has other fields: another version of probe_kit made it"):
        bundle.read_as("diagnosis.json", refuse, 1)
    with pytest.raises(RunDamagedError, match="has format 1; this version of probe_kit reads format 2"):
        bundle.read_as("diagnosis.json", dict, 2)
