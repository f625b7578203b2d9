"""Bundles: results that are stored with a run, a folder each, complete or not there.

    <home>/<key>/settings.json    the head, a record written last: what it is, whose, and the sums of its files
    <home>/<key>/<file>           what the head names; anything else there is not read
    <home>/.<key>.partial/        work that is not finished; only then may a folder lie there without a head

Files are never written over: what changes gets another name, and counts when the head names it.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, BinaryIO

from probe_kit.errors import RunDamagedError, RunNotFoundError
from probe_kit.extract.run_layout import INTERVENTIONS, PROBES
from probe_kit.extract.store.format.hashes import (
    HASH,
    Sum,
    as_record,
    digest_of,
    expect,
    is_record,
    read_plain,
    read_record,
)
from probe_kit.extract.store.format.root import read_root
from probe_kit.extract.store.locations.location import Location

BUNDLES = (PROBES, INTERVENTIONS)
"""Where bundles may lie in a run."""
_MAKERS = {PROBES: "train", INTERVENTIONS: "intervene"}
HEAD, PARTIAL = "settings.json", ".partial"
_KEY = re.compile(r"[0-9a-f]{12}")
_SHORT = 8
_PARTS = {"settings": dict, "created": str}
"""Of heads that nothing protects."""


@dataclass(frozen=True)
class Bundle:
    """One bundle, its head checked; files are checked when they are read.

    head: what whoever stored it says. files: by the name asked for, the name that counts now and the sum of it;
    None in a run that nothing protects.
    """

    location: Location
    home: str
    key: str
    head: Mapping[str, Any]
    files: Mapping[str, tuple[str, Sum]] | None

    @property
    def folder(self) -> str:
        """Its folder in the run."""
        return f"{self.home}/{self.key}"

    def has(self, name: str) -> bool:
        """Whether it has a file of this name."""
        return self.location.exists(f"{self.folder}/{name}") if self.files is None else name in self.files

    def read(self, name: str) -> bytes:
        """One file. Raises RunDamagedError if it is missing or was changed."""
        try:
            content = self.location.read(self._place(name))
        except FileNotFoundError:
            raise self._damaged(name, "is missing") from None
        if self.files is not None and (problem := self.files[name][1].problem(content)):
            raise self._damaged(name, problem)
        return content

    def open(self, name: str) -> BinaryIO:
        """One file to be read here and there; see `check`."""
        try:
            return self.location.open(self._place(name))
        except FileNotFoundError:
            raise self._damaged(name, "is missing") from None

    def check(self, name: str) -> None:
        """Read one file to its end, a piece at a time. Raises RunDamagedError if it was changed."""
        if self.files is None:
            return
        try:
            _, digest = digest_of(self.location.pieces(self._place(name)))
        except FileNotFoundError:
            raise self._damaged(name, "is missing") from None
        if digest != self.files[name][1].digest:
            raise self._damaged(name, "has other bytes than were written")

    def problems(self, deep: bool) -> Iterator[str]:
        """What is missing or has another size; with `deep` whose bytes are others."""
        names = {actual: name for name, (actual, _) in (self.files or {}).items()}
        sizes = self.location.sizes(self.folder, names)
        for actual, name in names.items():
            known = (self.files or {})[name][1]
            try:
                if sizes.get(actual) != known.length:
                    seen = f"{sizes[actual]} bytes; {known.length} were written" if actual in sizes else None
                    raise self._damaged(name, f"has {seen}" if seen else "is missing")
                if deep:
                    self.check(name)
            except RunDamagedError as error:
                yield str(error)

    def _place(self, name: str) -> str:
        return f"{self.folder}/{name if self.files is None else self.files[name][0]}"

    def _damaged(self, name: str, problem: str) -> RunDamagedError:
        return RunDamagedError(f"{self.location}/{self._place(name)} {problem}. {_advice(self.folder)}")


def write_bundle(
    location: Location, home: str, key: str, head: Mapping[str, Any], files: Mapping[str, bytes] = {}
) -> None:
    """Store a bundle, or change one: files that are not given stay as they are.

    head: replaces the former one, without the parts that are kept here (`key`, `run`, `files`). What killed
    processes left in its folder is removed.
    """
    with location.tended(f"{home}/{key}"):
        _write_bundle(location, home, key, head, files)


def tidy_bundle(location: Location, home: str, key: str) -> None:
    """Remove what killed processes left of a bundle that is complete: files and folders that never counted."""
    with location.tended(f"{home}/{key}"):
        location.remove(f"{home}/.{key}{PARTIAL}")


def _write_bundle(
    location: Location, home: str, key: str, head: Mapping[str, Any], files: Mapping[str, bytes]
) -> None:
    before = read_bundle(location, home, key) if location.exists(f"{home}/{key}/{HEAD}") else None
    kept = _files_of(before) if before else {}
    named, written = dict(kept), dict[str, int]()
    for name, content in files.items():
        known = Sum.of(content)
        if name not in kept or kept[name][1] != known:
            actual = name if before is None else _renamed(name, known)
            location.write(f"{home}/{key}/{actual}", content)
            written[f"{home}/{key}/{actual}"] = known.length
            named[name] = actual, known
    location.confirm(written)
    stored = {name: [actual, *known.to_json()] for name, (actual, known) in named.items()}
    whose = {"key": key, "run": _identity(location)}
    location.write_record(f"{home}/{key}/{HEAD}", as_record({**head, **whose, "files": stored}))
    for name, (actual, _) in kept.items():
        if named[name][0] != actual:
            location.delete(f"{home}/{key}/{actual}")


def _files_of(bundle: Bundle) -> dict[str, tuple[str, Sum]]:
    """Its files; those of a former version get their hashes here."""
    if bundle.files is not None:
        return dict(bundle.files)
    names = (key.removeprefix(f"{bundle.folder}/") for key in bundle.location.keys(bundle.folder))
    return {name: (name, Sum.of(bundle.read(name))) for name in names if name != HEAD}


def _renamed(name: str, known: Sum) -> str:
    path = PurePosixPath(name)
    return f"{path.stem}-{known.digest[:_SHORT]}{path.suffix}"


def read_bundle(location: Location, home: str, key: str) -> Bundle:
    """The bundle `key`. Raises RunDamagedError if its head is missing, was changed, or is of another run."""
    folder = f"{home}/{key}"
    name, advice = f"{location}/{folder}/{HEAD}", _advice(folder)
    try:
        raw = location.read(f"{folder}/{HEAD}")
    except FileNotFoundError:
        raise RunDamagedError(f"{name} is missing, though the folder is there. {advice}") from None
    run = _identity(location)
    if not is_record(raw) and run is None:
        plain = read_plain(raw, name, advice)
        expect(plain, _PARTS, name, advice)
        return Bundle(location, home, key, plain, None)
    head = read_record(raw, name, advice)
    if (head["key"], head["run"]) != (key, run):
        raise RunDamagedError(f"{name} is {head['key']} of run {head['run']}; this is run {run}. {advice}")
    files = {one: (actual, Sum(*known)) for one, (actual, *known) in head["files"].items()}
    if strange := sorted(actual for actual, _ in files.values() if "/" in actual or actual in ("", ".", "..")):
        raise RunDamagedError(f"{name} names {strange[0]!r}, which is no file beside it. {advice}")
    rest = {part: value for part, value in head.items() if part not in (HASH, "key", "run", "files")}
    return Bundle(location, home, key, rest, files)


def bundle_keys(location: Location, home: str) -> list[str]:
    """Keys of the bundles that should be there: folders of that form, but for those that are being filled."""
    parts = [key.split("/") for key in location.keys(home)]
    names = dict.fromkeys(own[1] for own in parts if len(own) > 2)
    complete = {own[1] for own in parts if own[2:] == [HEAD]}
    return [
        name for name in names if _KEY.fullmatch(name) and (name in complete or f".{name}{PARTIAL}" not in names)
    ]


def read_bundles(location: Location, home: str) -> dict[str, Bundle]:
    """Every bundle of a run by key. Raises RunDamagedError for the first that is damaged."""
    return {key: read_bundle(location, home, key) for key in bundle_keys(location, home)}


def bundle_problems(location: Location, deep: bool) -> Iterator[str]:
    """What is wrong with the bundles of a run; with `deep` every byte of them is read."""
    for home in BUNDLES:
        for key in bundle_keys(location, home):
            try:
                bundle = read_bundle(location, home, key)
            except RunDamagedError as error:
                yield str(error)
            else:
                yield from bundle.problems(deep)


def _identity(location: Location) -> str | None:
    """That of the run; None for one that nothing protects.

    Bundles may also lie where there is no run, beside arrays that somebody has in memory.
    """
    try:
        return read_root(location).identity
    except RunNotFoundError:
        return None


def _advice(folder: str) -> str:
    return f"Remove {folder} and run the same `probe-kit {_MAKERS[folder.partition('/')[0]]}` again"
