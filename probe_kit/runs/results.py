"""Bundles: results stored with a run, one folder each, either complete or absent; and pieces of unfinished ones.

    <home>/<key>/settings.json    the head, a record written last: what it is, whose, and the sums of its files
    <home>/<key>/times.json       a record of when it was made, which no other hash covers
    <home>/<key>/<file>           what the head names; anything else there is not read
    <home>/.<key>.partial/        work that is not finished; only then may a folder lie there without a head

Of the same settings and the same run, every file but `times.json` has the same bytes, killed and resumed or not.
Files are never written over: what changes gets another name, and counts when the head names it.
"""

import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, fields
from io import BytesIO
from pathlib import PurePosixPath
from typing import Annotated, Any, BinaryIO, ClassVar, TypeVar
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, PlainSerializer

from probe_kit._system.bounded_files import open_arrays, parse_json
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.runs.layout import DIAGNOSES, INTERVENTIONS, PROBES
from probe_kit.runs.records import DIGEST_BYTES, Checksum, Record, digest, digest_of, parse_sum
from probe_kit.runs.root import Root, find_root
from probe_kit.runs.store import Location

Parsed = TypeVar("Parsed")
BUNDLES = (PROBES, INTERVENTIONS, DIAGNOSES)
"""The folders of a run that hold bundles."""
_MAKERS = {PROBES: "train", INTERVENTIONS: "intervene", DIAGNOSES: "diagnose"}
HEAD, TIMES, PARTIAL = "settings.json", "times.json", ".partial"
_KEY = re.compile(r"[0-9a-f]{12}")
"""The form of a key: the first digits of the hash of the settings of a result."""
_SHORT = 8
"""The digits of its hash in the name of a file that replaces another."""


def _parse_file(values: Any) -> tuple[str, Checksum]:
    """Return the actual name and the sum of a file, as a head stores them. Raises ValueError for anything else."""
    match values:
        case [str(actual), *known]:
            return actual, parse_sum(known)
    raise ValueError("expected name, length and hash of a file")


def _file_json(file: tuple[str, Checksum]) -> list[str | int]:
    return [file[0], *file[1].to_json()]


class Head(Record):
    """The record `settings.json`. Producers add parts of their own.

    Attributes:
        files: The actual name, length and hash of every file, by name.
    """

    model_config = ConfigDict(extra="allow")
    kind: ClassVar[str] = "head"
    key: str
    run: str | None
    settings: dict[str, Any]
    files: dict[str, Annotated[tuple[str, Checksum], BeforeValidator(_parse_file), PlainSerializer(_file_json)]]


class Times(Record):
    """The record `times.json`: times of events by name, UTC in ISO 8601."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, str]
    kind: ClassVar[str] = "record of times"
    key: str
    run: str | None


@dataclass(frozen=True)
class Bundle:
    """A bundle whose head is checked; files are checked when they are read.

    Attributes:
        head: The settings of the producer.
        times: The times of the producer's events by name (UTC, ISO 8601).
        files: The name that counts now and the sum of every file, by the name asked for.
    """

    location: Location
    home: str
    key: str
    head: Mapping[str, Any]
    times: Mapping[str, str]
    files: Mapping[str, tuple[str, Checksum]]

    @property
    def folder(self) -> str:
        """The bundle's folder in the run."""
        return f"{self.home}/{self.key}"

    def has(self, name: str) -> bool:
        """Whether the bundle has a file of this name."""
        return name in self.files

    def read(self, name: str) -> bytes:
        """Return the content of one file. Raises RunDamagedError if it is missing or was changed."""
        try:
            content = self.location.read(self._location_of(name))
        except FileNotFoundError:
            raise self.damaged(name, "is missing") from None
        if problem := self.files[name][1].problem(content):
            raise self.damaged(name, problem)
        return content

    def open(self, name: str) -> BinaryIO:
        """Open one file for random access; `check` compares it with its hash."""
        try:
            return self.location.open(self._location_of(name))
        except FileNotFoundError:
            raise self.damaged(name, "is missing") from None

    def check(self, name: str) -> None:
        """Read one file to its end, a piece at a time. Raises RunDamagedError if it was changed."""
        try:
            _, digest = digest_of(self.location.pieces(self._location_of(name)))
        except FileNotFoundError:
            raise self.damaged(name, "is missing") from None
        if digest != self.files[name][1].digest:
            raise self.damaged(name, "has other bytes than were written")

    def _location_of(self, name: str) -> str:
        if name not in self.files:
            raise self.head_damaged(f"names no file {name}")
        return f"{self.folder}/{self.files[name][0]}"

    def read_json(self, name: str) -> dict[str, Any]:
        """Return the JSON object in one file, in which numbers may be NaN. Raises RunDamagedError."""
        try:
            content = parse_json(self.read(name))
        except ValueError as error:
            raise self.damaged(name, f"is not JSON ({error})") from error
        if not isinstance(content, dict):
            raise self.damaged(name, f"holds a {type(content).__name__}, not an object")
        return content

    def read_as(self, name: str, read: Callable[[Mapping[str, Any]], Parsed], *readable: int | str) -> Parsed:
        """Return what a function makes of the JSON object in one file.

        Args:
            name: The name of the file.
            read: The function. A ValueError of it says that the object has other fields.
            *readable: The formats of the bundle that it reads.

        Raises:
            RunDamagedError: For a bundle of another format, and for a file that was changed or has other fields.
        """
        self.check_format(*readable)
        content = self.read_json(name)
        try:
            return read(content)
        except ValueError as error:
            raise self.damaged(name, "has other fields: another version of probe_kit made it") from error

    def check_format(self, *readable: int | str) -> None:
        """Raise RunDamagedError unless the settings say one of these formats."""
        stored = self.head["settings"].get("format")
        if stored not in readable:
            words = " or ".join(map(str, readable))
            raise self.head_damaged(f"has format {stored}; this version of probe_kit reads format {words}")

    def head_damaged(self, problem: str) -> RunDamagedError:
        """Return the error about the head."""
        return RunDamagedError(f"{self.location}/{self.folder}/{HEAD} {problem}. {advice_for(self.folder)}")

    def damaged(self, name: str, problem: str) -> RunDamagedError:
        """Return the error about one file."""
        return RunDamagedError(f"{self.location}/{self._location_of(name)} {problem}. {advice_for(self.folder)}")


def write_bundle(
    location: Location,
    home: str,
    key: str,
    head: Mapping[str, Any],
    files: Mapping[str, bytes] = {},
    times: Mapping[str, str] = {},
) -> None:
    """Store a bundle, or change one. Leftovers of killed processes in its folder are removed.

    Args:
        location: The run, or the folder of arrays in memory.
        home: The folder of bundles, one of `BUNDLES`.
        key: The key of the bundle.
        head: The head without the parts that are added here (`key`, `run`, `files`). It replaces the former one.
        files: The contents by name; former files that are not given stay as they are.
        times: The times of events by name (UTC, ISO 8601), which replace the former ones.
    """
    with location.take_turns(f"{home}/{key}"):
        folder = f"{home}/{key}"
        run, before = _look_up(location, home, key)
        former = dict(before.files) if before else {}
        files_now = dict(former)
        for name, content in files.items():
            content_sum = Checksum.of(content)
            if name not in former or former[name][1] != content_sum:
                actual = name if before is None else _rename_key(name, content_sum)
                location.write(f"{folder}/{actual}", content)
                files_now[name] = actual, content_sum
        # Files, then times, then the head that names them, and only then are former files removed: a crash in
        # between leaves the former result whole.
        location.write(f"{folder}/{TIMES}", Times.model_validate({**times, "key": key, "run": run}).to_bytes())
        stored = {name: [actual, *content_sum.to_json()] for name, (actual, content_sum) in files_now.items()}
        record = Head.model_validate({**head, "key": key, "run": run, "files": stored}).to_bytes()
        if before is None or location.read(f"{folder}/{HEAD}") != record:
            location.write(f"{folder}/{HEAD}", record)
        for name, (actual, _) in former.items():
            if files_now[name][0] != actual:
                location.delete(f"{folder}/{actual}")


def is_complete(location: Location, home: str, key: str) -> bool:
    """Whether the bundle `key` is stored with all its files. One that lost a file is made again, not refused.

    Raises:
        RunDamagedError: If its head was changed, or names a file elsewhere.
    """
    folder = f"{home}/{key}"
    if not location.exists(f"{folder}/{HEAD}"):
        return False
    missing = _missing_files(location, folder, _read_head(location, folder))
    return not missing or _are_left_out(missing, find_root(location))


def _missing_files(location: Location, folder: str, head: Head) -> set[str | None]:
    """Return the names of the files that a bundle lacks; None stands for its times."""
    names: dict[str, str | None] = {TIMES: None} | {actual: name for name, (actual, _) in head.files.items()}
    stored = location.sizes(folder, tuple(names))
    return {name for actual, name in names.items() if actual not in stored}


def _are_left_out(missing: set[str | None], root: Root | None) -> bool:
    """Whether a bundle lacks files on purpose, in a copy without activations."""
    return root is not None and missing <= root.left_out


def tidy_bundle(location: Location, home: str, key: str) -> None:
    """Remove what killed processes left of a complete bundle: files and folders that never counted."""
    with location.take_turns(f"{home}/{key}"):
        location.remove(f"{home}/.{key}{PARTIAL}")


def _rename_key(name: str, content_sum: Checksum) -> str:
    path = PurePosixPath(name)
    return f"{path.stem}-{content_sum.digest[:_SHORT]}{path.suffix}"


def read_bundle(location: Location, home: str, key: str) -> Bundle:
    """Return the bundle `key`. Raises RunDamagedError if head or times are missing, changed, or of another run."""
    return _read_bundle(location, home, key, _identity(location))


def find_bundle(location: Location, home: str, key: str) -> Bundle | None:
    """Return the bundle `key` if it is stored with all its files, else None. Raises as `read_bundle`."""
    return _look_up(location, home, key)[1]


def _look_up(location: Location, home: str, key: str) -> tuple[str | None, Bundle | None]:
    """Return the identity of the run, and what `find_bundle` returns: run and head are read once."""
    folder, root = f"{home}/{key}", find_root(location)
    run = None if root is None else root.identity
    if not location.exists(f"{folder}/{HEAD}"):
        return run, None
    head = _read_head(location, folder)
    if (missing := _missing_files(location, folder, head)) and not _are_left_out(missing, root):
        return run, None
    if (head.key, head.run) != (key, run):
        return run, _read_bundle(location, home, key, run)  # which raises, and says whose head it is
    return run, _with_times(location, home, key, run, head)


def _read_bundle(location: Location, home: str, key: str, run: str | None) -> Bundle:
    return _with_times(location, home, key, run, _read_head(location, f"{home}/{key}", key=key, run=run))


def _with_times(location: Location, home: str, key: str, run: str | None, head: Head) -> Bundle:
    """Return the bundle of a head, with its times."""
    folder = f"{home}/{key}"
    times = Times.read(location, f"{folder}/{TIMES}", advice_for(folder), key=key, run=run)
    parts = {part: value for part, value in head.content.items() if part not in ("key", "run", "files")}
    return Bundle(location, home, key, parts, times.model_extra or {}, head.files)


def _read_head(location: Location, folder: str, **expected: str | None) -> Head:
    head = Head.read(location, f"{folder}/{HEAD}", advice_for(folder), **expected)
    if strange := sorted(
        actual for actual, _ in head.files.values() if "/" in actual or actual in ("", ".", "..")
    ):
        raise RunDamagedError(
            f"{location}/{folder}/{HEAD} names {strange[0]!r}, which is not a file in the same folder. "
            f"{advice_for(folder)}"
        )
    return head


def bundle_keys(location: Location, home: str) -> list[str]:
    """Return the keys of the bundles that should exist: folders of that form, except those being filled."""
    parts = [key.split("/") for key in location.keys(home)]
    names = dict.fromkeys(path[1] for path in parts if len(path) > 2)
    complete = {path[1] for path in parts if path[2:] == [HEAD]}
    return [
        name for name in names if _KEY.fullmatch(name) and (name in complete or f".{name}{PARTIAL}" not in names)
    ]


def unfinished_bundles(location: Location, home: str) -> dict[str, int]:
    """Return by key how many pieces are stored of each bundle whose making was interrupted or failed."""
    parts = (key.split("/") for key in location.keys(home))
    names = [path[1] for path in parts if len(path) > 2 and path[1].startswith(".") and path[1].endswith(PARTIAL)]
    return {name.removeprefix(".").removesuffix(PARTIAL): names.count(name) for name in dict.fromkeys(names)}


def complete_key(key: str, stored: Collection[str], location: Location, kind: str) -> str:
    """Return the stored key that equals or begins with `key`; errors name what is stored by `kind`, in the plural.

    Raises:
        UsageError: If there is none, or if there are several.
    """
    matching = [name for name in stored if name == key] or [
        name for name in stored if key and name.startswith(key)
    ]
    if len(matching) != 1:
        raise UsageError(
            f"{location} has {'several' if matching else 'no'} {kind} {key!r}; it has: "
            f"{', '.join(stored) or 'none'}"
        )
    return matching[0]


def read_bundles(location: Location, home: str) -> dict[str, Bundle]:
    """Return every bundle of a run by key. Raises RunDamagedError for the first that is damaged."""
    run = _identity(location)
    return {key: _read_bundle(location, home, key, run) for key in bundle_keys(location, home)}


def _identity(location: Location) -> str | None:
    """Return the identity of the run; None where there is no run.

    Bundles may also lie where there is no run, beside arrays in memory.
    """
    root = find_root(location)
    return None if root is None else root.identity


def advice_for(folder: str) -> str:
    """Return the remedy for a damaged result."""
    return f"Remove {folder} and run the same `probe-kit {_MAKERS[folder.partition('/')[0]]}` again"


def fields_problem(record: type, names: Collection[str]) -> str:
    """Return how stored arrays differ from the fields of a dataclass, for a message; empty if they do not.

    Fields with a default may be absent.
    """
    expected = fields(record)
    absent = [field.name for field in expected if field.default is MISSING and field.name not in names]
    unknown = sorted(set(names) - {field.name for field in expected})
    parts = [f"lacks {', '.join(absent)}"] * bool(absent) + [f"holds {', '.join(unknown)}"] * bool(unknown)
    return " and ".join(parts)


def axes_problem(axes: Mapping[str, str], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return how stored arrays contradict their types or each other's lengths; empty if they do not.

    Args:
        axes: By array the kinds of its type, as numpy names them, a space, and a letter per axis. A letter stands
            for one length in all arrays, a digit for itself. An array without an entry has any axes.
        arrays: The arrays by name.
    """
    lengths: dict[str, tuple[int, str]] = {}
    for name, array in arrays.items():
        if name not in axes:
            continue
        kinds, _, letters = axes[name].partition(" ")
        if array.dtype.kind not in kinds or array.ndim != len(letters):
            return f"has {name} as {array.dtype} of shape {array.shape}; expected {len(letters)} axes of {kinds!r}"
        for letter, length in zip(letters, array.shape, strict=True):
            due, other = (int(letter), "") if letter.isdigit() else lengths.setdefault(letter, (length, name))
            if length != due:
                return f"has {name} of shape {array.shape}; expected {due} in place of {length}" + (
                    f", as in {other}" if other else ""
                )
    return ""


# -- pieces of unfinished results --------------------------------------------------------------------------------


_HEX = 2 * DIGEST_BYTES


class RepeatedWorkWarning(UserWarning):
    """A warning that a stored part of unfinished work cannot be used and is computed again. No number changes."""


@dataclass(frozen=True)
class Pieces:
    """The content of `<home>/.<key>.partial/` until the bundle `key` is complete.

    Attributes:
        stamp: The hash of the commits that the work reads.
        redo: The remedy for pieces of another version, for the message.
    """

    run: Location
    folder: str
    stamp: str
    redo: str

    @classmethod
    def of(cls, run: Location, home: str, key: str, stamp: str, redo: str) -> "Pieces":
        """Return the pieces of the bundle that will be stored as `home`/`key`."""
        return cls(run, f"{home}/.{key}{PARTIAL}", stamp, redo)

    def read(self, name: str, record: type) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of one piece, or None if the work did not get that far or must be done again.

        A piece whose bytes are not those that were written, such as half of one after a power cut, and one of
        other commits are as good as none: the work makes them again, and a warning says so.

        Args:
            name: The name of the piece.
            record: The dataclass whose fields they are. The arrays of several records have the record's name and a
                slash in front.

        Raises:
            RunDamagedError: If they have the fields of another version of probe_kit.
        """
        try:
            stored = self.run.read(self._key(name))
        except FileNotFoundError:
            return None
        content, bound = stored[:-_HEX], stored[-_HEX:]
        if self._bound(content, name) != bound:
            warnings.warn(
                f"{self.run}/{self._key(name)} was changed after it was written, or is another piece or of other "
                "episodes: what it holds is computed again",
                RepeatedWorkWarning,
                stacklevel=2,
            )
            return None
        with open_arrays(stored) as arrays:
            if problem := fields_problem(record, [field.rpartition("/")[2] for field in arrays]):
                raise RunDamagedError(
                    f"{self.run}/{self._key(name)} {problem}: another version of probe_kit began this. Remove "
                    f"{self.folder}; {self.redo}"
                )
            return dict(arrays)

    def keep(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store one piece."""
        file = BytesIO()
        np.savez(file, allow_pickle=False, **arrays)
        with ZipFile(file, "a") as archive:
            archive.comment = bytes(_HEX)  # a zip file may end in a comment: that is where the hash goes
        content = file.getvalue()[:-_HEX]
        # Not flushed: a piece that a power cut takes is computed again, and its hash shows half a one.
        self.run.write(self._key(name), content + self._bound(content, name), durable=False)

    def discard(self) -> None:
        """Remove everything: the work is complete."""
        self.run.remove(self.folder)

    def _bound(self, content: bytes, name: str) -> bytes:
        """Return the hash of the file and of its name and commits, `_HEX` bytes."""
        return digest(f"{self._key(name)} {self.stamp} ".encode() + content).encode()

    def _key(self, name: str) -> str:
        return f"{self.folder}/{name}.npz"
