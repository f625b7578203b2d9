"""The one reader of foreign Parquet files: sizes are read and checked before cells fill the memory."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from probe_kit._system.bounded_files import open_regular
from probe_kit._system.imports import require

MOST_BYTES = 1 << 30
"""The most bytes of the cells of one reading, in memory."""
MOST_VALUES = 1 << 25
"""The most numbers and texts of one reading; in Python each takes some 50 bytes."""
MOST_FILE_BYTES = 1 << 40
"""The most bytes of a file, whose footer says before any cell is read how large its columns are."""
_ROWS = 4096
"""The rows of a batch, or fewer, so that a column of texts takes at most `_BATCH_BYTES` in it."""
_BATCH_BYTES = 64 << 20
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "FLOAT": 4, "DOUBLE": 8, "INT96": 12}
"""The bytes of a value in memory, by Parquet's type, of those that have one width."""
_TEXT = "BYTE_ARRAY"


class TooLargeError(OSError):
    """Cells of a Parquet file that would take more memory than the limit."""


@contextmanager
def open_parquet(source: Path | BinaryIO, extra: str) -> Iterator[Any]:
    """Yield a `pyarrow.parquet.ParquetFile`; `read_parquet` reads its cells.

    Texts stay in their dictionaries: a column of one long text in every row is small until it is written out.

    Args:
        source: The file, or its content as a binary file that can seek.
        extra: The extra of probe-kit that installs pyarrow, for the message if pyarrow is missing.

    Raises:
        OSError: For what is no regular file.
        ArrowException: Pyarrow's error for a file of another format.
        MissingExtraError: Without pyarrow.
    """
    parquet = require("pyarrow.parquet", extra)
    if isinstance(source, Path):
        with open_regular(source, MOST_FILE_BYTES) as opened, open_parquet(opened, extra) as file:
            yield file
        return
    metadata = parquet.read_metadata(source)
    columns = [metadata.schema.column(number) for number in range(metadata.num_columns)]
    texts = [column.path for column in columns if column.physical_type == _TEXT and column.path == column.name]
    source.seek(0)
    with parquet.ParquetFile(source, read_dictionary=texts) as file:
        yield file


def read_parquet(parquet: Any, columns: Sequence[str] | None = None, groups: Sequence[int] | None = None) -> Any:
    """Return columns and row groups of a file of `open_parquet` as a `pyarrow.Table`; None stands for all.

    Raises:
        TooLargeError: Before more than `MOST_BYTES` or `MOST_VALUES` are in memory.
    """
    pa = require("pyarrow", "export")

    groups = range(parquet.num_row_groups) if groups is None else groups
    rows = _check_sizes(parquet.metadata, columns, groups)
    total, batches = 0, []
    names = None if columns is None else list(columns)
    for batch in parquet.iter_batches(batch_size=rows, row_groups=list(groups), columns=names):
        total += sum(map(_decoded_bytes, batch.columns))
        _check(total, MOST_BYTES, "bytes")
        plain = [
            column.dictionary_decode() if pa.types.is_dictionary(column.type) else column
            for column in batch.columns
        ]
        fields = [field.with_type(column.type) for field, column in zip(batch.schema, plain, strict=True)]
        batches.append(pa.RecordBatch.from_arrays(plain, schema=pa.schema(fields, batch.schema.metadata)))
    if batches:
        return pa.Table.from_batches(batches)
    return parquet.read_row_groups(list(groups), columns=names)  # no row, and the types of the columns


def _check_sizes(metadata: Any, columns: Sequence[str] | None, groups: Sequence[int]) -> int:
    """Return the rows of a batch, or raise TooLargeError by what the footer says about the uncompressed cells."""
    size, values, longest = 0, 0, 1
    for number in groups:
        group = metadata.row_group(number)
        for at in range(group.num_columns):
            chunk = group.column(at)
            path = chunk.path_in_schema
            if columns is not None and not any(path == name or path.startswith(f"{name}.") for name in columns):
                continue
            width = _WIDTHS.get(chunk.physical_type, 0)
            # Uncompressed cells are still encoded: a column of one number in every row has a few bytes.
            size += max(chunk.total_uncompressed_size, width * chunk.num_values)
            values += chunk.num_values
            if path != metadata.schema.column(at).name and chunk.physical_type not in _WIDTHS:
                # A text inside a list or a struct leaves its dictionary when it is read.
                of_row = -(-chunk.num_values // max(group.num_rows, 1))
                longest = max(longest, chunk.total_uncompressed_size * of_row)
    _check(size, MOST_BYTES, "bytes")
    _check(values, MOST_VALUES, "values")
    return max(1, min(_ROWS, _BATCH_BYTES // longest))


def _check(size: int, most: int, unit: str) -> None:
    if size > most:
        raise TooLargeError(
            f"its cells have {size:,} {unit} once they are read; expected at most {most:,}. Give a smaller "
            "table, or leave columns out"
        )


def _decoded_bytes(array: Any) -> int:
    pa, pc = require("pyarrow", "export"), require("pyarrow.compute", "export")

    if not pa.types.is_dictionary(array.type):
        return int(array.nbytes)
    lengths = pc.binary_length(array.dictionary)
    return int(pc.sum(pc.cast(lengths.take(array.indices), pa.int64())).as_py() or 0) + 4 * len(array)
