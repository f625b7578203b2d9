"""Records and bundles carry their hashes, reading checks them, and columns count by their seal."""

import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import DiskSpaceError, RunDamagedError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import Run, open_run, root, seal, verify_run
from probe_kit.runs.array_lengths import without_length
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.records import HASH, Checksum, Record, Sums, as_record, exact_records, read_record
from probe_kit.runs.results import PARTIAL, bundle_keys, read_bundles, write_bundle
from probe_kit.runs.root import read_root
from probe_kit.runs.run import NotSealedWarning
from probe_kit.runs.store import locate
from tests.runs.contents import hashes
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
    canonical = json.dumps(CONTENT, sort_keys=True, separators=(",", ":")).encode()
    assert stored.pop(HASH) == blake2b(canonical, digest_size=32).hexdigest()
    assert stored == CONTENT


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
def test_another_spelling_of_the_same_values_is_the_same_record(spell) -> None:
    content = json.loads(as_record(CONTENT))
    assert read_record(spell(content), "it", "do") == content


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
def test_a_deep_verification_takes_a_record_in_no_other_bytes(spell) -> None:
    content = json.loads(as_record(CONTENT))
    with exact_records():
        assert read_record(as_record(CONTENT), "it", "do") == content
        with pytest.raises(RunDamagedError, match=r"it was changed .* same values in other bytes .* do"):
            read_record(spell(content), "it", "do")
    assert read_record(spell(content), "it", "do") == content


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.text(), VALUES, max_size=4), st.data())
def test_a_changed_byte_is_refused_or_changes_no_value(content: dict[str, object], data: st.DataObject) -> None:
    content.pop(HASH, None)
    raw = bytearray(as_record(content))
    offset = data.draw(st.integers(0, len(raw) - 1))
    raw[offset] ^= data.draw(st.integers(1, 255))
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
    note = Note(run="x", count=2, objects={"k": Checksum.of(b"content"), "s": Checksum(3, "0" * 64, "1" * 32)})
    read = Note.parse(note.to_bytes(), "it", "do", run="x")
    assert (read.objects, read.hash, read.to_bytes()) == (note.objects, note.hash, note.to_bytes())


def test_a_sum_finds_other_content_though_its_checksum_is_the_same() -> None:
    """A chunk ends in its own crc32c, so the crc32c of every chunk is one number."""
    assert Checksum.of(b"one" + b"crc1") != Checksum.of(b"two" + b"crc2")
    assert "other bytes" in str(Checksum.of(b"one").problem(b"two"))
    assert "3 were written" in str(Checksum.of(b"one").problem(b"four"))


@pytest.mark.parametrize("schema", [1, 5, 7, "x", None])
@pytest.mark.parametrize("with_hash", [True, False])
def test_a_run_of_another_schema_is_refused_by_its_schema(tmp_path: Path, schema: object, with_hash: bool) -> None:
    card = {"schema_version": schema, "settings": {}, "settings_sha256": "", "streams": []}
    (tmp_path / "run.json").write_bytes(as_record(card) if with_hash else json.dumps(card).encode())
    with pytest.raises(RunDamagedError, match=rf"run\.json has schema {schema}; .* reads schema 6"):
        read_root(locate(tmp_path))


def name_a_stream_twice(streams: list[dict[str, Any]]) -> None:
    streams.append(streams[0])


def name_a_view_twice(streams: list[dict[str, Any]]) -> None:
    streams[0]["views"].append(streams[0]["views"][0])


@pytest.mark.parametrize("change", [name_a_stream_twice, name_a_view_twice])
def test_a_name_that_stands_twice_in_a_card_is_refused_though_its_hash_is_right(
    change: Callable[[list[dict[str, Any]]], None], little_runs: Path, tmp_path: Path
) -> None:
    """Of two arrays of one name, only one could be read."""
    run = Path(shutil.copytree(little_runs / "run", tmp_path / "run"))
    card = json.loads((run / "run.json").read_text(encoding="utf-8"))
    del card[HASH]
    change(card["streams"])
    (run / "run.json").write_bytes(as_record(card))
    with pytest.raises(RunDamagedError, match=r"run\.json .* stands twice"):
        open_run(run)


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_disk_that_takes_no_more_is_full_whatever_the_system_calls_it(tmp_path: Path, error: int) -> None:
    with pytest.raises(DiskSpaceError, match=f"the disk of {tmp_path}"), locate(tmp_path).explained_errors():
        raise OSError(error, os.strerror(error))


KEY = "0123456789ab"


def test_results_beside_arrays_are_read_without_a_search_for_runs_around_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search lists the folder above, which may hold thousands of others."""
    location = locate(tmp_path / "arrays")
    write_bundle(location, INTERVENTIONS, KEY, {"settings": {"kind": "mine"}})

    def search(address: str) -> str:
        raise AssertionError(f"looked for runs near {address}")

    monkeypatch.setattr(root, "what_to_open", search)
    assert read_bundles(location, INTERVENTIONS)[KEY].head["settings"] == {"kind": "mine"}


def test_a_complete_result_counts_beside_what_a_killed_process_left_of_it(tmp_path: Path) -> None:
    """Else a table would lose a category, and no message would name it."""
    location = locate(tmp_path / "arrays")
    unfinished = "ba9876543210"
    write_bundle(location, INTERVENTIONS, KEY, {"settings": {"kind": "mine"}}, {"effects.json": b"{}"})
    for key in (KEY, unfinished):
        location.write(f"{INTERVENTIONS}/.{key}{PARTIAL}/piece.npz", b"half of a piece")
    location.write(f"{INTERVENTIONS}/{unfinished}/effects.json", b"{}")
    assert bundle_keys(location, INTERVENTIONS) == [KEY]
    assert read_bundles(location, INTERVENTIONS)[KEY].read("effects.json") == b"{}"


SITES = (Site("backbone", 2), Site("expert", 3, iteration=7))


@pytest.fixture
def copy(recorded_run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


@pytest.mark.slow
def test_columns_hold_exactly_the_numbers_of_the_rows(recorded_run: Run, copy: Path) -> None:
    assert recorded_run.sealed
    shutil.rmtree(copy / "columns.zarr")
    unsealed = open_run(copy)
    for stream in recorded_run.streams:
        for site in recorded_run.sites(stream):
            for view in recorded_run.views(stream):
                with pytest.warns(NotSealedWarning):
                    rows = unsealed.column(site, view)
                np.testing.assert_array_equal(recorded_run.column(site, view), rows)


def test_sealing_again_gives_the_same_bytes_and_a_second_time_does_nothing(copy: Path) -> None:
    before = hashes(copy)
    assert not seal(copy)
    shutil.rmtree(copy / "columns.zarr")
    assert seal(copy)
    assert hashes(copy) == before
    shutil.rmtree(copy / "columns.zarr")
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--seal"])
    assert (answer.exit_code, "24 of 24 episodes, sealed" in answer.stdout) == (0, True), answer.output
    assert hashes(copy) == before


@pytest.mark.slow
@pytest.mark.parametrize("finished", [True, False])
def test_what_a_killed_seal_left_is_cleared_by_the_next_one(copy: Path, finished: bool) -> None:
    before = hashes(copy)
    leftover = copy / "columns.zarr" / "of-fewer"
    leftover.mkdir()
    (leftover / "zarr.json").write_bytes(b"{}")
    if not finished:
        (columns,) = (path for path in leftover.parent.iterdir() if path != leftover)
        (columns / "zarr.json").write_bytes(b"{}")
        shutil.rmtree(copy / "sealed")
    seal(copy)
    assert hashes(copy) == before


@pytest.mark.slow
def test_a_slab_smaller_than_the_run_changes_nothing(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = hashes(copy)
    shutil.rmtree(copy / "columns.zarr")
    monkeypatch.setattr("probe_kit.runs.verify.SLAB_BYTES", 3 * 24 * 96 * 4)
    seal(copy)
    assert hashes(copy) == before


@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_columns_of_other_commits_are_not_used_until_sealed_again(copy: Path) -> None:
    (copy / "commits/00000005.json").unlink()
    with pytest.raises(RunDamagedError, match=r"commits/00000005\.json is missing.*delete sealed"):
        seal(copy)
    shutil.rmtree(copy / "sealed")
    run = open_run(copy, allow_partial=True)
    with pytest.warns(NotSealedWarning, match=r"probe-kit run verify .* --seal"):
        assert run.column(SITES[0]).shape == (23, 96)
    assert seal(copy)
    again = open_run(copy, allow_partial=True)
    assert again.sealed
    np.testing.assert_array_equal(again.column(SITES[0]), run.column(SITES[0]))


def test_a_flipped_bit_in_a_column_is_an_error_that_says_how_to_rebuild(copy: Path) -> None:
    chunk = next(path for path in copy.glob("columns.zarr/*/backbone/pooled/c/0/0/2/**/*") if path.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(RunDamagedError, match=r"run verify .* --seal"):
        open_run(copy).column(SITES[0])


DERIVED = ("provenance/*", "certificates/*", "certificate.json")


@pytest.mark.parametrize("lost", [DERIVED[0], *(pytest.param(key, marks=pytest.mark.slow) for key in DERIVED[1:])])
def test_a_record_that_follows_from_the_others_is_made_again(copy: Path, lost: str) -> None:
    before, files = hashes(copy), list(copy.glob(lost))
    run = open_run(copy)
    records = (run.certificate, run.provenances, run.origins)
    for file in files:
        file.unlink()
    again = open_run(copy)
    assert (again.certificate, again.provenances, again.origins) == records
    assert re.search(rf"{re.escape(files[0].name)} is missing.*--seal", verify_run(copy).problems[0])
    again.restore_records()
    assert hashes(copy) == before
    files[0].unlink()
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--seal"])
    assert (answer.exit_code, hashes(copy)) == (0, before), answer.output


def test_records_that_follow_from_nothing_are_damage_by_name(copy: Path) -> None:
    for lost in (("certificates", "certificate.json"), ("provenance", "certificate.json")):
        run = Path(shutil.copytree(copy, copy.with_name("-".join(lost))))
        for name in lost:
            shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()
        with pytest.raises(RunDamagedError, match=rf"({'|'.join(lost)}).* is missing"):
            open_run(run)


@pytest.mark.parametrize(
    "damage",
    [
        "a bit",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("the seal", "cut", "an object", "the metadata", "the seal's bit")
        ),
    ],
)
def test_damaged_columns_are_built_again_by_the_command_that_the_error_names(copy: Path, damage: str) -> None:
    before = hashes(copy)
    chunk = next(path for path in copy.glob("columns.zarr/*/backbone/pooled/c/**/*") if path.is_file())
    (sealed,) = (copy / "sealed").iterdir()
    if damage in ("a bit", "cut"):
        chunk.write_bytes(
            chunk.read_bytes()[: -1 if damage == "cut" else None].translate(bytes(range(255, -1, -1)))
        )
    elif damage == "the seal's bit":
        sealed.write_bytes(sealed.read_bytes().replace(b'"seal', b'"sead').replace(b'"stamp"', b'"stamq"'))
    else:
        metadata = next(copy.glob("columns.zarr/*/zarr.json"))
        {"an object": chunk, "the metadata": metadata, "the seal": sealed}[damage].unlink()
    assert damage == "the seal" or not verify_run(copy, deep=True).ok
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--seal", "--deep"])
    assert (answer.exit_code, hashes(copy)) == (0, before), answer.output


def test_arrays_of_an_earlier_run_are_read_and_shortened_by_its_seal(copy: Path, recorded_run: Run) -> None:
    identity, before = recorded_run.root.identity, hashes(copy)
    for path in (copy / "data.zarr").rglob("zarr.json"):
        path.write_bytes(without_length(path.read_bytes()))
    earlier = open_run(copy)
    assert (earlier.root.identity, earlier.stamp) == (identity, recorded_run.stamp)
    assert zarr.open_array(copy / "data.zarr/backbone/pooled", mode="r").shape[0] == 1_000_000
    assert verify_run(copy, deep=True).ok
    assert not seal(copy)
    assert hashes(copy) == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"\n    24,", b"\n    25,"),
        (b'"episodes": 24', b'"episodes": 25'),
        (b"24", b"0"),
        (b'"float32"', b'"uint32"'),
    ],
)
def test_metadata_that_differs_in_more_than_its_length_is_damage(copy: Path, old: bytes, new: bytes) -> None:
    path = copy / "data.zarr/backbone/pooled/zarr.json"
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    with pytest.raises(RunDamagedError, match=r"backbone/pooled/zarr\.json has"):
        open_run(copy)


def test_role_codes_name_every_token_position(recorded_run: Run) -> None:
    role = zarr.open_array(next(recorded_run.path.glob("columns.zarr/*/backbone/role")), mode="r")
    names = role.attrs["roles"]
    _, mask = recorded_run.tokens(SITES[0], "language")
    np.testing.assert_array_equal(np.asarray(role[0]) == names.index("language"), mask)
    assert names[0] == "padding"


@pytest.mark.slow
def test_the_labelled_dataset_is_the_same_with_and_without_columns(recorded_run: Run, copy: Path) -> None:
    shutil.rmtree(copy / "columns.zarr")
    assert recorded_run.xarray().identical(open_run(copy).xarray())


@pytest.mark.slow
def test_token_blocks_put_together_are_the_tokens(recorded_run: Run) -> None:
    for site in SITES:
        values, mask = recorded_run.tokens(site)
        for block in recorded_run.iter_token_blocks(site):
            stop = block.start + block.mask.shape[1]
            np.testing.assert_array_equal(block.values, values[:, block.start : stop])
            np.testing.assert_array_equal(block.mask, mask[:, block.start : stop])


def test_the_gram_matrix_equals_the_one_computed_in_float64(recorded_run: Run) -> None:
    values, mask = recorded_run.tokens(SITES[0], "language")
    flat = values.astype(np.float64).reshape(24, -1)
    expected = flat @ flat.T / np.sqrt(np.outer(mask.sum(1), mask.sum(1)))
    np.testing.assert_allclose(recorded_run.gram(SITES[0], "language"), expected, rtol=1e-5)


def test_reading_a_run_needs_neither_torch_nor_simulator(recorded_run: Run) -> None:
    code = f"""
import sys
from probe_kit.runs import open_run
from probe_kit.hooks.contract.sites import Site
run = open_run({str(recorded_run.path)!r})
run.column(Site("backbone", 1)), run.tokens(Site("backbone", 1), "language"), run.gram(Site("backbone", 1))
print([name for name in ("torch", "pybullet", "lerobot", "transformers") if name in sys.modules])
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert loaded.stdout.strip() == "[]"
