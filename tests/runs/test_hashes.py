import errno
import json
import os
from hashlib import blake2b
from pathlib import Path

import pytest

from probe_kit.errors import DiskSpaceError, RunDamagedError
from probe_kit.runs.records import Sum, as_json, as_record, read_record
from probe_kit.runs.results import bundle_keys, read_bundle, write_bundle
from probe_kit.runs.root import read_root
from probe_kit.runs.store import locate

CONTENT = {"b": [1, 2.5, None], "a": "ä", "A": {"x": True}}
KEY = "0123456789ab"


def test_a_record_is_plain_json_that_begins_with_the_hash_of_the_rest() -> None:
    record = as_record(CONTENT)
    said = json.loads(record)
    assert said.pop("blake2b") == blake2b(as_json(CONTENT), digest_size=32).hexdigest()
    assert said == CONTENT
    assert read_record(record, "it", "do")["a"] == "ä"


def test_every_flipped_bit_of_a_record_is_found() -> None:
    record = as_record(CONTENT)
    for place in range(len(record)):
        for bit in range(8):
            changed = record[:place] + bytes([record[place] ^ 1 << bit]) + record[place + 1 :]
            with pytest.raises(RunDamagedError, match="it was changed"):
                read_record(changed, "it", "do")


@pytest.mark.parametrize("raw", [as_record(CONTENT)[:-1], as_record(CONTENT) + b"\n", b"", as_json(CONTENT)])
def test_a_record_of_another_length_or_without_hash_is_none(raw: bytes) -> None:
    with pytest.raises(RunDamagedError):
        read_record(raw, "it", "do")


def test_crc_blind_exchanges_have_other_sums() -> None:
    """What ends in its own checksum has a constant checksum; hashes are not deceived."""
    assert Sum.of(b"one" + b"crc1") != Sum.of(b"two" + b"crc2")
    assert "other bytes" in str(Sum.of(b"one").problem(b"two"))
    assert "3 were written" in str(Sum.of(b"one").problem(b"four"))


def test_a_changed_file_of_a_bundle_gets_another_name_and_the_head_decides(tmp_path: Path) -> None:
    """So that a kill between the two writes leaves what was there before."""
    where, folder = locate(tmp_path), tmp_path / "probes" / KEY
    write_bundle(where, "probes", KEY, {"settings": {"n": 1}}, {"a.json": b"first", "b.npz": b"kept"})
    assert sorted(path.name for path in folder.iterdir()) == ["a.json", "b.npz", "settings.json", "times.json"]
    head = (folder / "settings.json").read_bytes()
    write_bundle(where, "probes", KEY, {"settings": {"n": 2}}, {"a.json": b"second"})
    bundle = read_bundle(where, "probes", KEY)
    assert (bundle.read("a.json"), bundle.read("b.npz"), bundle.head) == (
        b"second",
        b"kept",
        {"settings": {"n": 2}},
    )
    assert len(list(folder.iterdir())) == 4
    (folder / "settings.json").write_bytes(head)
    with pytest.raises(RunDamagedError, match=r"a\.json is missing"):
        read_bundle(where, "probes", KEY).read("a.json")


def test_a_folder_that_is_being_filled_is_no_bundle_and_one_that_lost_its_head_is_damaged(tmp_path: Path) -> None:
    where = locate(tmp_path)
    where.write(f"probes/{KEY}/a.json", b"first")
    where.write(f"probes/.{KEY}.partial/site.npz", b"")
    assert bundle_keys(where, "probes") == []
    where.remove(f"probes/.{KEY}.partial")
    assert bundle_keys(where, "probes") == [KEY]
    with pytest.raises(RunDamagedError, match=r"settings\.json is missing"):
        read_bundle(where, "probes", KEY)


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (b'{"a": 1, "a": 2}', "names the key 'a' twice"),
        (b'{"a": {"b": 1, "c": 2, "b": 1}}', "names the key 'b' twice"),
        (b'\xef\xbb\xbf{"a": 1}', "byte order mark"),
        (b'{"a": NaN}', "not a finite number"),
        (b'{"a": -Infinity}', "not a finite number"),
        (b'{"a": 1e999}', "not a finite number"),
        (b'{"a": "\\ud800"}', "surrogate"),
        (b"[" * 99_999, "nests too deeply"),
        (b'{"a":' * 5_000 + b"1" + b"}" * 5_000, "nests too deeply"),
        (b"{}", "from byte"),
        (b"[]", "holds a list"),
        (b"\xff\xfe", "decode"),
        (b"", "Expecting value"),
    ],
)
def test_what_no_record_can_be_is_named(raw: bytes, why: str) -> None:
    with pytest.raises(RunDamagedError, match=why):
        read_record(raw, "it", "do")


@pytest.mark.parametrize("schema", [1, 4, 6, "x", None])
@pytest.mark.parametrize("with_hash", [True, False])
def test_a_run_of_another_schema_is_refused_by_its_schema(tmp_path: Path, schema: object, with_hash: bool) -> None:
    card = {"schema_version": schema, "settings": {}, "settings_sha256": "", "streams": []}
    (tmp_path / "run.json").write_bytes(as_record(card) if with_hash else json.dumps(card).encode())
    with pytest.raises(RunDamagedError, match=rf"run\.json has schema {schema}; .* reads schema 5"):
        read_root(locate(tmp_path))


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_disk_that_takes_no_more_is_full_whatever_the_system_calls_it(tmp_path: Path, error: int) -> None:
    with pytest.raises(DiskSpaceError, match=f"the disk of {tmp_path}"), locate(tmp_path).in_words():
        raise OSError(error, os.strerror(error))
