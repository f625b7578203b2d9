"""A small Parquet file never fills the memory, and honest ones are read as pyarrow reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from probe_kit._system import parquet_files
from probe_kit._system.parquet_files import TooLargeError, open_parquet, read_parquet

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")


BOUND = 64 << 20


def repeated(value: Any, count: int) -> Any:
    """One value in `count` rows, of which pyarrow writes a dictionary and one run."""
    return pa.DictionaryArray.from_arrays(pa.array([0] * count, pa.int32()), pa.array([value]))


def one_long_text(path: Path) -> None:
    """A text of 1 MB in each of 3,700 rows: 2.2 MB on the disk, once 3.7 GB in memory."""
    pq.write_table(pa.table({"a": repeated("x" * 1_000_000, 3700)}), path, compression="zstd")


def one_number(path: Path) -> None:
    with pq.ParquetWriter(path, pa.schema({"a": pa.int64()}), compression="zstd") as writer:
        for _ in range(10):
            writer.write_table(pa.table({"a": repeated(7, 1_000_000).dictionary_decode()}))


def zeros(path: Path) -> None:
    """Distinct texts that compress a thousandfold."""
    texts = [f"{number:04}" + "0" * 1_000_000 for number in range(70)]
    pq.write_table(pa.table({"a": texts}), path, compression="zstd", use_dictionary=False)


def lists(path: Path) -> None:
    """Long texts in lists, which no dictionary keeps small in memory."""
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * 400, pa.int32()), pa.array(["x" * 500_000]))
    nested = pa.ListArray.from_arrays(pa.array(range(0, 401, 4), pa.int32()), texts.dictionary_decode())
    pq.write_table(pa.table({"a": nested}), path, compression="zstd")


@pytest.mark.parametrize(
    "make",
    [one_long_text, lists, *(pytest.param(make, marks=pytest.mark.slow) for make in (one_number, zeros))],
    ids=lambda make: make.__name__,
)
def test_a_small_file_that_stands_for_much_is_refused_before_its_cells_are_in_memory(
    make: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet_files, "MOST_BYTES", BOUND)
    make(tmp_path / "x.parquet")
    assert (tmp_path / "x.parquet").stat().st_size < 3_000_000
    pool = pa.proxy_memory_pool(pa.default_memory_pool())
    before = pa.default_memory_pool()
    pa.set_memory_pool(pool)
    try:
        refused = pytest.raises(TooLargeError, match="expected at most 67,108,864")
        with open_parquet(tmp_path / "x.parquet", "export") as parquet, refused:
            read_parquet(parquet)
    finally:
        pa.set_memory_pool(before)
    assert pool.max_memory() < 3 * BOUND


def test_more_values_than_python_can_hold_are_refused_by_their_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet_files, "MOST_VALUES", 999_999)
    pq.write_table(pa.table({"a": [True] * 1_000_000, "b": [1] * 1_000_000}), tmp_path / "x.parquet")
    refused = pytest.raises(TooLargeError, match="its cells have 1,000,000 values once they are read")
    with open_parquet(tmp_path / "x.parquet", "export") as parquet, refused:
        read_parquet(parquet, ["a"])


def table() -> Any:
    return pa.table(
        {
            "text": ["a", None, "b", "a"] * 3000,
            "number": pa.array([1, None, 3, 2**60] * 3000),
            "list": [[1.0], [], None, [2.0, 3.0]] * 3000,
            "image": [{"bytes": b"\x00\xff", "path": None}, {"bytes": None, "path": "x"}] * 6000,
            "decimal.point": pa.array(["x.y"] * 12000),
        }
    )


@pytest.mark.parametrize("rows", [100, 12000])
def test_cells_are_those_that_pyarrow_reads(tmp_path: Path, rows: int) -> None:
    pq.write_table(table(), tmp_path / "x.parquet", row_group_size=rows)
    for columns in (None, ["number", "text"], ["image"], ["decimal.point"], ["list"]):
        for groups in (None, [0]):
            expected = pq.ParquetFile(tmp_path / "x.parquet")
            row_groups = list(range(expected.num_row_groups)) if groups is None else groups
            with open_parquet(tmp_path / "x.parquet", "export") as parquet:
                read_table = read_parquet(parquet, columns, groups)
            due = expected.read_row_groups(row_groups, columns=columns)
            assert read_table.to_pydict() == due.to_pydict()
            assert read_table.schema == due.schema


def test_an_empty_table_has_its_columns(tmp_path: Path) -> None:
    pq.write_table(table().slice(0, 0), tmp_path / "x.parquet")
    with open_parquet(tmp_path / "x.parquet", "export") as parquet:
        assert read_parquet(parquet, ["text", "number"]).to_pydict() == {"text": [], "number": []}


def test_a_group_of_no_rows_has_texts_in_lists(tmp_path: Path) -> None:
    path = tmp_path / "none.parquet"
    pq.write_table(pa.table({"a": pa.array([], pa.list_(pa.string()))}), path)
    with open_parquet(path, "export") as file:
        assert read_parquet(file).num_rows == 0
