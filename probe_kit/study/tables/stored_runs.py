"""The stored runs that a table is made of, restricted to what its blocks select, and why others are missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._terminal.console import say
from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError, UsageError
from probe_kit.extract import open_run
from probe_kit.extract.store.locations.locate import locate
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.ledger import Ledger
from probe_kit.study.reading import LoadedStudy, load_study, shipped_studies

if TYPE_CHECKING:
    from probe_kit.extract import Run
    from probe_kit.extract.store.locations.location import Location


@dataclass(frozen=True)
class StoredRun:
    """A run of the study, and the cell it is of.

    run: the items that a table shows. probed: those that the file's probes are fitted to.
    """

    cell: Cell
    run: "Run"
    probed: "Run"

    @property
    def place(self) -> str:
        """Its location, as tables name runs."""
        return str(self.run.location)


@dataclass(frozen=True)
class StoredRuns:
    """found: in the order of the file. missing: of the others, why they are not in the table.

    unfinished: what `study run` would still play of both, in words; only of partial tables. models: of every run,
    stored or not.
    """

    found: tuple[StoredRun, ...]
    missing: tuple[str, ...]
    unfinished: tuple[str, ...]
    models: tuple[str, ...]

    def labels(self, study: LoadedStudy) -> dict[str, str]:
        """By location, the model's label; with condition or ask, and seed, where a model has several runs."""
        return {one.place: _label(study, one.cell, self.models.count(one.cell.model) > 1) for one in self.found}


def stored_runs(
    study: LoadedStudy,
    wanted: Callable[[Cell], Selection | None],
    partial: bool = False,
    categories: Sequence[str] | None = None,
) -> StoredRuns:
    """Open what is stored of a study. wanted: of a cell, what of it a table shows; None leaves it out.

    partial: accept runs that are missing or unfinished; they are named. categories: slugs, all by default.
    Raises RunIncompleteError for a run that is missing, unfinished or damaged, unless `partial`.
    """
    found, missing, unfinished, models = [], [], [], []
    for cell in study.cells:
        selection = wanted(cell)
        if selection is None:
            continue
        models.append(cell.model)
        label = _label(study, cell, True)
        if cell.unavailable:
            missing.append(f"{label} is missing: {cell.unavailable}")
            continue
        try:
            own = open_cell(study, cell, selection, partial, categories)
            found.append(own)
            if done := _part_done(own.run):
                unfinished.append(f"{label} has {done} episodes")
        except ProbeKitError as error:
            if not partial:
                raise RunIncompleteError(
                    f"{cell.name} is not whole: {_seen(error)}. Finish it with `probe-kit study run {study.file}`,"
                    " or accept what is there (--partial)"
                ) from error
            unfinished.append(f"{label} is missing: {_why_missing(study, cell, error)}")
    return StoredRuns(tuple(found), tuple(missing), tuple(unfinished), tuple(models))


def _part_done(run: "Run") -> str:
    """How many of its episodes an unfinished run has, empty for a whole one."""
    done = len(run.episodes)
    return f"{done} of {run.planned}" if done < run.planned else ""


def _why_missing(study: LoadedStudy, cell: Cell, error: ProbeKitError) -> str:
    """The failure that the ledger has, or else what is wrong with the run."""
    failure = None if study.archive is not None else Ledger(study.study.folder).of(cell).failure
    if failure is not None:
        return failure.reason
    return "not played yet" if isinstance(error, RunNotFoundError) else _seen(error)


def _seen(error: ProbeKitError) -> str:
    """What an error says was seen, without its advice on a single run."""
    return str(error).partition(". ")[0].removesuffix(".")


def stored_location(study: LoadedStudy, cell: Cell) -> "Location":
    """Where the run of a cell lies: in its own place, or where an equal run serves it."""
    out = study.study.folder
    return locate(Ledger(out).location(cell, out))


def open_cell(
    study: LoadedStudy,
    cell: Cell,
    selection: Selection,
    partial: bool = False,
    categories: Sequence[str] | None = None,
) -> StoredRun:
    """The stored run of a cell, restricted to a selection. Raises what `open_run` raises."""
    run = open_run(stored_location(study, cell), allow_partial=partial)
    of_probes = (of_blocks(table.runs)(cell) for table in study.study.probes.values())
    fitted = next((one for one in of_probes if one is not None), None)
    shown = _part(run, cell, selection, categories)
    return StoredRun(cell, shown, shown if fitted is None else _part(run, cell, fitted, None))


def _part(run: "Run", cell: Cell, selection: Selection, categories: Sequence[str] | None) -> "Run":
    """What is shown of a run, which may hold more: of other blocks, or of a former state of the file."""
    wanted = selection.counts(cell.suite)
    counts = {name: count for name, count in wanted.items() if categories is None or name in categories}
    if counts == run.items["category"].value_counts().to_dict():
        return run
    return run.only(list(counts), selection.items)


def _label(study: LoadedStudy, cell: Cell, several: bool) -> str:
    label = study.study.models[cell.model].label or cell.model
    seed = f", seed {cell.seed}" if cell.seed else ""
    return f"{label} · {cell.way}{seed}" if several or seed else label


def of_blocks(names: Sequence[str]) -> Callable[[Cell], Selection | None]:
    """What cells hold for some blocks."""

    def wanted(cell: Cell) -> Selection | None:
        own = [selection for name, selection in cell.selections.items() if name in names]
        if not own:
            return None
        first, *others = own
        for other in others:
            first = first.joined(other)
        return first

    return wanted


def stored_runs_by_name(name: str) -> "list[Run] | None":
    """What is stored of a study file, or of a study of the package; None for a name of neither.

    Runs that are missing are named on the terminal. Raises UsageError if none is stored, and as `load_study` does.
    """
    if not (name.endswith(".toml") or (name in shipped_studies() and not Path(name).exists())):
        return None
    study = load_study(name)
    found = stored_runs(
        study, of_blocks([block for cell in study.cells for block in cell.selections]), partial=True
    )
    for remark in (*found.missing, *found.unfinished):
        say(remark)
    if not found.found:
        raise UsageError(f"no run of {study.file} is stored. Play it with `probe-kit study run {name}`")
    return [one.probed for one in found.found]
