"""Records: a hash over values. The same values in other spelling are the same record; anything else is damage."""

import errno
import json
import os
from hashlib import blake2b
from pathlib import Path
from typing import ClassVar

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from probe_kit.errors import DiskSpaceError, RunDamagedError
from probe_kit.runs.records import HASH, Record, Sum, Sums, as_record, read_record
from probe_kit.runs.root import read_root
from probe_kit.runs.store import locate
from tests.support.representations import SPELLINGS

CONTENT = {"b": [1, 2.5, None], "a": "ä", "A": {"x": True}}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


class Note(Record):
    kind: ClassVar[str] = "note"
    run: str
    count: int
    objects: Sums = {}


def test_a_record_is_plain_json_with_the_hash_of_its_canonical_json() -> None:
    stored = json.loads(as_record(CONTENT))
    own = json.dumps(CONTENT, sort_keys=True, separators=(",", ":")).encode()
    assert stored.pop(HASH) == blake2b(own, digest_size=32).hexdigest()
    assert stored == CONTENT


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
def test_another_spelling_of_the_same_values_is_the_same_record(spell) -> None:
    content = json.loads(as_record(CONTENT))
    assert read_record(spell(content), "it", "do") == content


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.text(), VALUES, max_size=4), st.data())
def test_a_changed_byte_is_refused_or_changes_no_value(content: dict[str, object], data: st.DataObject) -> None:
    content.pop(HASH, None)
    raw = bytearray(as_record(content))
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    try:
        read = read_record(bytes(raw), "it", "do")
    except RunDamagedError:
        return
    assert {name: value for name, value in read.items() if name != HASH} == content


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (b'{"a": 1, "a": 2}', "names the key 'a' twice"),
        (b'{"a": {"b": 1, "c": 2, "b": 1}}', "names the key 'b' twice"),
        (b'\xef\xbb\xbf{"a": 1}', "byte order mark"),
        (b'{"a": NaN}', "not a finite number"),
        (b'{"a": 1e999}', "not a finite number"),
        (b'{"a": "\\ud800"}', "surrogate"),
        (b"[" * 99_999, "nests too deeply"),
        (b'{"a":' * 5_000 + b"1" + b"}" * 5_000, "nests too deeply"),
        (b"{}", "its hash is another one"),
        (b"[]", "holds a list"),
        (b"\xff\xfe", "decode"),
        (b"", "Expecting value"),
        (as_record(CONTENT)[:-1], "delimiter"),
    ],
)
def test_bytes_that_no_record_can_be_are_named(raw: bytes, why: str) -> None:
    with pytest.raises(RunDamagedError, match=why):
        read_record(raw, "it", "do")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ({"run": "x"}, "count is missing"),
        ({"run": "x", "count": "1"}, "count is '1'"),
        ({"run": "x", "count": True}, "count is True; expected a valid integer"),
        ({"run": "x", "count": 1, "more": 1}, "more is unknown"),
        ({"run": "y", "count": 1}, "is the note of run y; here belongs that of run x"),
        ({"run": "x", "count": 1, "objects": {"k": [-1, "0" * 64]}}, r"objects\.k is .* and 64 hex digits"),
        ({"run": "x", "count": 1, "objects": {"k": [1, "0" * 63]}}, r"objects\.k is .* and 64 hex digits"),
        ({"run": "x", "count": 1, "objects": {"k": [1, "0" * 64, "0"]}}, r"objects\.k is .* and 64 hex digits"),
    ],
)
def test_a_record_of_other_parts_or_of_another_run_is_damage_by_name(content: dict[str, object], why: str) -> None:
    with pytest.raises(RunDamagedError, match=why):
        Note.parse(as_record(content), "it", "Restore it", run="x")


def test_a_record_reads_as_it_was_made() -> None:
    note = Note(run="x", count=2, objects={"k": Sum.of(b"content"), "s": Sum(3, "0" * 64, "1" * 32)})
    read = Note.parse(note.to_bytes(), "it", "do", run="x")
    assert (read.objects, read.hash, read.to_bytes()) == (note.objects, note.hash, note.to_bytes())


def test_a_sum_finds_other_content_though_its_checksum_is_the_same() -> None:
    """A chunk ends in its own crc32c, so the crc32c of every chunk is one number."""
    assert Sum.of(b"one" + b"crc1") != Sum.of(b"two" + b"crc2")
    assert "other bytes" in str(Sum.of(b"one").problem(b"two"))
    assert "3 were written" in str(Sum.of(b"one").problem(b"four"))


@pytest.mark.parametrize("schema", [1, 5, 7, "x", None])
@pytest.mark.parametrize("with_hash", [True, False])
def test_a_run_of_another_schema_is_refused_by_its_schema(tmp_path: Path, schema: object, with_hash: bool) -> None:
    card = {"schema_version": schema, "settings": {}, "settings_sha256": "", "streams": []}
    (tmp_path / "run.json").write_bytes(as_record(card) if with_hash else json.dumps(card).encode())
    with pytest.raises(RunDamagedError, match=rf"run\.json has schema {schema}; .* reads schema 6"):
        read_root(locate(tmp_path))


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_disk_that_takes_no_more_is_full_whatever_the_system_calls_it(tmp_path: Path, error: int) -> None:
    with pytest.raises(DiskSpaceError, match=f"the disk of {tmp_path}"), locate(tmp_path).in_words():
        raise OSError(error, os.strerror(error))
