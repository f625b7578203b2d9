"""The archive of a study as a folder or zip file, and the sums of its files.

study.toml      the file of the study
pack.json       a record of the study, its suite, its runs and their keys, and what was left out
runs/           runs as `copy_run` makes them
tables/         every table as JSON, Markdown and LaTeX
SHA256SUMS      of all other files, as `sha256sum --check` reads them
"""

import atexit
import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Self
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile, ZipInfo

from probe_kit._system.bounded_json import parse_json
from probe_kit.errors import RunDamagedError, UsageError

PACK_FILE, STUDY_FILE, SUMS_FILE = "pack.json", "study.toml", "SHA256SUMS"
RUNS, TABLES = "runs", "tables"
SCHEMA = 1
_DATE = (1980, 1, 1, 0, 0, 0)
_RESTORE = "Fetch the archive again, or make it anew with `probe-kit study pack`"


@dataclass(frozen=True)
class Pack:
    """What `pack.json` says.

    study: its name. suite: `identity` and `items` by category. keys: by name of a run, such as `base/plain`, the
    key in its folder's name. missing: runs and tables that are not there, each with the reason. left_out: kinds of
    files that were not packed. version: of probe_kit.
    """

    study: str
    version: str
    suite: dict[str, Any]
    keys: dict[str, str]
    missing: dict[str, str]
    left_out: list[str]
    schema: int = field(default=SCHEMA)

    def to_json(self) -> str:
        """As stored."""
        return json.dumps(asdict(self), indent=1, ensure_ascii=False)

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The record in a folder. Raises RunDamagedError if it is none, UsageError if it is of another version."""
        try:
            found = parse_json((folder / PACK_FILE).read_bytes())
            if (schema := found["schema"]) != SCHEMA:
                raise UsageError(f"{folder} is an archive of schema {schema}; this version reads {SCHEMA}")
            return cls(**found)
        except (ValueError, TypeError, KeyError) as error:
            raise RunDamagedError(
                f"{folder / PACK_FILE} is no record of an archive ({error!r}). {_RESTORE}"
            ) from error


def open_archive(name: str | Path) -> Path | None:
    """The folder of an archive, unpacked for this process if it is a zip file; None for what is no archive.

    Raises RunDamagedError where a file is missing, was added, or has other bytes than were packed.
    """
    place = Path(name)
    if place.is_dir():
        if not (place / PACK_FILE).is_file():
            return None
        check_sums(place)
        return place
    return _unpacked(place.resolve()) if place.is_file() and place.suffix == ".zip" else None


@cache
def _unpacked(file: Path) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="probe-kit-pack-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    try:
        with ZipFile(file) as archive:
            archive.extractall(folder)
    except BadZipFile as error:
        raise RunDamagedError(f"{file} is no whole zip file ({error}). {_RESTORE}") from error
    if not (folder / PACK_FILE).is_file():
        raise UsageError(f"{file} is no archive of a study: it has no {PACK_FILE}")
    check_sums(folder)
    return folder


def write_zip(folder: Path, out: Path) -> None:
    """The files of a folder as a zip file whose bytes depend on theirs alone."""
    with ZipFile(out, "w", ZIP_DEFLATED) as archive:
        for file in files_of(folder):
            info = ZipInfo(file.relative_to(folder).as_posix(), _DATE)
            info.compress_type, info.external_attr = ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, file.read_bytes())


def files_of(folder: Path) -> Iterator[Path]:
    """All files below a folder, in order."""
    yield from sorted(file for file in folder.rglob("*") if file.is_file())


def write_sums(folder: Path) -> None:
    """`SHA256SUMS` of all other files below a folder."""
    lines = [
        f"{_digest(file)}  {file.relative_to(folder).as_posix()}\n"
        for file in files_of(folder)
        if file.name != SUMS_FILE
    ]
    (folder / SUMS_FILE).write_text("".join(lines), encoding="utf-8")


def check_sums(folder: Path) -> None:
    """Raise RunDamagedError, naming the file, where one is missing, has other bytes, or was added."""
    if not (folder / SUMS_FILE).is_file():
        raise RunDamagedError(f"{folder} has no {SUMS_FILE}. {_RESTORE}")
    summed = set[Path]()
    for line in (folder / SUMS_FILE).read_text(encoding="utf-8").splitlines():
        digest, _, name = line.partition("  ")
        file = folder / name
        summed.add(file)
        if not file.is_file():
            raise RunDamagedError(f"{file} is missing. {_RESTORE}")
        if _digest(file) != digest:
            raise RunDamagedError(f"{file} has other bytes than were packed. {_RESTORE}")
    for file in files_of(folder):
        if file not in summed and file.name != SUMS_FILE:
            raise RunDamagedError(f"{file} was not packed: {SUMS_FILE} does not have it. {_RESTORE}")


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
