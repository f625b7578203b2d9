"""How a command ends that does not end well: one message, an exit code, and never a traceback on the terminal."""

import errno
import os
import sys
import tempfile
import traceback
from pathlib import Path

from probe_kit._terminal.console import complain, marked, say
from probe_kit.errors import DiskSpaceError, PolicyFailedError, ProbeKitError, UsageError

INTERRUPTED = 130
UNFORESEEN = 1

_FULL = {errno.ENOSPC: "is full", errno.EDQUOT: "has no quota left for you", errno.EROFS: "is read-only"}
_UNUSABLE = {
    errno.EACCES, errno.EBUSY, errno.EEXIST, errno.EINVAL, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG,
    errno.ENODEV, errno.ENOENT, errno.ENOTDIR, errno.ENOTEMPTY, errno.ENXIO, errno.EPERM, errno.ETXTBSY,
}  # fmt: skip
"""What the system says of a path that cannot be what it was given for."""
_LONGEST = 300
"""Characters of an unforeseen error's message that are shown; all of it is in the file."""


def report_error(error: BaseException) -> int:
    """Say on stderr what ended a command; the exit code it ends with.

    1: the result is not what was asked, or nobody foresaw this, and then the traceback is in a file that is named.
    2: an argument or a path that was given cannot be used. 3: refused, or the disk is full or read-only.
    """
    if isinstance(error, KeyboardInterrupt):
        say(marked("[yellow]interrupted[/]; everything finished so far is kept, the same command continues"))
        return INTERRUPTED
    if isinstance(error, ProbeKitError):
        return _complain(error)
    if isinstance(error, OSError) and error.errno in _FULL:
        where = error.filename2 or error.filename or "what was to be written"
        return _complain(
            DiskSpaceError(
                f"the disk of {where} {_FULL[error.errno]}; what was finished before is whole and kept. Make "
                "room or choose a place on another disk, then give the same command again"
            )
        )
    if isinstance(error, OSError) and error.errno in _UNUSABLE and error.filename is not None:
        where = _path(error.filename2 or error.filename)
        return _complain(UsageError(f"{where} cannot be used: {error.strerror}. Give another path"))
    if isinstance(error, SystemExit):
        return _complain(
            PolicyFailedError(
                f"code that probe_kit called ended the process (sys.exit with {error.code!r}); a policy or family "
                "must raise an error instead. What was finished before is kept"
            )
        )
    return report_unexpected(error)


def _complain(error: ProbeKitError) -> int:
    complain(type(error).__name__, str(error), getattr(error, "__notes__", []))
    return error.exit_code


def _path(name: str | bytes | int) -> str:
    return os.fsdecode(name) if isinstance(name, str | bytes) else f"file descriptor {name}"


def report_unexpected(error: BaseException) -> int:
    """Say in one line that nobody foresaw `error`, and where its traceback was written; the exit code."""
    first = (str(error).strip().splitlines() or ["no message"])[0][:_LONGEST]
    hint = "Use fewer --batch, --workers or --items. " if isinstance(error, MemoryError) else ""
    complain(
        "Unforeseen",
        f"{type(error).__name__}: {first}. {hint}This is a defect, of probe_kit or of what it runs; what was "
        f"finished before is kept. The traceback is in {_written(error)}; please report it",
    )
    return UNFORESEEN


def _written(error: BaseException) -> str:
    """Where the traceback is now."""
    text = "".join(traceback.format_exception(error))
    try:
        handle, name = tempfile.mkstemp(prefix="probe-kit-", suffix="-traceback.txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"probe-kit {' '.join(sys.argv[1:])}\n\n{text}")
    except OSError as problem:
        return f"no file ({problem.strerror}; set TMPDIR to a folder that can be written)"
    return str(Path(name))
