"""The archive of a study as a folder or zip file, and the sums of its files.

study.toml      the file of the study
pack.json       a record of the study, its suite, its runs and their keys, and what was left out
runs/           runs as `copy_run` makes them
tables/         every table as JSON, Markdown and LaTeX
SHA256SUMS      of all other files, as `sha256sum --check` reads them

An archive may come from anyone. Its sums name every file, and no other file is read. It holds no links. Sizes are
read before content.
"""

import atexit
import hashlib
import os
import re
import shutil
import stat
import tempfile
import zlib
from collections import Counter
from functools import cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final, Literal, Self
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile, ZipInfo

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from probe_kit._system.bounded_files import check_no_pointer, parse_json, read_regular
from probe_kit._system.complaints import in_words
from probe_kit._tables.content import Cell, Heading, TableRow, absent
from probe_kit._tables.table import Table
from probe_kit.errors import DiskSpaceError, RunDamagedError, UsageError

PACK_FILE, STUDY_FILE, SUMS_FILE = "pack.json", "study.toml", "SHA256SUMS"
RUNS, TABLES = "runs", "tables"
SCHEMA: Final = 2
MOST_FILES, MOST_BYTES, MOST_RECORD_BYTES = 1_000_000, 256 << 30, 64 << 20
"""Bounds of an archive: its files, their bytes together, and the bytes of `pack.json` and `SHA256SUMS`."""
MOST_NAME_BYTES = 255
"""Largest number of bytes of a name with its folders, which any file system takes below a folder of one's own."""
MOST_EXPANSION, FREE_EXPANSION = 200, 64 << 20
"""Bytes that a byte of a zip file may unpack to, and bytes that are free of this bound. JSON gives 10 to 30."""
_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every member, the first that a zip file can hold: an archive made again has the same bytes."""
_RESTORE = "Fetch the archive again, or make it anew with `probe-kit study pack`"
_DEVICE = re.compile(r"(aux|con|nul|prn|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE)
"""A name that Windows gives to a device, whatever its ending is."""
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PackedSuite(_Part):
    """The suite of an archive.

    Attributes:
        identity: `name@version`.
        items: Number of items by category.
    """

    identity: str
    items: dict[str, NonNegativeInt]


class PackedRun(_Part):
    """A run of an archive.

    Attributes:
        key: The key in its folder's name.
        settings_sha256: Hash of its settings with the weights' hash.
    """

    key: str = Field(pattern=r"^[0-9a-f]{8}$")
    settings_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class Pack(_Part):
    """The content of `pack.json`.

    Attributes:
        study: Name of the study.
        version: Version of probe_kit.
        runs: Runs by name, such as `base/plain`.
        missing: Runs and tables that are not there, each with the reason.
        left_out: Kinds of files that were not packed.
    """

    study: str
    version: str
    suite: PackedSuite
    runs: dict[str, PackedRun]
    missing: dict[str, str]
    left_out: list[str]
    schema_version: Literal[2] = SCHEMA

    def to_json(self) -> str:
        """Return the text of `pack.json`."""
        return self.model_dump_json(indent=1)

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the record in a folder.

        Args:
            folder: Folder of an archive.

        Raises:
            RunDamagedError: If the file is no record of an archive.
            UsageError: If it is of another version.
        """
        file = folder / PACK_FILE
        try:
            content: Any = parse_json(_read_bounded(file))
        except ValueError as error:
            raise RunDamagedError(f"{file} is no record of an archive ({error}). {_RESTORE}") from error
        schema = content.get("schema_version") if isinstance(content, dict) else None
        if type(schema) is int and schema != SCHEMA:
            raise UsageError(f"{folder} is an archive of schema {schema}; this version reads {SCHEMA}")
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise RunDamagedError(f"{file} is no record of an archive ({in_words(error)}). {_RESTORE}") from error


def open_archive(name: str | Path) -> Path | None:
    """Return the folder of an archive, unpacked for this process if it is a zip file; None if there is no archive.

    Args:
        name: A folder or a zip file.

    Raises:
        RunDamagedError: Where a file is missing, was added, or has other bytes than were packed, and for a link or
            a zip file beyond the bounds.
    """
    path = Path(name)
    if path.is_dir():
        if not (path / PACK_FILE).is_file():
            return None
        check_sums(path)
        return path
    return _unpack_archive(path.resolve()) if path.is_file() and path.suffix == ".zip" else None


@cache
def _unpack_archive(file: Path) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="probe-kit-pack-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    check_no_pointer(file)
    try:
        with ZipFile(file) as archive:
            _unpack(archive, file, folder)
    except (BadZipFile, zlib.error, EOFError, NotImplementedError, UnicodeDecodeError) as error:
        raise RunDamagedError(f"{file} is no whole zip file ({error}). {_RESTORE}") from error
    except RuntimeError as error:  # a member that asks for a password
        raise RunDamagedError(f"{file} cannot be read ({error}). {_RESTORE}") from error
    if not (folder / PACK_FILE).is_file():
        raise UsageError(f"{file} is no archive of a study: it has no {PACK_FILE}")
    check_sums(folder)
    return folder


def _unpack(archive: ZipFile, file: Path, folder: Path) -> None:
    """Write the members of a zip file, once names, kinds and sizes of all of them are found acceptable."""
    members = [member for member in archive.infolist() if not member.is_dir()]
    names = Counter(member.filename for member in members)
    if twice := [name for name, count in names.items() if count > 1]:
        raise RunDamagedError(f"{file} has two files called {twice[0]!r}. {_RESTORE}")
    for member in members:
        kind = stat.S_IFMT(member.external_attr >> 16)  # 0 of a packer that notes no kinds
        if kind not in (0, stat.S_IFREG):
            raise RunDamagedError(f"{file} has {member.filename!r}, which is no regular file. {_RESTORE}")
        _check_name(member.filename, str(file))
    packed, unpacked = file.stat().st_size, sum(member.file_size for member in members)
    _check_sizes(len(members), unpacked, str(file))
    if unpacked > FREE_EXPANSION and unpacked > MOST_EXPANSION * packed:
        raise RunDamagedError(
            f"{file} has {packed:,} bytes and unpacks to {unpacked:,}; expected at most {MOST_EXPANSION} times as "
            f"many. {_RESTORE}"
        )
    if unpacked > (free := shutil.disk_usage(folder).free):
        raise DiskSpaceError(
            f"{file} unpacks to {unpacked:,} bytes, and {folder.parent} has {free:,} free. Set TMPDIR to another "
            "disk"
        )
    for member in members:
        target = folder / member.filename
        try:  # where file systems fold case, two names may be one
            target.parent.mkdir(parents=True, exist_ok=True)
            unpacked_file = target.open("xb")
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise RunDamagedError(
                f"{file} has {member.filename!r}, and a file and a folder of one name. {_RESTORE}"
            ) from error
        with archive.open(member) as source, unpacked_file:
            shutil.copyfileobj(source, unpacked_file)  # zipfile ends at the size that the member declares


def _check_name(name: str, where: str) -> None:
    """Raise RunDamagedError for a name that is not the plain name of a file below a folder, on any system."""
    path = PurePosixPath(name)
    plain = path.as_posix() == name and not path.is_absolute() and ".." not in path.parts and "\\" not in name
    of_windows = PureWindowsPath(name).drive or any(_DEVICE.fullmatch(part) for part in path.parts)
    if not plain or of_windows or not name.isprintable() or len(name.encode()) > MOST_NAME_BYTES:
        raise RunDamagedError(f"{where} names {name!r}, which is no file below its folder. {_RESTORE}")


def _check_sizes(files: int, size: int, where: str) -> None:
    if files > MOST_FILES or size > MOST_BYTES:
        raise RunDamagedError(
            f"{where} has {files:,} files of {size:,} bytes; an archive has at most {MOST_FILES:,} of "
            f"{MOST_BYTES:,}. {_RESTORE}"
        )


def _read_bounded(file: Path) -> bytes:
    """Return the bytes of `pack.json` or of the sums.

    Raises:
        RunDamagedError: For more bytes than such a file has.
    """
    try:
        return read_regular(file, MOST_RECORD_BYTES)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise RunDamagedError(f"{file}: {error.strerror}. {_RESTORE}") from error


def write_zip(folder: Path, out: Path) -> None:
    """Write the files of a folder as a zip file whose bytes depend on theirs alone."""
    with ZipFile(out, "w", ZIP_DEFLATED) as archive:
        for file in files_of(folder):
            info = ZipInfo(file.relative_to(folder).as_posix(), _DATE)
            info.compress_type, info.external_attr = ZIP_DEFLATED, (stat.S_IFREG | 0o644) << 16
            info.file_size = file.stat().st_size  # by which zipfile decides whether sizes take 64 bits
            with file.open("rb") as source, archive.open(info, "w") as member:
                shutil.copyfileobj(source, member)


def files_of(folder: Path) -> list[Path]:
    """Return all files below a folder, in order.

    Raises:
        RunDamagedError: For a link, pipe or device there.
    """
    files = []
    for home, folders, names in os.walk(folder):
        for path in (Path(home) / name for name in (*folders, *names)):
            kind = path.lstat().st_mode
            if stat.S_ISREG(kind):
                files.append(path)
            elif not stat.S_ISDIR(kind):
                raise RunDamagedError(
                    f"{path} is a link or no regular file; an archive has regular files and folders. {_RESTORE}"
                )
    return sorted(files)


def write_sums(folder: Path) -> None:
    """Write `SHA256SUMS` of all other files below a folder."""
    lines = [
        f"{_digest(file)}  {file.relative_to(folder).as_posix()}\n"
        for file in files_of(folder)
        if file != folder / SUMS_FILE
    ]
    (folder / SUMS_FILE).write_text("".join(lines), encoding="utf-8")


def check_sums(folder: Path) -> None:
    """Raise RunDamagedError, naming the file, where one is missing, has other bytes, or was added."""
    sums = folder / SUMS_FILE
    if not sums.is_file():
        raise RunDamagedError(f"{folder} has no {SUMS_FILE}. {_RESTORE}")
    files = files_of(folder)  # first: no link is followed
    _check_sizes(len(files), sum(file.stat().st_size for file in files), str(folder))
    expected = _read_sums(sums)
    present = {file.relative_to(folder).as_posix(): file for file in files if file != sums}
    for name, digest in expected.items():
        if name not in present:
            raise RunDamagedError(f"{folder / name} is missing. {_RESTORE}")
        if _digest(present[name]) != digest:
            raise RunDamagedError(f"{folder / name} has other bytes than were packed. {_RESTORE}")
    for name in present:
        if name not in expected:
            raise RunDamagedError(f"{folder / name} was not packed: {SUMS_FILE} does not have it. {_RESTORE}")


def _read_sums(file: Path) -> dict[str, str]:
    """Return the digests by name.

    Raises:
        RunDamagedError: For a wrong line, and for a name that leads out of the folder or is listed twice.
    """
    try:
        lines = _read_bounded(file).decode("utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise RunDamagedError(f"{file} is no UTF-8 text ({error}). {_RESTORE}") from error
    if lines.pop():
        raise RunDamagedError(f"{file} ends within a line. {_RESTORE}")
    sums: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        parts = _LINE.fullmatch(line)
        if parts is None:
            raise RunDamagedError(f"{file}, line {number}: {line[:80]!r} is no sha256 and name. {_RESTORE}")
        _check_name(parts[2], f"{file}, line {number}")
        if parts[2] in sums:
            raise RunDamagedError(f"{file} names {parts[2]!r} twice. {_RESTORE}")
        sums[parts[2]] = parts[1]
    return sums


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# -- tables as plain values ---------------------------------------------------------------------------------------


def table_record(table: Table) -> dict[str, Any]:
    """Return a table as plain values, from which `table_of_record` makes it again."""
    return {
        "title": table.title,
        "notes": list(table.all_notes),
        "names": table.names,
        "headings": [[heading.group, heading.text] for heading in table.headings],
        "are_numeric": list(table.are_numeric),
        "rows": [
            {"cells": cells, "is_mean": row.is_mean} for cells, row in zip(table.texts, table.rows, strict=True)
        ],
        "numbers": list(table.numbers),
    }


def table_of_record(record: dict[str, Any]) -> Table:
    """Return the table of a record.

    Raises:
        KeyError: If the record lacks a part of a table.
        TypeError: If a part has another type.
        ValueError: If a part has another form.
    """
    headings = tuple(Heading(str(text), group=str(group)) for group, text in record["headings"])
    # An older archive has texts alone, without a flag per column.
    are_numeric = record.get("are_numeric", [False] * len(headings))

    def row(cells: list[Any], is_mean: bool) -> TableRow:
        texts = zip(map(str, cells), are_numeric, strict=True)
        return TableRow(tuple(absent(text) if is_numeric else Cell(text) for text, is_numeric in texts), is_mean)

    return Table(
        title=str(record["title"]),
        headings=headings,
        rows=tuple(row(each["cells"], bool(each["is_mean"])) for each in record["rows"]),
        names=int(record["names"]),
        notes=tuple(map(str, record["notes"])),
        numbers=tuple(record["numbers"]),
    )
