"""Probes of a study: those that its file names, fitted to the stored runs."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import Failure, Ledger, Probed, now
from probe_kit.study.planning.plan import StudyPlan
from probe_kit.study.planning.planned_probes import control_cell, probes_of, what_decides
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.tables.stored_runs import of_blocks, open_cell
from probe_kit.train import train_probes

if TYPE_CHECKING:
    from probe_kit.study.tables.stored_runs import StoredRun

Progress = Callable[[str, int, int, str], None]


def fit_probes(plan: StudyPlan, progress: Progress | None = None, jobs: int | None = None) -> list[Failure]:
    """Fit the probes of a study file that a plan does not find stored. Returns what could not be fitted.

    The ledger notes what is stored and what failed; a failure of stage `waiting` says that a run is not whole yet.
    progress: called with the run's name, sites done, sites in all and the last one. jobs: processes, as in
    `train_probes`.
    """
    ledger, failures = Ledger(plan.study.study.folder), []
    stored = {(one.cell.name, own.name) for one in plan.cells for own in one.probes if own.state == "stored"}
    for cell in (one.cell for one in plan.cells):
        for name, table in probes_of(plan.study, cell):
            if (cell.name, name) in stored:
                continue
            entry = ledger.of(cell)
            try:
                probed = _fit(plan.study, table, cell, progress, jobs)
            except (RunNotFoundError, RunIncompleteError) as error:
                failures.append(Failure.of("waiting", cell.model, cell.name, error))
            except ProbeKitError as error:
                failure = Failure.of("probes", cell.model, cell.name, error)
                failures.append(failure)
                if not failure.same(entry.probe_failures.get(name)):
                    ledger.note(cell, probe_failures={**entry.probe_failures, name: failure})
            else:
                others = {one: own for one, own in entry.probe_failures.items() if one != name}
                ledger.note(cell, probes={**entry.probes, name: probed}, probe_failures=others)
    return failures


def _fit(
    study: LoadedStudy, table: ProbesTable, cell: Cell, progress: Progress | None, jobs: int | None
) -> Probed:
    own = _opened(study, table, cell)
    control = control_cell(study, cell, table)
    beside = None if control is None else _opened(study, table, control, of=cell)
    baselines = tuple(name for name in table.controls if name != "untrained")

    def report(done: int, sites: int, last: str) -> None:
        if progress is not None:
            progress(cell.name, done, sites, last)

    results = train_probes(
        own.run.in_wording(),
        views=table.views,
        permutations=table.permutations,
        target=table.target,
        controls=baselines or None,
        suite=study.suite.folder,
        untrained=None if beside is None else beside.run.in_wording(),
        seed=table.seed,
        jobs=jobs,
        progress=report,
    )
    known = what_decides(table, cell, own.run, None if beside is None else beside.run)
    return Probed(key=results.key, known=known, ended=now())


def _opened(study: LoadedStudy, table: ProbesTable, cell: Cell, of: Cell | None = None) -> "StoredRun":
    """The run of a cell, restricted to what is probed of it, or of another cell."""
    selection = of_blocks(table.runs)(of or cell)
    assert selection is not None, "the table is one of `probes_of`"
    return open_cell(study, cell, selection)
