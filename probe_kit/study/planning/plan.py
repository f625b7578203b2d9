"""The plan of a study: what is stored of each cell, why others are to be made, and what they take."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError, UsageError
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import NOT_TRIED_AGAIN, Entry, Failure, Ledger, name_of, settings_changed
from probe_kit.study.mistakes import unknown
from probe_kit.study.planning.cost import Cost, Work, cost_of
from probe_kit.study.planning.planned_probes import (
    PlannedProbes,
    control_cell,
    planned_probes,
    probes_of,
    what_decides,
)
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.tables.stored_runs import noted_run, open_matching

if TYPE_CHECKING:
    from probe_kit.runs import Run

State = Literal["new", "partial", "whole", "damaged", "failed", "waiting", "skipped"]
MOST_CHANGES = 3


@dataclass(frozen=True)
class PlannedCell:
    """A cell with what lies at its location. done: episodes of its selection that are stored. why: in words.

    seconds: per episode, measured in the stored episodes; None without any. failure: of the last time it was
    played. waits_for: failure of another run of its model. probes: those that the file names of it. noted: whether
    the ledger knows the run as it is now.
    """

    cell: Cell
    location: str
    state: State
    done: int
    why: str
    seconds: float | None = None
    failure: Failure | None = None
    waits_for: Failure | None = None
    probes: tuple[PlannedProbes, ...] = ()
    noted: bool = False

    @property
    def missing(self) -> int:
        """Episodes that are to be played or asked."""
        return 0 if self.state == "skipped" else self.cell.episodes - self.done

    @property
    def unprobed(self) -> tuple[PlannedProbes, ...]:
        """Probes that are to be fitted."""
        return tuple(one for one in self.probes if one.state != "stored")

    @property
    def words(self) -> str:
        """Why, and what is known of its probes."""
        if not self.probes or self.state != "whole":
            return self.why
        said = [f"probes {one.name}: {one.why}" for one in self.unprobed] or ["probed"]
        return "; ".join([self.why, *said])


@dataclass(frozen=True)
class StudyPlan:
    """The cells of a study in the order in which models are loaded. cost: of what is missing. only: as planned."""

    study: LoadedStudy
    cells: tuple[PlannedCell, ...]
    cost: Cost
    only: str | None = None

    @property
    def played(self) -> list[PlannedCell]:
        """All cells but the skipped ones."""
        return [one for one in self.cells if one.state != "skipped"]

    @property
    def whole(self) -> bool:
        """Whether no episode and no probes are missing."""
        return not any(one.missing or one.unprobed for one in self.played)

    def skipped(self) -> dict[str, str]:
        """By model, why it is not played."""
        return {name: model.unavailable for name, model in self.study.study.models.items() if model.unavailable}

    def totals(self) -> dict[str, int]:
        """Runs, episodes by what is done in them, inferences of policies, and what is missing."""
        cells = [one.cell for one in self.played]
        asked = sum(cell.episodes for cell in cells if cell.asks)
        captured = sum(cell.episodes for cell in cells if cell.captured)
        return {
            "runs": len(cells),
            "episodes": sum(cell.episodes for cell in cells),
            "acted": sum(cell.episodes for cell in cells) - asked - captured,
            "captured": captured,
            "asked": asked,
            "inferences": sum(cell.inferences for cell in cells),
            "missing": sum(one.missing for one in self.played),
            "unprobed": sum(len(one.unprobed) for one in self.played),
        }

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "study": self.study.study.name,
            "suite": self.study.suite.identity,
            "totals": self.totals(),
            "skipped": self.skipped(),
            **self.cost.to_json(),
            "runs": [
                {
                    "model": one.cell.model,
                    "way": one.cell.way,
                    "seed": one.cell.seed,
                    "blocks": list(one.cell.selections),
                    "key": one.cell.key,
                    "location": one.location,
                    "state": one.state,
                    "why": one.why,
                    "episodes": one.cell.episodes,
                    "done": one.done,
                    "inferences": one.cell.inferences,
                    "failure": None if one.failure is None else one.failure.model_dump(),
                    "probes": {probes.name: probes.why or probes.state for probes in one.probes},
                }
                for one in self.cells
            ],
        }


def plan_study(study: LoadedStudy, only: str | None = None) -> StudyPlan:
    """Compare a study with what is stored. Loads no model and writes nothing.

    only: a block or a model, whose runs alone are planned; all by default. Raises UsageError for another name, and
    RunDamagedError for a ledger that cannot be read.
    """
    known = [*study.study.models, *(block.name for block in study.study.runs)]
    if only is not None and only not in known:
        raise UsageError(f"--only: {unknown('block or model', only, known)}")
    cells = [cell for cell in study.cells if only is None or only == cell.model or only in cell.selections]
    order = {name: place for place, name in enumerate(study.study.models)}
    stored = _Stored(study)
    planned = _waiting([stored.planned(cell) for cell in sorted(cells, key=lambda cell: order[cell.model])])
    works = [stored.work(one) for one in planned if one.state != "skipped"]
    return StudyPlan(study, tuple(planned), cost_of(works, stored.ledger), only)


class _Stored:
    """What lies at the locations of a study, each run opened once."""

    def __init__(self, study: LoadedStudy) -> None:
        self._study, self._runs = study, dict[str, "Run | ProbeKitError"]()
        self.ledger = Ledger(study.study.folder)
        self._entries = self.ledger.entries()

    def run(self, cell: Cell) -> "Run | None":
        """The run of a cell, finished or not; None if there is none that can be opened."""
        found = self._look(cell)
        return None if isinstance(found, ProbeKitError) else found

    def _look(self, cell: Cell) -> "Run | ProbeKitError":
        if cell.name not in self._runs:
            try:
                self._runs[cell.name] = open_matching(self._study, cell, True, self._entry(cell))
            except ProbeKitError as error:
                self._runs[cell.name] = error
        return self._runs[cell.name]

    def _entry(self, cell: Cell) -> Entry:
        return self._entries.get(name_of(cell)) or Entry(cell=cell.name, settings=cell.known)

    def planned(self, cell: Cell) -> PlannedCell:
        """A cell with what is stored of it."""
        entry = self._entry(cell)
        location = str(noted_run(self._study, cell, entry)[0])
        if cell.unavailable:
            return PlannedCell(cell, location, "skipped", 0, f"skipped: {cell.unavailable}")
        run = self._look(cell)
        if isinstance(run, RunNotFoundError | RunIncompleteError):  # or killed before it had a plan
            return self._failed(PlannedCell(cell, location, "new", 0, self._why_new(cell)), entry)
        if isinstance(run, ProbeKitError):
            return PlannedCell(cell, location, "damaged", 0, f"damaged: {run}")
        done = _stored(cell, run)
        seconds = (entry.played.seconds if entry.played else None) or _seconds(run)
        if done < cell.episodes:
            why = f"{done} of {cell.episodes} episodes"
            return self._failed(PlannedCell(cell, location, "partial", done, why, seconds), entry)
        why = f"whole, served by {location}" if entry.played and entry.played.served_by else "whole"
        probes = tuple(self._probes(cell, entry, run))
        noted = entry.played is not None and (bool(entry.played.served_by) or entry.played.stamp == run.stamp)
        return PlannedCell(cell, location, "whole", cell.episodes, why, seconds, probes=probes, noted=noted)

    def work(self, one: PlannedCell) -> Work:
        """What is missing of a cell, and what is known of its stored episodes."""
        run = self.run(one.cell)
        streams = None if run is None else list(run.root.streams.values())
        return Work(one.cell, one.done, one.missing, one.seconds, streams)

    def _why_new(self, cell: Cell) -> str:
        """What changed since a run of the same model and condition, if the ledger knows one."""
        former = [one for one in self._entries.values() if one.cell == cell.name and one.settings != cell.known]
        if not former:
            return "new"
        changes = settings_changed(max(former, key=_when).settings, cell.known)
        more = f" and {len(changes) - MOST_CHANGES} more" if len(changes) > MOST_CHANGES else ""
        return f"new: {', '.join(changes[:MOST_CHANGES])}{more}"

    def _failed(self, one: PlannedCell, entry: Entry) -> PlannedCell:
        failure = entry.failure
        if failure is None:
            return one
        why = f"failed ({failure.when}): {failure.reason}"
        return replace(one, state="failed", failure=failure, why=f"{one.why}; {why}" if one.done else why)

    def _probes(self, cell: Cell, entry: Entry, run: "Run") -> Iterator[PlannedProbes]:
        if self._study.archive is not None:  # it keeps the probes, and no ledger
            return
        for name, table in probes_of(self._study, cell):
            control = control_cell(self._study, cell, table)
            beside = None if control is None else self.run(control)
            ready = control is None or beside is not None
            known = what_decides(table, cell, run, beside) if ready else None
            yield planned_probes(name, known, entry, run)


def _waiting(cells: list[PlannedCell]) -> list[PlannedCell]:
    """The cells, of which those wait whose model failed at another run."""
    failed = {one.cell.model: one.failure for one in cells if one.failure and one.failure.stage != "episodes"}

    def of(one: PlannedCell) -> PlannedCell:
        at = failed.get(one.cell.model)
        if at is None or one.failure is not None or one.state in ("whole", "skipped", "damaged"):
            return one
        return replace(one, state="waiting", waits_for=at, why=f"{one.why}; waits, because {at.run} failed")

    return list(map(of, cells))


def given_up(one: PlannedCell) -> bool:
    """Whether a cell is not tried again unasked."""
    return any(failure and failure.stage in NOT_TRIED_AGAIN for failure in (one.failure, one.waits_for))


def _when(entry: Entry) -> str:
    return entry.played.ended if entry.played else entry.failure.when if entry.failure else ""


def _stored(cell: Cell, run: "Run") -> int:
    """Episodes of the cell's selection that a run holds."""
    wanted: set[str] = set()
    for category, count in cell.selection.counts(cell.suite).items():
        items = run.items.loc[run.items["category"] == category, "item_id"]
        wanted |= set(items.iloc[:count])
    return int(run.episodes["item_id"].isin(wanted).sum())


def _seconds(run: "Run") -> float | None:
    """Mean seconds of an episode: inference and simulation."""
    episodes = run.episodes
    if episodes.empty or not {"seconds_inference", "seconds_simulation"} <= set(episodes):
        return None
    total = (episodes["seconds_inference"] + episodes["seconds_simulation"]).dropna()
    return None if total.empty else float(total.mean())


def cells_by_model(cells: Sequence[PlannedCell]) -> Mapping[str, list[PlannedCell]]:
    """The cells of each model, in order."""
    found: dict[str, list[PlannedCell]] = {}
    for one in cells:
        found.setdefault(one.cell.model, []).append(one)
    return found
