"""Making of a study's named tables."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour.vlm_answers import scored
from probe_kit.retention.compare.known_used import KnownUsedTable, correct_joins, match_runs
from probe_kit.retention.compare.vlm_vla import vlm_vla_differences
from probe_kit.retention.table import RetentionTable
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.mistakes import unknown
from probe_kit.study.planned_suite import slugs
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ComparisonTable, TableTable
from probe_kit.study.tables.compared import difference_table, group_table, stages_table, vlm_vla_table
from probe_kit.study.tables.named_table import NamedTable
from probe_kit.study.tables.rates import probing_table, score_table, sides_table, success_table
from probe_kit.study.tables.stored_runs import StoredRun, StoredRuns, of_blocks, stored_runs
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results

if TYPE_CHECKING:
    from probe_kit.extract import Run

_OF_RUNS: Mapping[str, Callable[[RetentionTable], NamedTable]] = {
    "success": success_table,
    "vlms": success_table,
    "sides": sides_table,
    "score": score_table,
    "probing": probing_table,
}


def make_table(study: LoadedStudy, name: str, partial: bool = False) -> NamedTable:
    """A table of a study file, from stored runs alone: no model and no simulator.

    partial: accept runs that are missing or unfinished; the note names them. Raises UsageError for an unknown name
    or a kind that no code makes yet, RunIncompleteError for runs that are missing, and what `open_run` raises.
    """
    if name not in study.study.tables:
        raise UsageError(unknown("table", name, list(study.study.tables)))
    table = study.study.tables[name]
    categories = None if table.categories is None else slugs(table.categories)
    runs = stored_runs(study, _wanted(study, table), partial, categories)
    if not runs.found:
        raise UsageError(
            f"no run of the table {name!r} is stored. Play them with `probe-kit study run {study.file}`"
        )
    return _made(study, table, runs, name).with_note(runs.missing)


def _made(study: LoadedStudy, table: TableTable, runs: StoredRuns, name: str) -> NamedTable:
    labels, opened = runs.labels(study), [one.run for one in runs.found]
    if table.kind in _OF_RUNS:
        return _OF_RUNS[table.kind](retention_table(opened, labels=labels, pairs=()))
    if table.kind == "vlm-vla":
        read = [scored(run, "text") for run in opened]
        return vlm_vla_table(vlm_vla_differences(read, labels, _sources(study, runs.found)))
    if table.kind == "stages":
        return stages_table(_joins(study, runs, labels))
    comparison = study.study.comparisons.get(table.comparison or "")
    if comparison is None:
        raise UsageError(f"tables of kind {table.kind!r} are not made by this version; {name!r} is one")
    if comparison.groups is not None:
        return group_table(retention_table(_groups(study, comparison.groups, runs), labels=labels), name)
    pairs = _pairs(comparison, runs.found)
    return difference_table(retention_table(opened, labels=labels, pairs=pairs), name)


def _wanted(study: LoadedStudy, table: TableTable) -> Callable[[Cell], Selection | None]:
    """What a table shows of each cell."""
    comparison = study.study.comparisons.get(table.comparison or "")
    if comparison is None:
        return of_blocks(table.runs or ())
    models, ways = _compared(study, comparison)

    def wanted(cell: Cell) -> Selection | None:
        blocks = table.runs is None or of_blocks(table.runs)(cell) is not None
        shown = cell.model in models and (ways is None or cell.way in ways) and not cell.asks and blocks
        return cell.selection if shown else None

    return wanted


def _compared(study: LoadedStudy, comparison: ComparisonTable) -> tuple[list[str], list[str] | None]:
    """Models of a comparison, and their conditions; None for the first condition that all have."""
    if comparison.pairs is not None:
        return comparison.pairs.models, comparison.pairs.conditions
    groups = set(comparison.groups or ())
    models = comparison.chain or [name for name, one in study.study.models.items() if groups & set(one.groups)]
    planned = [{cell.way for cell in study.cells if cell.model == name and not cell.asks} for name in models]
    common = set.intersection(*planned) if planned else set()
    return models, [way for way in study.study.conditions if way in common][:1]


def _pairs(comparison: ComparisonTable, found: tuple[StoredRun, ...]) -> list[tuple[str, str]]:
    """Locations of the runs that are compared, each the first minus the second."""
    if comparison.pairs is not None:
        reference, other = comparison.pairs.conditions
        there = {(one.cell.model, one.cell.way, one.cell.seed): one.place for one in found}
        return [
            (place, there[model, reference, seed])
            for (model, way, seed), place in there.items()
            if way == other and (model, reference, seed) in there
        ]
    chain = comparison.chain or []
    steps = [*zip(chain[1:], chain, strict=False), *([(chain[-1], chain[0])] if len(chain) > 2 else [])]
    by_model = {(one.cell.model, one.cell.seed): one.place for one in found}
    seeds = list(dict.fromkeys(one.cell.seed for one in found))
    return [
        (by_model[late, seed], by_model[early, seed])
        for late, early in steps
        for seed in seeds
        if (late, seed) in by_model and (early, seed) in by_model
    ]


def _sources(study: LoadedStudy, found: tuple[StoredRun, ...]) -> list[tuple[str, str]]:
    """Locations of the VLM runs and policy runs whose backbones are the same, as the file says."""
    return [
        (vlm.place, policy.place)
        for policy in found
        for vlm in found
        if vlm.cell.asks
        and not policy.cell.asks
        and study.study.models[policy.cell.model].vlm == vlm.cell.model
        and vlm.cell.seed == policy.cell.seed
    ]


def _joins(study: LoadedStudy, runs: StoredRuns, labels: Mapping[str, str]) -> list[KnownUsedTable]:
    """Every policy run joined with the run of its VLM, with the probes of the policy where there are any."""
    opened = {one.place: one.run for one in runs.found}
    joins = [
        replace(
            match_runs(scored(opened[vlm], "text"), opened[policy], _probes(opened[policy])),
            asked=labels[vlm],
            acted=labels[policy],
        )
        for vlm, policy in _sources(study, runs.found)
    ]
    return correct_joins(joins)


def _probes(run: "Run") -> ProbeResults | None:
    try:
        return load_results(run)
    except NoProbesError:
        return None


def _groups(study: LoadedStudy, names: list[str], runs: StoredRuns) -> "dict[str, list[Run]]":
    models = study.study.models
    return {name: [one.run for one in runs.found if name in models[one.cell.model].groups] for name in names}
