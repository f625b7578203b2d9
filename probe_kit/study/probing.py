"""Probes of a study: those that its file names, fitted to the stored runs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError
from probe_kit.study.cells import Cell
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.tables.stored_runs import of_blocks, open_cell
from probe_kit.train import train_probes

Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class ProbeFailure:
    """Probes that were not fitted, and why. missing: because a run is not whole yet."""

    probes: str
    run: str
    reason: str
    missing: bool = False

    def __str__(self) -> str:
        return f"probes {self.probes} of {self.run}: {self.reason}"


def fit_probes(
    study: LoadedStudy, only: str | None = None, progress: Progress | None = None, jobs: int | None = None
) -> list[ProbeFailure]:
    """Fit the probes of a study file; those that are stored are loaded. Returns what could not be fitted.

    only: a block or a model, whose runs alone are probed. progress: called with the run's name, sites done, sites
    in all and the last one. jobs: processes, as in `train_probes`.
    """
    failures = []
    for name, table in study.study.probes.items():
        for cell in _cells(study, table, only):
            try:
                _fit(study, table, cell, progress, jobs)
            except (RunNotFoundError, RunIncompleteError) as error:
                failures.append(ProbeFailure(name, cell.name, str(error), missing=True))
            except ProbeKitError as error:
                failures.append(ProbeFailure(name, cell.name, str(error)))
    return failures


def _cells(study: LoadedStudy, table: ProbesTable, only: str | None) -> Iterator[Cell]:
    for cell in study.cells:
        chosen = only is None or only == cell.model or only in cell.selections
        if chosen and not cell.unavailable and of_blocks(table.runs)(cell) is not None:
            yield cell


def _fit(study: LoadedStudy, table: ProbesTable, cell: Cell, progress: Progress | None, jobs: int | None) -> None:
    selection = of_blocks(table.runs)(cell)
    assert selection is not None, "it was chosen by that"
    own = open_cell(study, cell, selection)
    control = _control(study, cell) if "untrained" in table.controls else None
    beside = None if control is None else open_cell(study, control, selection)
    baselines = tuple(name for name in table.controls if name != "untrained")

    def tell(done: int, sites: int, last: str) -> None:
        if progress is not None:
            progress(cell.name, done, sites, last)

    train_probes(
        own.run.in_wording(),
        views=table.views,
        permutations=table.permutations,
        target=table.target,
        controls=baselines or None,
        suite=study.suite.folder,
        untrained=None if beside is None else beside.run.in_wording(),
        seed=table.seed,
        jobs=jobs,
        progress=tell,
    )


def _control(study: LoadedStudy, cell: Cell) -> Cell | None:
    """The untrained network in the same condition; None for a model that has none, such as that network."""
    name = study.study.models[cell.model].untrained
    same = (one for one in study.cells if (one.model, one.way, one.seed) == (name, cell.way, cell.seed))
    return next(same, None)
