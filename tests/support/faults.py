"""Accidents that happen to stored runs, drawn at random, and what came of them.

A change maps files of a run to their new content, None for a file that is gone, so that it can be undone.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from probe_kit.errors import ProbeKitError, RunNotFoundError
from probe_kit.runs import verify_run
from probe_kit.runs.verify import Audit
from tests.support.reading import readings

Change = Mapping[Path, bytes | None]


@dataclass(frozen=True)
class Fault:
    """What was done, in words, and the files it changes. harmless: whether it may change nothing at all."""

    words: str
    change: Change
    harmless: bool = False


@dataclass(frozen=True)
class Stored:
    """A run to be damaged, another one from which foreign files come, and what the first one tells undamaged."""

    run: Path
    other: Path
    before: Mapping[str, str]
    audit: Audit
    _files: dict[Path, dict[str, list[Path]]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, run: Path, other: Path) -> "Stored":
        return cls(run, other, readings(run), verify_run(run, deep=True))

    def files(self, run: Path | None = None) -> dict[str, list[Path]]:
        """By the kind of file, so that the few of one kind are drawn as often as the many of another.

        Listed once: every change is undone before the next draw.
        """
        home = run or self.run
        if home in self._files:
            return self._files[home]
        kinds = self._files[home] = {}
        for path in sorted(home.rglob("*")):
            if path.is_file():
                parts = path.relative_to(home).parts
                array = "/".join(parts[2:4]) if parts[0] == "columns.zarr" else ""
                array = "/".join(parts[1:3]) if parts[0] == "data.zarr" else array
                metadata = path.name if path.name == "zarr.json" else ""
                probes = path.name if parts[0] in ("probes", "interventions") else ""
                kinds.setdefault(f"{parts[0]} {metadata or array} {probes}", []).append(path)
        return kinds

    def draw(self, draw: Random, run: Path | None = None) -> Path:
        kinds = self.files(run)
        return draw.choice(kinds[draw.choice(sorted(kinds))])

    def verdict(self, fault: Fault) -> str:
        """`found`, `harmless` if no readable number changed, or the error of probe_kit itself."""
        changed = next(iter(fault.change)).relative_to(self.run).parts
        hint = {"data.zarr": changed[-4] if len(changed) > 4 else "", "columns.zarr": "columns"}.get(
            changed[0], ""
        )
        hint = next((part for part in ("pooled", "tokens", "trajectory") if part in changed), hint)
        with applied(fault.change):
            try:
                now = readings(self.run, hint if changed[0] != "columns.zarr" else "columns")
            except ProbeKitError as error:
                read = f"found: {error}"
            else:
                read = "same" if now == self.before else "SILENT: other numbers"
            try:
                audit = verify_run(self.run, deep=True)
            except RunNotFoundError:  # run.json itself is gone, and both say so
                return "found" if read.startswith("found") else read
        noticed = not audit.ok or _summary(audit) != _summary(self.audit)
        if read.startswith("SILENT"):
            return read
        if not noticed and not fault.harmless and not (read == "same" and _is_respelled(fault)):
            return f"UNSEEN by run verify --deep, reading says {read}"
        return "harmless" if read == "same" and not noticed else "found"


def _is_respelled(fault: Fault) -> bool:
    """Whether the fault changes the spelling of JSON records and none of their values."""
    for path, content in fault.change.items():
        try:
            if content is None or _values(content) != _values(path.read_bytes()):
                return False
        except ValueError:
            return False
    return True


def _values(content: bytes) -> str:
    """One spelling of the values, in which 1, 1.0 and true differ."""
    return json.dumps(json.loads(content), sort_keys=True)


def _summary(audit: Audit) -> tuple[object, ...]:
    return audit.committed, audit.planned, audit.failed, audit.sealed, audit.strays


@contextmanager
def applied(change: Change) -> Iterator[None]:
    """The change while the body runs."""
    before = {path: path.read_bytes() if path.is_file() else None for path in change}
    _write(change)
    try:
        yield
    finally:
        _write(before)


def _write(change: Change) -> None:
    for path, content in change.items():
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


# -- what happens ----------------------------------------------------------------------------------------


def flip(stored: Stored, draw: Random) -> Fault | None:
    path = stored.draw(draw)
    content = bytearray(path.read_bytes())
    if not content:
        return None
    offset, bit = draw.randrange(len(content)), draw.randrange(8)
    content[offset] ^= 1 << bit
    return Fault(f"flip bit {bit} of byte {offset} of {path}", {path: bytes(content)})


def overwrite(stored: Stored, draw: Random) -> Fault | None:
    path = stored.draw(draw)
    content = path.read_bytes()
    start = draw.randrange(len(content) + 1)
    filled = content[:start] + bytes(len(content) - start)
    return _unless_same(f"zeros from byte {start} of {path}", path, filled)


def truncate(stored: Stored, draw: Random) -> Fault | None:
    path = stored.draw(draw)
    content = path.read_bytes()
    stop = draw.randrange(len(content)) if content else 0
    return _unless_same(f"cut {path} to {stop} bytes", path, content[:stop])


def extend(stored: Stored, draw: Random) -> Fault | None:
    path = stored.draw(draw)
    more = draw.randbytes(draw.randrange(1, 40)) if draw.random() < 0.5 else b"\n"
    return Fault(f"{len(more)} more bytes at {path}", {path: path.read_bytes() + more})


def delete(stored: Stored, draw: Random) -> Fault:
    path = stored.draw(draw)
    return Fault(f"delete {path}", {path: None})


def swap(stored: Stored, draw: Random) -> Fault | None:
    """Two files of one kind, of one size where there are such."""
    kinds = [paths for paths in stored.files().values() if len(paths) > 1]
    paths = draw.choice(kinds)
    chosen_path = draw.choice(paths)
    equal = [path for path in paths if path != chosen_path and path.stat().st_size == chosen_path.stat().st_size]
    other = draw.choice(equal or [path for path in paths if path != chosen_path])
    first_bytes, other_bytes = chosen_path.read_bytes(), other.read_bytes()
    return (
        None
        if first_bytes == other_bytes
        else Fault(f"swap {chosen_path} and {other}", {chosen_path: other_bytes, other: first_bytes})
    )


def copy_over(stored: Stored, draw: Random) -> Fault | None:
    kinds = [paths for paths in stored.files().values() if len(paths) > 1]
    source, target = draw.sample(draw.choice(kinds), 2)
    return _unless_same(f"copy {source} over {target}", target, source.read_bytes())


def foreign(stored: Stored, draw: Random) -> Fault | None:
    """A file of another run in the place of ours, or where there was none."""
    source = stored.draw(draw, stored.other)
    target = stored.run / source.relative_to(stored.other)
    if target.is_file() and target.read_bytes() == source.read_bytes():
        return None
    return Fault(f"foreign {source}", {target: source.read_bytes()})


def foreign_folder(stored: Stored, draw: Random) -> Fault | None:
    """A whole folder of another run over ours."""
    top = draw.choice(
        ["commits", "data.zarr", "columns.zarr", "probes", "sealed", "certificates", "provenance", "times"]
    )
    change = {
        stored.run / path.relative_to(stored.other): path.read_bytes()
        for path in sorted((stored.other / top).rglob("*"))
        if path.is_file()
    }
    fresh = {path: new for path, new in change.items() if not path.is_file() or path.read_bytes() != new}
    return Fault(f"foreign {top}", fresh) if fresh else None


def backup(stored: Stored, draw: Random) -> Fault:
    path = stored.draw(draw)
    name = draw.choice(
        ["{stem} copy{suffix}", "{name}~", "{name}.bak", ".{name}.swp", "._{name}", "{stem} (1){suffix}"]
    )
    copy_path = path.with_name(name.format(stem=path.stem, suffix=path.suffix, name=path.name))
    content = draw.choice([path.read_bytes(), b"", draw.randbytes(50)])
    return Fault(f"backup {copy_path}", {copy_path: content}, harmless=True)


def edit_json(stored: Stored, draw: Random) -> Fault | None:
    """One value of a JSON file, written as it was written before."""
    paths = [path for of_kind in stored.files().values() for path in of_kind if path.suffix == ".json"]
    kinds = sorted({path.relative_to(stored.run).parts[0] for path in paths})
    kind = draw.choice(kinds)
    path = draw.choice([path for path in paths if path.relative_to(stored.run).parts[0] == kind])
    raw = path.read_bytes()
    content = json.loads(raw)
    words = _edit(content, draw)
    indent = 1 if raw.startswith(b"{\n ") else None
    if raw.startswith(b"{\n  "):
        indent = 2
    edited = json.dumps(content, indent=indent).encode()
    return _unless_same(f"edit {path}: {words}", path, edited)


def _edit(content: Any, draw: Random) -> str:
    """Change one leaf, take one out, or exchange two."""
    places = list(_places(content))
    holder, name, value = draw.choice(places)
    kind = draw.randrange(4)
    if kind == 0:
        del holder[name]
        return f"{name} taken out"
    if kind == 1 and isinstance(holder, list) and len(holder) > 1:
        holder[0], holder[-1] = holder[-1], holder[0]
        return "first and last exchanged"
    holder[name] = _other(value, draw)
    return f"{name}: {str(value)[:30]!r} becomes {str(holder[name])[:30]!r}"


def _places(content: Any) -> Iterator[tuple[Any, Any, Any]]:
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    for name, value in list(pairs):
        yield content, name, value
        if isinstance(value, dict | list):
            yield from _places(value)


def _other(value: Any, draw: Random) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return draw.choice([value + 1, -value - 1, value * 2 + 0.5, 0 if value else 1, str(value), None])
    if isinstance(value, str):
        swapped = {"left": "right", "right": "left", "wrong": "correct", "correct": "wrong"}
        return draw.choice([swapped.get(value, value[::-1] + "x"), value + " ", value.upper() + "!", None, 7])
    return draw.choice([None, [], {}, "nothing"])


def _unless_same(words: str, path: Path, content: bytes) -> Fault | None:
    return None if path.read_bytes() == content else Fault(words, {path: content})


KINDS: tuple[Callable[[Stored, Random], Fault | None], ...] = (
    flip, overwrite, truncate, extend, delete, swap, copy_over, foreign, foreign_folder, backup, edit_json,
    edit_json,
)  # fmt: skip


def draw_fault(stored: Stored, seed: int) -> Fault:
    """The fault that this seed stands for."""
    draw = Random(seed)
    while True:
        if fault := draw.choice(KINDS)(stored, draw):
            return fault
