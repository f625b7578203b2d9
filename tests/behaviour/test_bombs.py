"""Small files of others that stand for all memory are refused by name, in each format that is read."""

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import torch
import zarr
from numcodecs import Blosc
from PIL import Image
from safetensors.torch import save_file

from probe_kit._system import bounded_files
from probe_kit._system.bounded_files import load_gzipped_json, open_arrays, parse_json
from probe_kit.errors import RunDamagedError, SuiteError, UsageError, WeightsError
from probe_kit.extract import LeRobotSource
from probe_kit.extract.sources.recording import read_episodes
from probe_kit.hooks.checkpoints.weights import read_pickle, read_weights
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.shared.feature_names import names_of
from probe_kit.hooks.families.shared.token_decoder import top_of
from probe_kit.intervene.erasers import Method
from probe_kit.intervene.pairs import read_pairs
from probe_kit.intervene.places import PlaceName
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.arrays import open_array
from probe_kit.runs.direction_files import read_direction
from probe_kit.runs.store import locate
from probe_kit.study import load_study
from probe_kit.suite import Suite, rules
from probe_kit.suite.pictures import decode_bytes, rgb_of
from tests.support.little_run import episode, little_plan, little_writer
from tests.support.rehashing import rehash

MOST_MEMORY = 64 << 20
"""That a refusal may take, of files that stand for a gigabyte or more."""
LARGE = 128 << 20


@pytest.fixture
def memory() -> Iterator[None]:
    """Numpy's own memory stays small; it reports to tracemalloc."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MOST_MEMORY


@cache
def deflated(size: int) -> bytes:
    """So many zeros, as zlib packs them, made piece by piece."""
    packer, piece = zlib.compressobj(9), bytes(1 << 20)
    return b"".join([*(packer.compress(piece) for _ in range(size >> 20)), packer.flush()])


# -- pictures ---------------------------------------------------------------------------------------------


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(side: int, data: bytes, *chunks: bytes) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("kind", "head"),
    [(b"zTXt", b"a\0\0"), (b"iTXt", b"a\0\1\0\0\0"), (b"iCCP", b"a\0\0")],
    ids=["zTXt", "iTXt", "iCCP"],
)
def test_notes_and_profiles_of_a_picture_are_not_unpacked(kind: bytes, head: bytes) -> None:
    content = png(16, zlib.compress(bytes(17 * 16)), chunk(kind, head + deflated(LARGE)))
    with pytest.raises(SuiteError, match="Decompressed data too large"):
        decode_bytes(content, "x:")


@pytest.mark.slow
def test_pixels_beyond_those_that_the_header_states_are_not_unpacked() -> None:
    assert decode_bytes(png(16, deflated(LARGE)), "x:").size == (16, 16)


def test_frames_of_an_animation_are_not_counted() -> None:
    frame = b"\x2c" + struct.pack("<HHHHB", 0, 0, 1, 1, 0) + b"\x02\x02D\x01\0"
    content = b"GIF89a" + struct.pack("<HHBBB", 1, 1, 0x80, 0, 0) + bytes(6) + frame * 200_000 + b"\x3b"
    with pytest.raises(SuiteError, match="has several frames"):
        decode_bytes(content, "x:")


def test_a_picture_that_another_library_opened_has_the_same_bound() -> None:
    """Textures of meshes; Pillow decodes when pixels are asked for."""
    texture = Image.open(io.BytesIO(png(8_200, b"")))
    with pytest.raises(SuiteError, match="claims to be 8200×8200 pixels; at most 8192"):
        rgb_of(texture, "the texture", "Make it smaller.")


def test_the_pictures_of_a_suite_have_a_bound_together(
    small_suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = {item.file_name(side): item.picture(side) for item in small_suite.items for side in rules.SIDES}
    pixels = 0
    for path in pictures.values():
        with Image.open(path) as image:
            pixels += image.width * image.height
    monkeypatch.setattr(rules, "MOST_PIXELS", pixels)
    assert not list(rules.pictures_unchanged(small_suite))
    monkeypatch.setattr(rules, "MOST_PIXELS", pixels - 1)
    (finding,) = rules.pictures_unchanged(small_suite)
    assert f"have {pixels:,} pixels together" in finding.message


# -- arrays -----------------------------------------------------------------------------------------------

HEADERS = {
    "a petabyte": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,)}",
    "eight gigabytes": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,)}",
    "a count that overflows": "{'descr': '<f8', 'fortran_order': False, 'shape': (4294967296, 4294967296, 4)}",
    "no axis of no length": "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 1000000000000, 1000000000)}",
    "a negative axis": "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
    "an axis that is true": "{'descr': '<f8', 'fortran_order': False, 'shape': (True,)}",
    "items of two gigabytes": "{'descr': '|V2000000000', 'fortran_order': False, 'shape': (1,)}",
    "items of no bytes": "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000000,)}",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
    "a deep expression": "-" * 9_000 + "1",
    "many brackets": "(" * 9_000,
    "no expression": "]",
}


def packed(header: str, version: bytes = b"\1\0") -> bytes:
    """An `.npz` file of one array of 8 bytes under this header."""
    head = header.encode() + b"\n"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY" + version + struct.pack("<H", len(head)) + head + bytes(8))
    return file.getvalue()


@pytest.mark.usefixtures("memory")
@pytest.mark.parametrize("name", [name for name in HEADERS if name != "no axis of no length"])
def test_an_array_whose_header_claims_other_bytes_is_refused_before_room_is_made(name: str) -> None:
    with (
        pytest.raises(ValueError, match=r"array|Object arrays|Cannot parse header"),
        open_arrays(packed(HEADERS[name])) as arrays,
    ):
        arrays["a"]


def test_an_array_of_no_values_needs_no_room_whatever_its_other_axes_say() -> None:
    with pytest.raises(ValueError, match="array"), open_arrays(packed(HEADERS["no axis of no length"])) as arrays:
        arrays["a"]


def test_arrays_as_numpy_writes_them_are_read(tmp_path: Path) -> None:
    written = {
        "numbers": np.arange(6.0).reshape(2, 3), "turned": np.arange(6).reshape(2, 3).T,
        "texts": np.array(["a", "bc"]), "none": np.zeros((0, 4)), "scalar": np.float32(3),
        "flags": np.array([True]), "pairs": np.zeros(3, "i4,f8"),
    }  # fmt: skip
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **written)
        with open_arrays(tmp_path / "x.npz") as arrays:
            for name, array in written.items():
                np.testing.assert_array_equal(arrays[name], array)


# -- JSON and TOML ----------------------------------------------------------------------------------------


def test_many_short_values_are_refused_by_their_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """85 million empty lists are 256 MB of text and 6 GB of Python, and 0.3 MB as gzip."""
    monkeypatch.setattr(bounded_files, "MOST_VALUES", 1_000)
    assert len(parse_json("[" + "[]," * 498 + "0]")) == 499
    for bomb in ("[" + "[]," * 2_000 + "0]", "[" + "0," * 1_100 + "0]", "[" + "{}," * 600 + "0]"):
        (tmp_path / "x.gz").write_bytes(gzip.compress(bomb.encode()))
        for read in (lambda text=bomb: parse_json(text), lambda: load_gzipped_json(tmp_path / "x.gz")):
            with pytest.raises(ValueError, match=r"may hold [\d,]+ values; expected at most 1,000"):
                read()
    assert len(parse_json(json.dumps("," * 900))) == 900


@pytest.mark.parametrize("text", ["[" * 1_000_000, '{"a":' * 100_000, "[1" + ",[1" * 100_000])
def test_json_that_nests_without_end_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="it nests too deeply"):
        parse_json(text)


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 100_000,
        "x = " + "{a = " * 100_000,
        ".".join(["a"] * 20_000) + " = 1",
        "[" + " . ".join(["a"] * 20_000) + "]",
        ".".join(['"a"', "'b'"] * 5_000) + " = 1",
    ],
    ids=["lists", "tables", "dotted key", "dotted heading", "quoted keys"],
)
def test_a_study_file_that_nests_without_end_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match="nest too deeply"):
        load_study(tmp_path / "study.toml")


def test_a_study_file_of_many_megabytes_is_refused_by_its_size(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_bytes(b"#" * (1 << 21))
    with pytest.raises(UsageError, match="it has 2 MB; expected at most 1 MB"):
        load_study(tmp_path / "study.toml")


# -- weights ----------------------------------------------------------------------------------------------


def header(text: str) -> bytes:
    return struct.pack("<Q", len(text)) + text.encode()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        struct.pack("<Q", 1 << 60) + b"{}",
        struct.pack("<Q", 99_000_000) + b"{}",
        header('{"a":{"dtype":"F32","shape":[4611686018427387904,8],"data_offsets":[0,4]}}') + bytes(4),
        header('{"a":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4000000000]}}') + bytes(4),
        header('{"a":' * 50_000),
    ],
    ids=["nothing", "an exabyte of header", "99 MB of header", "overflow", "four gigabytes", "deep"],
)
def test_weights_whose_header_claims_more_than_is_there_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(content)
    with pytest.raises(WeightsError, match="cannot be read"):
        read_weights(tmp_path)


def test_a_pickle_with_compressed_members_is_refused_and_torch_writes_none(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(4)}, tmp_path / "plain.pt")
    assert read_pickle(tmp_path / "plain.pt").tensors["a"].shape == (4,)
    with zipfile.ZipFile(tmp_path / "plain.pt") as plain:
        members = {name: plain.read(name) for name in plain.namelist()}
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as bomb:
        for name, content in members.items():
            bomb.writestr(name, content)
    with pytest.raises(WeightsError, match=r"data\.pkl' compressed; torch\.save compresses nothing"):
        read_pickle(tmp_path / "bomb.pt")


def test_weights_of_the_same_kind_are_read(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(4)}, tmp_path / "model.safetensors")
    assert read_weights(tmp_path).tensors["a"].shape == (4,)


# -- runs -------------------------------------------------------------------------------------------------

pytestmark = pytest.mark.filterwarnings("ignore:.*is not sealed")


@pytest.fixture
def run(small_suite: Suite, tmp_path: Path) -> Path:
    plan = little_plan(small_suite.select(["color"], 2))
    writer = little_writer(locate(tmp_path / "run"), plan)
    for number in writer.remaining():
        writer.write(episode(plan, number))
    return tmp_path / "run"


def column(run: Path) -> object:
    opened: Run = open_run(run)
    (stream, *_) = opened.streams
    return opened.column(opened.sites(stream)[0], opened.views(stream)[0])


def pooled(run: Path, name: str) -> list[Path]:
    return [path for path in sorted((run / "data.zarr").rglob(name)) if "pooled" in path.parts and path.is_file()]


def refused(run: Path, reason: str) -> None:
    with pytest.raises(RunDamagedError, match=reason):
        column(run)
    assert verify_run(run, deep=True).problems


def test_a_chunk_that_unpacks_to_gigabytes_is_refused_by_its_header(run: Path) -> None:
    """With right hashes, so that the audit alone cannot find it. The header is of two gigabytes of zeros."""
    content = bytearray(Blosc(cname="zstd", clevel=1, shuffle=0).encode(np.zeros(1 << 20, np.uint8)))
    content[4:8] = (2_000_000_000).to_bytes(4, "little")
    for path in pooled(run, "0"):
        path.write_bytes(content + google_crc32c.value(bytes(content)).to_bytes(4, "little"))
    rehash(run)
    refused(run, "unpacks to 2,000,000,000")


def gzip_codec(metadata: dict[str, object]) -> None:
    parts = [
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "gzip", "configuration": {"level": 1}},
    ]
    metadata["codecs"] = parts


def long_row(metadata: dict[str, list[int]]) -> None:
    metadata["shape"][-1] = 10**12


def large_chunk(metadata: dict[str, dict[str, dict[str, list[int]]]]) -> None:
    metadata["shape"][-1] = 10**12  # type: ignore[index]
    metadata["chunk_grid"]["configuration"]["chunk_shape"][-1] = 10**12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (gzip_codec, "is stored by GzipCodec"),
        (long_row, "claims .* chunks of"),
        (large_chunk, "claims .* chunks of"),
    ],
)
def test_metadata_that_claims_what_no_run_has_is_refused(
    change: Callable[[dict[str, object]], None], reason: str, run: Path
) -> None:
    for path in pooled(run, "zarr.json"):
        metadata = json.loads(path.read_text(encoding="utf-8"))
        change(metadata)
        path.write_text(json.dumps(metadata, indent=2), encoding="utf-8")
    rehash(run)
    refused(run, reason)


@pytest.mark.parametrize("name", ["run.json", "plan/00000000.json", "commits/00000000.json", "chunk", "metadata"])
def test_a_sparse_file_in_a_run_is_refused_by_its_size(name: str, run: Path) -> None:
    files = {"chunk": pooled(run, "0")[0], "metadata": pooled(run, "zarr.json")[0]}
    path = files.get(name, run / name)
    if not path.is_file():
        path = sorted((run / name).parent.glob("*.json"))[0]
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(RunDamagedError, match=r"has 1,099,5\d\d MB; expected|has \d{13} bytes"):
        column(run)
    with suppress(RunDamagedError):
        assert verify_run(run, deep=True).problems


@pytest.mark.parametrize("name", ["0", "zarr.json"])
def test_an_object_that_was_made_larger_after_a_run_was_opened_is_never_read_whole(name: str, run: Path) -> None:
    opened = open_run(run)
    with pooled(run, name)[0].open("r+b") as file:
        file.truncate(1 << 31)  # less than the largest object of a run
    with pytest.raises(RunDamagedError, match="has 2,147 MB; expected at most 1 MB"):
        opened.column(opened.sites("backbone")[0], "mean")


@pytest.mark.slow
def test_threads_that_open_arrays_at_once_do_not_take_each_others_codecs(run: Path) -> None:
    opened = open_run(run)
    with ThreadPoolExecutor(8) as threads:
        arrays = list(threads.map(lambda _: open_array(opened.data, "backbone/pooled"), range(200)))
    assert len(arrays) == 200
    assert zarr.config.get("codecs.blosc") == "zarr.codecs.blosc.BloscCodec"


def test_the_same_run_unchanged_is_read(run: Path) -> None:
    assert np.isfinite(np.asarray(column(run))).all()
    rehash(run)
    assert np.isfinite(np.asarray(column(run))).all()
    assert replace(open_run(run).streams["backbone"]).name == "backbone"


# -- numbers -------------------------------------------------------------------------------------------------

MANY = "1" * 5000
"""More digits than Python converts."""


def pairs_of(folder: Path, *cells: str) -> object:
    (folder / "pairs.csv").write_text(
        f"episode,frame,donor_episode,donor_frame\n{','.join(cells)}\n", encoding="utf-8"
    )
    return read_pairs(folder / "pairs.csv")


def feature_of(folder: Path, number: str) -> object:
    save_file({"W_dec": torch.eye(3)}, folder / "sae_weights.safetensors")
    return read_direction(f"{folder}#{number}")


NUMBERS: dict[str, Callable[[Path, str], object]] = {
    "a frame": lambda folder, number: pairs_of(folder, "a", number, "b", "0"),
    "a donor's frame": lambda folder, number: pairs_of(folder, "a", "0", "b", number),
    "a feature": feature_of,
    "a layer": lambda _, number: Site.parse(f"backbone.{number}.residual"),
    "an iteration": lambda _, number: Site.parse(f"backbone.01.residual@{number}"),
    "a place": lambda _, number: PlaceName.parse(f"backbone.{number}"),
    "a head": lambda _, number: PlaceName.parse(f"backbone.01.heads.{number}"),
    "iterations": lambda _, number: PlaceName.parse(f"backbone.01@0-{number}"),
    "every so many": lambda _, number: LeRobotSource("x", every=f"every:{number}"),
    "degrees": lambda _, number: LeRobotSource("x", rotations=(number.replace("2", "180", 1),)),
    "tokens": lambda _, number: top_of(number, ()),
    "episodes": lambda _, number: read_episodes(f"0:{number}"),
    "one episode": lambda _, number: read_episodes(number),
    "erased directions": lambda _, number: Method.of(f"inlp:{number}"),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_of_more_digits_than_python_converts_is_refused_by_name(name: str, tmp_path: Path) -> None:
    NUMBERS[name](tmp_path, "2" if name != "a layer" else "02")
    with pytest.raises(UsageError):
        NUMBERS[name](tmp_path, MANY)


def test_names_of_numbers_at_places_of_many_digits_are_no_names() -> None:
    assert names_of({"0": "x", "1": "y"}, 2) == ("x", "y")
    assert names_of({"0": "x", MANY: "y"}, 2) != ("x", "y")
