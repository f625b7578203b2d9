"""What a library says of a file of the user becomes an error that names the file, unless memory ended."""

import errno
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pyarrow as pa
import pytest
import torch

from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, ProbeKitError, RecordingError
from probe_kit.hooks.checkpoints.third_party import while_acting, while_loading

READERS: dict[str, Callable[[Path], AbstractContextManager[None]]] = {
    "a file": while_reading,
    "a recording": lambda path: while_reading(path, RecordingError),
    "a checkpoint": lambda path: while_loading("pi0", str(path)),
    "a policy that acts": lambda path: while_acting("pi0", str(path)),
}
ENDS_OF_MEMORY = [
    MemoryError(),
    pa.ArrowMemoryError("malloc of size 8796093022208 failed"),
    torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
    OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("error", ENDS_OF_MEMORY, ids=lambda error: type(error).__name__)
def test_memory_that_ends_while_a_file_is_read_says_nothing_against_the_file(
    reader: str, error: Exception, tmp_path: Path
) -> None:
    with pytest.raises(type(error)) as raised, READERS[reader](tmp_path):
        raise error
    assert raised.value is error


@pytest.mark.parametrize("reader", READERS)
def test_any_other_error_names_what_was_read(reader: str, tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    with pytest.raises(ProbeKitError, match="no such field 7") as raised, READERS[reader](file):
        raise KeyError("no such field 7")
    assert str(file) in str(raised.value)


def test_the_reason_is_that_of_the_library_and_of_its_cause() -> None:
    expected = r"ParsingError: no policy \(ValueError: 50 is too many\)"
    with pytest.raises(CheckpointError, match=expected), while_reading(Path("config.json")):
        raise type("ParsingError", (Exception,), {})("no policy") from ValueError("50 is too many")
