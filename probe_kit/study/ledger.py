"""The ledger of a study: what was made of each run, when, by which settings, and what failed.

    OUT/ledger/<model>+<condition or ask>-<key>.json     a record per run, written by the process that conducts
    OUT/ledger/speeds/<digits>.json                      a record per machine: what `--calibrate` measured there

Every record carries its own hash. No number of a table comes from the ledger: a run that it leads to is compared
with its cell. Without it, failed models are tried again, equal runs elsewhere are looked up again, and the weights
of a run are not compared with those that were first loaded.
"""

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from probe_kit.errors import RunDamagedError
from probe_kit.extract.events import traceback_of
from probe_kit.hashing import sha256_text
from probe_kit.runs.growth import flat_settings
from probe_kit.runs.records import HASH, as_record, read_record
from probe_kit.runs.store import locate
from probe_kit.study.cells import Cell, folder_of, key_of

FOLDER = "ledger"
Stage = Literal["checking", "playing", "episodes", "probes", "waiting"]
_ADVICE = "Delete it; no number comes from it, and `probe-kit study run` writes it again"
NOT_TRIED_AGAIN: tuple[Stage, ...] = ("playing", "episodes")
"""What takes long to fail, and so is tried again only on request."""


class _Record(BaseModel):
    """A part of the ledger. Later versions may add fields."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Failure(_Record):
    """Why runs of a model, or probes of a run, were not made.

    stage: `checking` before anything was loaded, `playing` for the whole model, `episodes` for single ones that
    were given up, `probes`, or `waiting` for a run that is not whole. run: as the plan names it. error: class of
    the error. when: UTC, ISO 8601.
    """

    stage: Stage
    model: str
    run: str
    reason: str
    error: str = ""
    traceback: str = ""
    when: str = ""

    @classmethod
    def of(cls, stage: Stage, model: str, run: str, error: BaseException) -> "Failure":
        """What an error says, with its traceback and the time."""
        reason = str(error) or type(error).__name__
        return cls(
            stage=stage, model=model, run=run, reason=reason, error=type(error).__name__,
            traceback=traceback_of(error), when=now(),
        )  # fmt: skip

    def __str__(self) -> str:
        if self.stage in ("probes", "waiting"):
            return f"probes of {self.run}: {self.reason}"
        return f"{self.model} failed at {self.run}: {self.reason}"

    def same(self, other: "Failure | None") -> bool:
        """Whether both say the same, at whatever time."""
        own = (self.stage, self.run, self.error, self.reason)
        return other is not None and own == (other.stage, other.run, other.error, other.reason)


class Played(_Record):
    """A whole run. began, ended: of its last playing; empty for a run that lay there already.

    episodes: that it holds. seconds: wall-clock time per episode of that playing, None if nothing was played.
    machine: where. stamp: of the commits. provenance: of all its episodes. served_by: another run that has these
    episodes, empty if the run lies in its own place.
    """

    episodes: int
    settings_sha256: str
    weights_sha256: str | None
    provenance: list[dict[str, Any]]
    began: str = ""
    ended: str = ""
    seconds: float | None = None
    machine: str = ""
    stamp: str = ""
    served_by: str = ""


class Probed(_Record):
    """Probes that are stored. key: their name in the run. known: all that decides them."""

    key: str
    known: dict[str, Any]
    ended: str = ""


class Entry(_Record):
    """The record of one run. settings: all that its key is made of."""

    cell: str
    settings: dict[str, Any]
    played: Played | None = None
    failure: Failure | None = None
    probes: dict[str, Probed] = {}
    probe_failures: dict[str, Failure] = {}


class Speed(_Record):
    """What a model takes on a machine. seconds: per inference of a policy that acts, else per episode.

    bytes: of an episode, with the choice of `tokens`. episodes: that were measured.
    """

    seconds: float
    bytes: int
    batch: int
    device: str
    tokens: str
    episodes: int
    when: str = ""


class Speeds(_Record):
    """The record of one machine. models: by what shares one rate, see `cost.speed_name`."""

    machine: str
    models: dict[str, Speed] = {}


class Ledger:
    """The ledger of the study whose runs lie in `out`, a folder or URL."""

    def __init__(self, out: str) -> None:
        self._location = locate(out)

    def entries(self) -> dict[str, Entry]:
        """All records by name, those of former settings too.

        Raises RunDamagedError for one that was changed, or is of another cell than its name says.
        """
        records = self._location.read_all(FOLDER, ".json")
        return {name.removesuffix(".json"): self._entry(name, content) for name, content in records.items()}

    def of(self, cell: Cell) -> Entry:
        """The record of a cell, empty if there is none. Raises RunDamagedError as `entries` does."""
        name = f"{name_of(cell)}.json"
        if not self._location.exists(f"{FOLDER}/{name}"):
            return Entry(cell=cell.name, settings=cell.known)
        return self._entry(name, self._location.read(f"{FOLDER}/{name}"))

    def note(self, cell: Cell, **changes: Any) -> None:
        """Change fields of the record of a cell; one that stays as it is, is not written."""
        with self.opened():
            before = self.of(cell)
            after = before.model_copy(update=changes)
            if after != before:
                record = as_record(after.model_dump(mode="json"))
                self._location.write(f"{FOLDER}/{name_of(cell)}.json", record)

    def speeds(self) -> dict[str, Speed]:
        """What was measured on this machine."""
        key = _speeds_key()
        return (
            dict(self._parsed(key, self._location.read(key), Speeds).models) if self._location.exists(key) else {}
        )

    def note_speed(self, name: str, speed: Speed) -> None:
        """Keep what was measured on this machine."""
        with self.opened():
            record = Speeds(machine=machine_name(), models={**self.speeds(), name: speed})
            self._location.write(_speeds_key(), as_record(record.model_dump(mode="json")))

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Processes that write take turns; what killed ones left aside is removed."""
        with self._location.in_words(), self._location.tended(FOLDER):
            yield

    def _entry(self, name: str, content: bytes) -> Entry:
        """The record in the file `name`, found to be of the cell and the settings that the file's name says."""
        entry = self._parsed(f"{FOLDER}/{name}", content, Entry)
        expected = f"{_file_stem(folder_of(entry.cell, key_of(entry.settings)))}.json"
        if name != expected:
            raise RunDamagedError(
                f"{self._location}/{FOLDER}/{name} is the record of {entry.cell} and belongs into {expected}. "
                f"{_ADVICE}"
            )
        return entry

    def _parsed[Kind: _Record](self, key: str, content: bytes, kind: type[Kind]) -> Kind:
        name = f"{self._location}/{key}"
        record = read_record(content, name, _ADVICE)
        try:
            return kind.model_validate({part: value for part, value in record.items() if part != HASH})
        except ValidationError as error:
            message = error.errors(include_url=False)[0]["msg"]
            raise RunDamagedError(f"{name} is no record of a ledger ({message}). {_ADVICE}") from error


def name_of(cell: Cell) -> str:
    """What the record of a cell is called."""
    return _file_stem(cell.folder)


def _file_stem(folder: str) -> str:
    return folder.replace("/", "+")


def settings_changed(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """In words what differs between the settings of two records, such as `light_level 1 → 0.7`."""
    old, new = _leaves(before), _leaves(after)
    names = [name for name in (*new, *(one for one in old if one not in new)) if old.get(name) != new.get(name)]
    return [_changed(name.rpartition(".")[2], old.get(name), new.get(name)) for name in names]


def _changed(name: str, before: Any, after: Any) -> str:
    """One setting in words; of a checkpoint's files only those that differ."""
    if name == "checkpoint" and isinstance(before, list) and isinstance(after, list):
        files = [{file: stat for file, *stat in one} for one in (before, after)]
        other = [file for file in files[0] | files[1] if files[0].get(file) != files[1].get(file)]
        return f"checkpoint: {_short(', '.join(other))} changed"
    shown = (
        f"{len(one)} files" if name == "checkpoint" and isinstance(one, list) else one for one in (before, after)
    )
    return f"{name} {' → '.join(map(_short, shown))}"


def _leaves(settings: Mapping[str, Any]) -> dict[str, Any]:
    """By path; a stored record has lists where settings have tuples."""
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in flat_settings(settings).items()
    }


def _short(value: Any) -> str:
    text = "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}…"


def now() -> str:
    """The time, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def machine_name() -> str:
    """A name under which the ledger keeps how fast models are here; it does not show the host's name."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {_host()}"


def _speeds_key() -> str:
    return f"{FOLDER}/speeds/{_host()}.json"


def _host() -> str:
    return sha256_text(platform.node())[:8]
