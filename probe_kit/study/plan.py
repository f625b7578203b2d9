"""The plan of a study: what is stored, what is to be done and why, and what it takes as far as that is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError, UsageError
from probe_kit.extract import open_run
from probe_kit.extract.store.locations.locate import locate
from probe_kit.study.cells import Cell
from probe_kit.study.mistakes import unknown
from probe_kit.study.reading import LoadedStudy

if TYPE_CHECKING:
    from probe_kit.extract import Run

State = Literal["new", "partial", "whole", "damaged", "skipped"]


@dataclass(frozen=True)
class PlannedCell:
    """A cell with what lies at its location. done: episodes of its selection that are stored. why: in words.

    seconds: per episode, measured in the stored episodes; None without any.
    """

    cell: Cell
    location: str
    state: State
    done: int
    why: str
    seconds: float | None = None

    @property
    def missing(self) -> int:
        """Episodes that are to be played or asked."""
        return 0 if self.state == "skipped" else self.cell.episodes - self.done


@dataclass(frozen=True)
class StudyPlan:
    """The cells of a study in the order in which models are loaded."""

    study: LoadedStudy
    cells: tuple[PlannedCell, ...]

    @property
    def played(self) -> list[PlannedCell]:
        """All cells but the skipped ones."""
        return [one for one in self.cells if one.state != "skipped"]

    def skipped(self) -> dict[str, str]:
        """By model, why it is not played."""
        return {name: model.unavailable for name, model in self.study.study.models.items() if model.unavailable}

    def totals(self) -> dict[str, int]:
        """Runs, episodes by what is done in them, inferences of policies, and episodes that are missing."""
        cells = [one.cell for one in self.played]
        asked = sum(cell.episodes for cell in cells if cell.asks)
        captured = sum(cell.episodes for cell in cells if getattr(cell.settings, "capture_only", False))
        return {
            "runs": len(cells),
            "episodes": sum(cell.episodes for cell in cells),
            "acted": sum(cell.episodes for cell in cells) - asked - captured,
            "captured": captured,
            "asked": asked,
            "inferences": sum(cell.inferences for cell in cells),
            "missing": sum(one.missing for one in self.played),
        }

    def hours(self) -> dict[str, float]:
        """By model, hours of the missing episodes where episodes of the model were measured here."""
        rates = self._rates()
        found: dict[str, float] = {}
        for one in self.played:
            rate = rates.get((one.cell.model, one.cell.asks))
            if rate is not None and one.missing:
                found[one.cell.model] = found.get(one.cell.model, 0.0) + one.missing * rate / 3600
        return found

    def unmeasured(self) -> list[str]:
        """Models with missing episodes, none of which were measured here."""
        rates = self._rates()
        need = [one.cell for one in self.played if one.missing]
        return list(dict.fromkeys(cell.model for cell in need if (cell.model, cell.asks) not in rates))

    def _rates(self) -> Mapping[tuple[str, bool], float]:
        measured: dict[tuple[str, bool], list[tuple[int, float]]] = {}
        for one in self.played:
            if one.seconds is not None and one.done:
                measured.setdefault((one.cell.model, one.cell.asks), []).append((one.done, one.seconds))
        weighted = {place: sum(n * seconds for n, seconds in own) for place, own in measured.items()}
        return {place: total / sum(n for n, _ in measured[place]) for place, total in weighted.items()}

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "study": self.study.study.name,
            "suite": self.study.suite.identity,
            "totals": self.totals(),
            "skipped": self.skipped(),
            "hours": self.hours(),
            "unmeasured": self.unmeasured(),
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
                }
                for one in self.cells
            ],
        }


def plan_study(study: LoadedStudy, only: str | None = None) -> StudyPlan:
    """Compare a study with what is stored. Loads no model and writes nothing.

    only: a block or a model, whose runs alone are planned; all by default. Raises UsageError for another name.
    """
    known = [*study.study.models, *(block.name for block in study.study.runs)]
    if only is not None and only not in known:
        raise UsageError(f"--only: {unknown('block or model', only, known)}")
    cells = [cell for cell in study.cells if only is None or only == cell.model or only in cell.selections]
    order = {name: place for place, name in enumerate(study.study.models)}
    ordered = sorted(cells, key=lambda cell: order[cell.model])
    return StudyPlan(study, tuple(_planned(cell, study.study.folder) for cell in ordered))


def _planned(cell: Cell, out: str) -> PlannedCell:
    location = cell.location(out)
    if cell.unavailable:
        return PlannedCell(cell, location, "skipped", 0, f"skipped: {cell.unavailable}")
    try:
        run = open_run(locate(location), allow_partial=True)
    except (RunNotFoundError, RunIncompleteError):  # killed before it had a plan
        return PlannedCell(cell, location, "new", 0, "new")
    except ProbeKitError as error:
        return PlannedCell(cell, location, "damaged", 0, f"damaged: {error}")
    done = _stored(cell, run)
    seconds = _seconds(run)
    if done >= cell.episodes:
        return PlannedCell(cell, location, "whole", cell.episodes, "whole", seconds)
    return PlannedCell(cell, location, "partial", done, f"{done} of {cell.episodes} episodes", seconds)


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


def cells_by_model(cells: Sequence[PlannedCell]) -> dict[str, list[PlannedCell]]:
    """The cells of each model, in order."""
    found: dict[str, list[PlannedCell]] = {}
    for one in cells:
        found.setdefault(one.cell.model, []).append(one)
    return found
