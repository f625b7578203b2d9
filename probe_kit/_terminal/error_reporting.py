"""Error reporting: one message and an exit code per error, and no traceback on the terminal."""

import errno
import os
import sys
import tempfile
import traceback
from pathlib import Path

from probe_kit._system.machine import is_out_of_memory
from probe_kit._terminal.console import complain, markup, say
from probe_kit._terminal.interruption import INTERRUPTED
from probe_kit.errors import FULL_DISK, DiskSpaceError, PolicyFailedError, ProbeKitError, UsageError

UNFORESEEN = 1

_FULL = {**FULL_DISK, errno.EROFS: "is read-only"}
_UNUSABLE = {
    errno.EACCES, errno.EBUSY, errno.EEXIST, errno.EINVAL, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG,
    errno.ENODEV, errno.ENOENT, errno.ENOTDIR, errno.ENOTEMPTY, errno.ENXIO, errno.EPERM, errno.ETXTBSY,
}  # fmt: skip
"""The errors of the system for a path that cannot be used as what it was given for."""
_LONGEST = 300
"""The characters of an unforeseen error's message that are shown; the file has the whole message."""


def report_error(error: BaseException) -> int:
    """Print on stderr why a command ended, and return its exit code.

    The code is 1 if the result is not as requested, if memory ended, or if an internal error occurred. The
    traceback of the last is in the file that is named. It is 2 if an argument or a path that was given cannot be
    used. It is 3 if the command refused, or if the disk is full or read-only.
    """
    if isinstance(error, KeyboardInterrupt):
        say(markup("[yellow]interrupted[/]. Completed work is saved; run the same command to resume."))
        return INTERRUPTED
    if isinstance(error, ProbeKitError):
        return _complain(error)
    if isinstance(error, OSError) and error.errno in _FULL:
        where = error.filename2 or error.filename or "what was to be written"
        return _complain(
            DiskSpaceError(
                f"the disk of {where} {_FULL[error.errno]}; completed work is saved. Free "
                "some space or choose another disk, then run the same command to resume"
            )
        )
    if isinstance(error, OSError) and error.errno in _UNUSABLE and error.filename is not None:
        where = _path(error.filename2 or error.filename)
        return _complain(UsageError(f"{where} cannot be used: {error.strerror}. Give another path"))
    if isinstance(error, SystemExit):
        return _complain(
            PolicyFailedError(
                f"code that probe_kit called ended the process (sys.exit with {error.code!r}); a policy or family "
                "must raise an error instead. Completed work is saved"
            )
        )
    if is_out_of_memory(error):
        complain(
            "MemoryError",
            f"memory ended in {_frame(error)}: {_first_line(error)}. Use fewer --batch, --workers or --items, a "
            "smaller input, or a machine with more memory. Completed work is saved; run the same command to "
            "resume",
        )
        return UNFORESEEN
    return report_unexpected(error)


def _frame(error: BaseException) -> str:
    """Return the last function of probe_kit that an error passed, with its module; `a library` without any."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    modules = [(str(frame.f_globals.get("__name__")), frame.f_code.co_name) for frame in frames]
    ours = [f"{name} of {module}" for module, name in modules if module.partition(".")[0] == "probe_kit"]
    return ours[-1] if ours else "a library"


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or ["what it makes is larger than the memory that is left"]
    return lines[0][:_LONGEST].rstrip(".")


def _complain(error: ProbeKitError) -> int:
    complain(type(error).__name__, str(error), getattr(error, "__notes__", []))
    return error.exit_code


def _path(name: str | bytes | int) -> str:
    return os.fsdecode(name) if isinstance(name, str | bytes) else f"file descriptor {name}"


def report_unexpected(error: BaseException) -> int:
    """Report an internal error in one line, with the file of its traceback, and return the exit code."""
    first = (str(error).strip().splitlines() or ["no message"])[0][:_LONGEST]
    complain(
        "InternalError",
        f"{type(error).__name__}: {first}. This is a bug in probe_kit or in a library it calls. "
        f"Completed work is saved. The traceback is in {_write_report(error)}; please report it",
    )
    return UNFORESEEN


def _write_report(error: BaseException) -> str:
    text = "".join(traceback.format_exception(error))
    try:
        handle, name = tempfile.mkstemp(prefix="probe-kit-", suffix="-traceback.txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"probe-kit {' '.join(sys.argv[1:])}\n\n{text}")
    except OSError as problem:
        return f"no file ({problem.strerror}; set TMPDIR to a folder that can be written)"
    return str(Path(name))
