"""Making of a study's named tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour.vlm_answers import scored
from probe_kit.retention.compare.known_used import KnownUsedTable, correct_joins, match_runs
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.provenance import differences
from probe_kit.study.archive import TABLES, Pack
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.drift.measures import CategoryDrift, measure_drift
from probe_kit.study.mistakes import unknown
from probe_kit.study.planned_suite import slugs
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ComparisonTable, DriftTable, TableTable
from probe_kit.study.tables.compared import difference_table, group_table, stages_table, vlm_vla_table
from probe_kit.study.tables.drifts import drift_table
from probe_kit.study.tables.formats import table_of_record
from probe_kit.study.tables.named_table import NamedTable, Number
from probe_kit.study.tables.rates import (
    as_paper_table,
    probing_table,
    score_table,
    sides_table,
    success_table,
    vlm_table,
)
from probe_kit.study.tables.stored_runs import (
    StoredRun,
    StoredRuns,
    of_blocks,
    probe_keys,
    stored_runs,
    study_probes,
)

_OF_RUNS: Mapping[str, Callable[[RetentionTable], NamedTable]] = {
    "success": success_table,
    "vlms": vlm_table,
    "sides": sides_table,
}
_OF_PROBED_RUNS: Mapping[str, Callable[[RetentionTable], NamedTable]] = {
    "probing": probing_table,
    "as-paper": as_paper_table,
}


def make_table(study: LoadedStudy, name: str, partial: bool = False) -> NamedTable:
    """A table of a study file, from stored runs alone: no model and no simulator.

    partial: accept runs that are missing or unfinished; the note names them. Raises UsageError for an unknown
    name, RunIncompleteError for runs that are missing, and what `open_run` raises.
    """
    if name not in study.study.tables:
        raise UsageError(unknown("table", name, list(study.study.tables)))
    table = study.study.tables[name]
    if study.pack is not None and table.kind == "drift":
        return _packed(study.file.parent, study.pack, name)
    runs = stored_runs(study, _wanted(study, table), partial, _categories(table))
    if not runs.found:
        raise UsageError(
            f"no run of the table {name!r} is stored. Play them with `probe-kit study run {study.file}`"
        )
    made = _made(study, table, runs, name, partial).with_note([*runs.missing, *runs.unfinished, *_versions(runs)])
    return replace(made, is_partial=bool(runs.unfinished), numbers=_named_runs(made.numbers, runs))


def _named_runs(numbers: Sequence[Number], runs: StoredRuns) -> tuple[Number, ...]:
    """Numbers with runs as the plan names them: a location says where a run lies now, or where it was unpacked.

    What is not defined is None, because JSON has no NaN.
    """
    names = {one.place: one.cell.name for one in runs.found}
    defined = ({name: _defined(value) for name, value in one.items()} for one in numbers)
    return tuple({**one, "run": names[one["run"]]} if one.get("run") in names else one for one in defined)


def _defined(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_defined, value))
    return None if isinstance(value, float) and not isfinite(value) else value


def _categories(table: TableTable) -> tuple[str, ...] | None:
    return None if table.categories is None else slugs(table.categories)


def _packed(archive: Path, pack: Pack, name: str) -> NamedTable:
    """A table as it was packed, because it is made of activations."""
    file = archive / TABLES / f"{name}.json"
    try:
        return table_of_record(load_json(file))
    except FileNotFoundError:
        why = pack.missing.get(f"table {name}", "it was not made")
        raise UsageError(f"the archive holds no table {name!r}: {why}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunDamagedError(f"{file} is no record of a table ({error!r}). Fetch the archive again") from error


def _versions(runs: StoredRuns) -> list[str]:
    """What changes numbers and is not the same for all runs, such as the version of torch."""
    made = [own for one in runs.found for own in one.run.provenances.values()]
    different = ", ".join(differences(made))
    return [f"runs were made with different {different}"] if different else []


def _made(study: LoadedStudy, table: TableTable, runs: StoredRuns, name: str, partial: bool) -> NamedTable:
    labels, opened = runs.labels(study), [one.run for one in runs.found]
    none = [""] * len(opened)
    if table.kind in _OF_RUNS:
        return _OF_RUNS[table.kind](retention_table(opened, labels=labels, pairs=(), keys=none))
    if table.kind == "score":
        scores, further = retention_table(opened, labels=labels, pairs=(), keys=none), table.elsewhere
        if further is None:
            return score_table(scores)
        named = {one.place: one.cell.model for one in runs.found}
        values = {place: further.values[name] for place, name in named.items() if name in further.values}
        return score_table(scores, further.title, further.source, values)
    if table.kind == "vlm-vla":
        pairs = _sources(study, runs.found)
        return vlm_vla_table(retention_table(opened, labels=labels, pairs=(), keys=none, vlm_vla=pairs).vlm_vla)
    if table.kind in _OF_PROBED_RUNS:
        probed = [(one, one.probed.in_wording()) for one in runs.found]
        keys, categories = probe_keys(study, probed, partial), _categories(table)
        return _OF_PROBED_RUNS[table.kind](
            retention_table([run for _, run in probed], labels=labels, pairs=(), categories=categories, keys=keys)
        )
    if table.kind == "drift":
        return _drift(study, study.study.drift[table.drift or ""], runs, labels, name, partial)
    if table.kind == "stages":
        return stages_table(_joins(study, runs, labels, partial))
    comparison = study.study.comparisons[table.comparison or ""]
    if comparison.groups is not None:
        groups = _groups(study, comparison.groups, runs)
        keys = probe_keys(study, [(one, one.run) for own in groups.values() for one in own], partial)
        grouped = {group: [one.run for one in own] for group, own in groups.items()}
        origins = {str(one.run.location): _origin(study, one.cell.model) for own in groups.values() for one in own}
        found = retention_table(grouped, labels=labels, keys=keys, origins=origins)
        return group_table(found, f"Groups of models: {name}")
    pairs, what = _pairs(comparison, runs.found), "Ablation" if comparison.chain is None else "Chain"
    keys = probe_keys(study, [(one, one.run) for one in runs.found], partial)
    return difference_table(retention_table(opened, labels=labels, pairs=pairs, keys=keys), f"{what}: {name}")


def _wanted(study: LoadedStudy, table: TableTable) -> Callable[[Cell], Selection | None]:
    """What a table shows of each cell."""
    if table.kind == "drift":
        pairs = study.study.drift[table.drift or ""].pairs
        names = {cell.name for pair in pairs for side in pair for cell in _side(study.cells, side)}
        return lambda cell: cell.selection if cell.name in names else None
    comparison = study.study.comparisons.get(table.comparison or "")
    if comparison is None:
        return of_blocks(table.runs or ())
    models, ways = _compared(study, comparison)
    asks = comparison.pairs is not None  # a chain and groups are of policies

    def wanted(cell: Cell) -> Selection | None:
        blocks = table.runs is None or of_blocks(table.runs)(cell) is not None
        shown = cell.model in models and cell.way in ways and (asks or not cell.asks) and blocks
        return cell.selection if shown else None

    return wanted


def _compared(study: LoadedStudy, comparison: ComparisonTable) -> tuple[list[str], list[str]]:
    """Models of a comparison, and their conditions: those of its pairs, else the first that all models have."""
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


def _drift(
    study: LoadedStudy,
    table: DriftTable,
    runs: StoredRuns,
    labels: Mapping[str, str],
    name: str,
    partial: bool,
) -> NamedTable:
    """Every pair of the file whose runs are both stored."""
    there = {one.cell.name: one for one in runs.found}
    found: dict[tuple[str, str], list[CategoryDrift]] = {}
    for cells in ([_side(study.cells, side) for side in pair] for pair in table.pairs):
        for before, after in ((there.get(one.name), there.get(other.name)) for one, other in product(*cells)):
            if before is not None and after is not None and before.cell.seed == after.cell.seed:
                sides = [study_probes(study, one, one.probed.in_wording(), partial) for one in (before, after)]
                shown = set(before.run.items["category"])
                named = {one.place: labels[one.place] for one in (before, after)}
                each = measure_drift(
                    before.probed.in_wording(), after.probed.in_wording(), table.view, named, sides
                )
                found[labels[before.place], labels[after.place]] = [one for one in each if one.category in shown]
    return drift_table(found, name, table.view)


def _side(cells: Sequence[Cell], side: str) -> list[Cell]:
    """The runs that a side of a pair names: those of a model's first condition, or of the one that is given."""
    model, _, way = side.partition("/")
    own = [cell for cell in cells if cell.model == model and (cell.way == way if way else not cell.asks)]
    return [cell for cell in own if cell.way == own[0].way]


def _joins(study: LoadedStudy, runs: StoredRuns, labels: Mapping[str, str], partial: bool) -> list[KnownUsedTable]:
    """Every policy run joined with the run of its VLM, with the probes of the policy where there are any."""
    opened = {one.place: one for one in runs.found}
    probes = {place: study_probes(study, one, one.probed, partial) for place, one in opened.items()}
    joins = [
        replace(
            match_runs(scored(opened[vlm].run, "text"), opened[policy].run, probes[policy]),
            asked=labels[vlm],
            acted=labels[policy],
        )
        for vlm, policy in _sources(study, runs.found)
    ]
    return correct_joins(joins)


def _origin(study: LoadedStudy, model: str) -> str:
    """Return the model that a model was trained from, or itself: the first of the chain of `finetuned_from`."""
    while (earlier := study.study.models[model].finetuned_from) is not None:
        model = earlier
    return model


def _groups(study: LoadedStudy, names: list[str], runs: StoredRuns) -> dict[str, list[StoredRun]]:
    models = study.study.models
    return {name: [one for one in runs.found if name in models[one.cell.model].groups] for name in names}
