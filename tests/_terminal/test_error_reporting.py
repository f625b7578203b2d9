"""However a command ends, it says one thing, gives a code, and shows no traceback."""

import errno
import os
import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from probe_kit._terminal.error_reporting import report_error
from probe_kit.cli import Commands
from probe_kit.errors import CheckpointError, WeightsError


def ended(error: BaseException) -> tuple[int, str]:
    """A command that raises `error`, as the command line ends it."""
    app = typer.Typer(cls=Commands, pretty_exceptions_enable=False)

    @app.callback()
    def _before() -> None: ...

    @app.command()
    def fail() -> None:
        raise error

    answer = CliRunner().invoke(app, ["fail"])
    return answer.exit_code, " ".join(answer.output.split())


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (KeyboardInterrupt(), 130, "run the same command to resume"),
        (WeightsError("torn"), 3, "WeightsError: torn"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/x"), 3, "the disk of run/x is full"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), 3, "is full"),
        (OSError(errno.EROFS, os.strerror(errno.EROFS), "run"), 3, "the disk of run is read-only"),
        (OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), "run"), 3, "quota"),
        (OSError(errno.EFBIG, os.strerror(errno.EFBIG), "run"), 3, "no file so large"),
        (
            PermissionError(errno.EACCES, "Permission denied", "there"),
            2,
            "there cannot be used: Permission denied",
        ),
        (FileNotFoundError(errno.ENOENT, "No such file", "there"), 2, "there cannot be used"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a" * 300), 2, "too long"),
        (OSError(errno.ELOOP, "Too many levels of symbolic links", b"loop"), 2, "loop cannot be used"),
        (SystemExit(0), 1, "sys.exit with 0"),
        (SystemExit("bye"), 1, "sys.exit with 'bye'"),
    ],
)
def test_what_can_be_foreseen_has_its_message_and_code(error: BaseException, code: int, words: str) -> None:
    ended_with, message = ended(error)
    assert ended_with == code
    assert words in message
    assert "Traceback" not in message


@pytest.mark.parametrize(
    "error",
    [KeyError("x"), ValueError("one\ntwo"), RecursionError("deep"), OSError(5, "I/O error")],
)
def test_an_unexpected_error_prints_one_line_and_writes_a_file(
    error: Exception, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code, message = ended(error)
    assert code == 1
    assert type(error).__name__ in message
    assert "Traceback" not in message
    (file,) = tmp_path.iterdir()
    assert str(file) in message.replace(" ", "") or file.name in message.replace(" ", "")
    assert re.search(r"Traceback.*in fail", file.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 7.28 TiB for an array with shape (1000000000000,)"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        RuntimeError("MPS backend out of memory (MPS allocated: 9 GB)"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    ],
)
def test_memory_that_ended_is_no_bug_and_says_what_to_do(error: Exception, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code, message = ended(error)
    assert code == 1
    assert (str(error) or "larger than the memory") in " ".join(message.split())
    assert "fewer --batch" in message
    assert "bug" not in message
    assert not list(tmp_path.iterdir())


def test_a_traceback_that_cannot_be_written_is_said_to_be_lost(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    assert report_error(KeyError("x")) == 1
    assert "set TMPDIR" in capsys.readouterr().err


def test_what_an_error_says_is_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    error = CheckpointError("[bold]config[/] \x1b[31m")
    error.add_note("in [red]this\u202e")
    assert report_error(error) == 3
    message = capsys.readouterr().err
    assert "[bold]config[/] ␛[31m" in message
    assert "in [red]this\ufffd" in message
