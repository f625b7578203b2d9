"""Foreign files are read if they are regular and of bounded size, by every reader of the package."""

import ast
import gzip
import os
import socket
import time
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import probe_kit
from probe_kit._system import bounded_files
from probe_kit._system.bounded_files import (
    check_regular,
    load_gzipped_json,
    load_json,
    load_yaml,
    open_arrays,
    open_regular,
    read_regular,
)
from tests.support.parsed import package_nodes

PACKAGE = Path(probe_kit.__file__).parent


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def listening_socket(path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.close()


def folder(path: Path) -> None:
    path.mkdir()


IRREGULAR = [
    (pipe, "it is a pipe; expected a regular file"),
    (endless_device, "it is a device; expected a regular file"),
    (listening_socket, "it is a socket; expected a regular file"),
    (folder, "Is a directory"),
]
READERS = [check_regular, open_regular, read_regular, load_json, load_gzipped_json, load_yaml]


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
@pytest.mark.parametrize(("make", "reason"), IRREGULAR, ids=lambda value: getattr(value, "__name__", ""))
def test_a_pipe_or_device_file_is_refused_by_name_and_never_waited_for(
    tmp_path: Path, make: Callable[[Path], None], reason: str, reader: Callable[[Path], object]
) -> None:
    make(tmp_path / "x")
    begin = time.monotonic()
    with pytest.raises(OSError) as refused:  # noqa: PT011 - the reason is compared below
        reader(tmp_path / "x")
    assert refused.value.strerror == reason
    assert time.monotonic() - begin < 10


def test_a_file_of_the_bound_is_read_and_one_byte_more_is_refused_by_its_size(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"1" * 3_000_000)
    assert len(read_regular(tmp_path / "x", 3_000_000)) == 3_000_000
    with pytest.raises(OSError, match=r"it has 3 MB; expected at most 3 MB"):
        read_regular(tmp_path / "x", 2_999_999)


def test_a_sparse_file_of_a_terabyte_is_refused_by_its_size_alone(tmp_path: Path) -> None:
    with (tmp_path / "x.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(OSError, match=r"it has 1,099,512 MB; expected at most 268 MB"):
        load_json(tmp_path / "x.json")


def test_a_gzip_file_is_unpacked_to_the_bound_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_files, "MOST_BYTES", 1 << 20)
    for size, fits in (((1 << 20) - 2, True), (1 << 20, False)):
        (tmp_path / "x.gz").write_bytes(gzip.compress(b'"' + b"a" * size + b'"'))
        if fits:
            assert len(load_gzipped_json(tmp_path / "x.gz")) == size
        else:
            with pytest.raises(ValueError, match="it unpacks to more than 1 MB"):
                load_gzipped_json(tmp_path / "x.gz")


def test_arrays_are_refused_by_their_size_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "x.npz", a=np.zeros(1_000_000))
    content = (tmp_path / "x.npz").read_bytes()
    assert len(content) < 20_000
    for source in (tmp_path / "x.npz", content):
        with open_arrays(source) as arrays:
            assert arrays["a"].shape == (1_000_000,)
    monkeypatch.setattr(bounded_files, "MOST_ARRAY_BYTES", 7_999_999)
    for source in (tmp_path / "x.npz", content):
        with pytest.raises(ValueError, match="its arrays have 8 MB unpacked; expected at most 8 MB"):
            open_arrays(source)


def test_nine_lines_of_yaml_do_not_stand_for_a_billion_values(tmp_path: Path) -> None:
    names = "abcdefghij"
    lines = ["a: &a [x,x,x,x,x,x,x,x,x,x]"]
    lines += [f"{now}: &{now} [{','.join([f'*{before}'] * 10)}]" for before, now in pairwise(names)]
    (tmp_path / "x.yaml").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(ValueError, match=r"its aliases stand for 1e\+10 values"):
        load_yaml(tmp_path / "x.yaml")
    (tmp_path / "x.yaml").write_text("a: &a [1, 2]\nb: *a", encoding="utf-8")
    assert load_yaml(tmp_path / "x.yaml") == {"a": [1, 2], "b": [1, 2]}
    (tmp_path / "x.yaml").write_text("a: &a [*a]", encoding="utf-8")
    with pytest.raises(ValueError, match="refers to itself"):
        load_yaml(tmp_path / "x.yaml")


UNBOUNDED = {
    "read_bytes", "read_text", "safe_load", "ParquetFile", "read_table", "read_parquet", "read_csv", "decompress",
}  # fmt: skip
ELSEWHERE = {
    "_system/bounded_files.py": "the reader itself",
    "runs/export_vectors.py": "the matrix that it has just written",
    "_system/parquet_files.py": "the reader itself",
    "_system/imports.py": "lists of the installed packages",
    "_system/machine.py": "files of the system",
    "doctor.py": "files of the system",
    "hooks/new_adapter/__init__.py": "files of the package",
    "hooks/families/shared/lerobot/normaliser.py": "files of the package",
    "hooks/conformance/loading.py": "a copy of a checkpoint that was read",
    "suite/generators/drawing.py": "files of the package",
    "suite/pictures.py": "`stored_picture`: files of the package",
    "suite/build.py": "files of the package",
    "view/export.py": "files of the package",
    "retention/report/page.py": "files of the package",
    "runs/provenance.py": "files of the package",
    "extract/rollout/worker.py": "the video that it has just written",
    "runs/folder.py": "objects of a run, by its own check of regular files",
}


@cache
def unbounded_calls() -> dict[str, list[str]]:
    """By module, the calls that read a file without a bound, each with its line."""
    calls: dict[str, list[str]] = {}
    for path, node in package_nodes(ast.Call):
        if isinstance(node.func, ast.Attribute) and (
            node.func.attr in UNBOUNDED or ast.unparse(node.func) in ("np.load", "Image.open", "json.load")
        ):
            name = str(path.relative_to(PACKAGE))
            calls.setdefault(name, []).append(f"{name}:{node.lineno} {node.func.attr}")
    return calls


def test_no_reader_of_foreign_files_lacks_a_bound() -> None:
    unbounded = [call for name, calls in unbounded_calls().items() if name not in ELSEWHERE for call in calls]
    assert not unbounded, "read by probe_kit._system.bounded_files, or say here why not"


def test_every_module_that_is_left_out_has_such_a_call() -> None:
    assert not [name for name in ELSEWHERE if name not in unbounded_calls()]
