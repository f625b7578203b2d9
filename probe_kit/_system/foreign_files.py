"""Files of the user that a library reads or validates: what it raises becomes an error that names the file.

A library's own error names a class or a line of its code, and seldom the file and the field that are wrong.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from probe_kit._system.bounded_files import check_no_pointer, check_no_pointers
from probe_kit._system.machine import is_out_of_memory
from probe_kit.errors import CheckpointError, ProbeKitError

_LONGEST = 500


@contextmanager
def while_reading(
    path: Path,
    raises: type[ProbeKitError] = CheckpointError,
    advice: str = "Correct it, or take the original file",
    names: tuple[str, ...] = (),
) -> Iterator[None]:
    """Turn errors of a library that reads a file, or validates its values, in the body into one that names it.

    Args:
        path: The file, or a folder of which the library chooses the files.
        raises: The class of the error.
        advice: The end of the message: a sentence without a period that says what to do.
        names: The beginnings of the names of the files that it reads in a folder.

    Raises:
        ProbeKitError: For any error but one of ours, of class `raises`, with the library's reason. An error of
            memory that ended is raised as it is.
        LfsPointerError: For a Git LFS pointer; in a folder only where the library fails.
    """
    if not path.is_dir():
        check_no_pointer(path)
    try:
        yield
    except ProbeKitError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise  # the file may be whole: the machine is too small for it
        check_no_pointers(path)
        raise raises(f"{_locate(path, names)} cannot be read: {reason_of(error)}. {advice}") from error


def reason_of(error: BaseException) -> str:
    """Return the class and the first line of an error, and of the error that it was raised from."""
    root = error
    while root.__cause__ is not None:
        root = root.__cause__
    return _first_line(error) + ("" if root is error or str(root) in str(error) else f" ({_first_line(root)})")


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or ["no message"]
    first = " ".join(lines[:2]) if lines[0].endswith(":") else lines[0]
    return f"{type(error).__name__}: {first[:_LONGEST].rstrip('.')}"


def _locate(path: Path, names: tuple[str, ...]) -> str:
    files = sorted(file.name for file in path.glob("*") if file.name.startswith(names)) if names else []
    return f"{', '.join(files)} in {path}" if files else str(path)
