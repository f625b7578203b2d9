"""The failures of a study, `OUT/failures/<run>.json` each, until the run or its probes are made.

Runs describe themselves, so that a study notes nothing else. No number of a table comes from a failure. Each is a
file of its own, so that two processes that play different models of a study need no lock between them.
"""

from datetime import UTC, datetime
from typing import ClassVar, Literal

from probe_kit.extract.events import traceback_of
from probe_kit.runs.records import Record
from probe_kit.runs.store import locate
from probe_kit.study.cells import Cell

FOLDER = "failures"
Stage = Literal["checking", "playing", "episodes", "probes", "waiting"]
_ADVICE = "Delete it; no number comes from it, and `probe-kit study run` then tries again"
NOT_TRIED_AGAIN: tuple[Stage, ...] = ("playing", "episodes")
"""The failures that take long, and so are tried again only on request."""


class Failure(Record):
    """Why runs of a model, or probes of a run, were not made.

    stage: `checking` before anything was loaded, `playing` for the whole model, `episodes` for single ones that
    were given up, `probes`, or `waiting` for a run that is not whole. run: as the plan names it. error: class of
    the error. when: UTC, ISO 8601.
    """

    kind: ClassVar[str] = "record of a failure"
    stage: Stage
    model: str
    run: str
    reason: str
    error: str = ""
    traceback: str = ""
    when: str = ""

    @classmethod
    def of(cls, stage: Stage, model: str, run: str, error: BaseException) -> "Failure":
        """Return the failure that an error is, with its traceback and the time."""
        reason = str(error) or type(error).__name__
        return cls(
            stage=stage, model=model, run=run, reason=reason, error=type(error).__name__,
            traceback=traceback_of(error), when=datetime.now(UTC).isoformat(timespec="seconds"),
        )  # fmt: skip

    def __str__(self) -> str:
        if self.stage in ("probes", "waiting"):
            return f"probes of {self.run}: {self.reason}"
        return f"{self.model} failed at {self.run}: {self.reason}"

    def same(self, other: "Failure | None") -> bool:
        """Whether both say the same, at whatever time."""
        key = (self.stage, self.run, self.error, self.reason)
        return other is not None and key == (other.stage, other.run, other.error, other.reason)


class Failures:
    """The failures of the study whose runs lie in `out`, a folder or URL; of probes by their table's name."""

    def __init__(self, out: str) -> None:
        self._location = locate(out)

    def check_place(self) -> None:
        """Raise DiskSpaceError or StoreError for a place that cannot be written; remove drafts of killed ones."""
        with self._location.in_words(), self._location.tended(FOLDER):
            pass

    def of(self, cell: Cell, probes: str = "") -> Failure | None:
        """Return the failure of a run, or of its probes, None without one. Raises RunDamagedError if changed."""
        key = _key(cell, probes)
        if not self._location.exists(key):
            return None
        return Failure.read(self._location, key, _ADVICE, run=cell.name)

    def note(self, cell: Cell, failure: Failure, probes: str = "") -> None:
        """Write a failure, unless the same one is there."""
        if not failure.same(self.of(cell, probes)):
            with self._location.in_words():
                self._location.write(_key(cell, probes), failure.to_bytes())

    def clear(self, cell: Cell, probes: str = "") -> None:
        """Remove the failure of what is made."""
        self._location.delete(_key(cell, probes))


def _key(cell: Cell, probes: str) -> str:
    # The folder holds the key of the settings: a failure of other settings is none of this cell.
    name = "+".join([*cell.folder.split("/"), *([probes] if probes else [])])
    return f"{FOLDER}/{name}.json"
