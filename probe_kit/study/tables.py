"""The tables of a study: those of differences, and every one that a file names, made of stored runs."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import isfinite
from operator import attrgetter
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import load_json
from probe_kit._tables.content import Number
from probe_kit._tables.numbers import p_text, percent, points
from probe_kit._tables.table import Cell, Table
from probe_kit.errors import ProbeKitError, RunDamagedError, UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import scored
from probe_kit.retention.columns.tables import behaviour_once
from probe_kit.retention.columns.text import P_DECIDES, difference_test, models_test
from probe_kit.retention.compare.compare import MANY, Difference, with_holm
from probe_kit.retention.compare.known_used import (
    OVERALL,
    CategoryCounts,
    KnownUsedTable,
    correct_joins,
    match_runs,
    without_signal,
)
from probe_kit.retention.rows.row import MEAN
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.provenance import differences
from probe_kit.study.archive import TABLES, Pack, table_of_record
from probe_kit.study.cells import ItemSelection, PlannedRun, slugs
from probe_kit.study.drift import CategoryDrift, drift_table, measure_drift
from probe_kit.study.expansion import runs_of_side
from probe_kit.study.rates import caption, probing_table, score_table, sides_table, success_table, vlm_table
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ComparisonTable, DriftTable, TableTable, complaint_of_unknown
from probe_kit.study.stored import StoredRun, StoredRuns, probe_key, stored_runs, study_probes
from probe_kit.suite.categories import category_of

FEWEST_GROUPS = 10
"""Number of groups of items from which a difference is tested, and counts for Holm's correction of the others.

Signs of 10 groups give no p below 2⁻⁹ = 0.002, two-sided: enough for Holm's correction over two dozen tests.
"""
_FEW = "!"


def _note_on_tests(family: str) -> str:
    """Return how differences are tested; `family` holds the tests that Holm's correction counts."""
    return (
        f"p: exact, signs of whole groups of items flipped; (Holm) over all categories and pairs of {family}; "
        f"{P_DECIDES}"
    )


def difference_table(table: RetentionTable, title: str) -> Table:
    """Return differences of success rates, a row per pair and category.

    The whole comparison is one family of tests.
    """
    rows = _test_differences(behaviour_once(table.differences))
    cells = [
        (
            f"{row.group} − {row.minus}",
            _title(row.category),
            Cell(row.sr, points, row.sr_ci),
            difference_test(row),
            _items(row.n_items, row.of_items),
        )
        for row in rows
    ]
    columns = ("systems", "category", "difference, points [95 %]", "p (Holm)", "items")
    notes = [
        caption(table, [_note_on_tests("this comparison")]),
        *_remarks(rows),
        *(text.removesuffix(".") for text in table.unpaired),
    ]
    numbers = tuple(map(_difference_numbers, rows))
    return Table.of(title, columns, cells, names=2, mean=MEAN, notes=notes, numbers=numbers)


def _test_differences(rows: Sequence[Difference]) -> list[Difference]:
    """Return the same rows without tests of fewer than FEWEST_GROUPS groups, and Holm's p over the others."""
    return with_holm([row if (row.n_groups or 0) >= FEWEST_GROUPS else replace(row, p=None) for row in rows])


def _items(count: int | None, of_count: int | None) -> Cell:
    """Return the items in common, of how many where some are left out, marked where that is more than a fifth."""
    if count is None or of_count is None:
        return Cell("other items" if count is None else count)
    if count == of_count:
        return Cell(count)
    return Cell(count, after=f" of {of_count}" + (f" {_FEW}" if count < MANY * of_count else ""))


def _remarks(rows: Sequence[Difference]) -> list[str]:
    left_out = any(row.n_items is not None and (row.n_items < MANY * (row.of_items or 0)) for row in rows)
    few = any(row.n_groups is not None and row.n_groups < FEWEST_GROUPS for row in rows)
    remarks = [f"{_FEW} fewer than {100 * MANY:.0f} % of the items in common"] if left_out else []
    return remarks + ([f"no p with fewer than {FEWEST_GROUPS} independent groups of items"] if few else [])


def group_table(table: RetentionTable, title: str) -> Table:
    """Return the differences of groups of models: the exact p over models first, then these models' interval."""
    rows = behaviour_once(table.differences)
    cells = [
        (
            f"{row.group} − {row.minus}",
            _title(row.category),
            models_test(row.sr_models, points),
            Cell(row.sr, points, row.sr_ci),
        )
        for row in rows
    ]
    note = (
        "p over models: exact, labels of models exchanged, in brackets the least that so few models allow and "
        "Welch's interval; runs of one model are averaged; the last column is of these models on other items"
    )
    columns = ("groups", "category", "p over models (least)", "these models, points [95 %]")
    # The p over items is about these models alone, and the table about others like them.
    numbers = tuple({**_difference_numbers(row), "p": None, "p_holm": None} for row in rows)
    return Table.of(title, columns, cells, names=2, mean=MEAN, notes=[caption(table, [note])], numbers=numbers)


def vlm_vla_table(differences: Sequence[Difference]) -> Table:
    """Return the share right of VLMs minus the success rate of policies, where the file names a policy's VLM."""
    rows = _test_differences(differences)
    cells = [
        (
            f"{row.group} − {row.minus}",
            _title(row.category),
            Cell(row.sr_group, percent),
            Cell(row.sr_minus, percent),
            Cell(row.sr, percent, row.sr_ci),
            Cell(row.p_holm, p_text),
            _items(row.n_items, row.of_items),
        )
        for row in rows
    ]
    numbers = [
        {
            "vlm": row.group,
            "policy": row.minus,
            "category": row.category,
            "accuracy": row.sr_group,
            "sr": row.sr_minus,
            "difference": row.sr,
            "ci": row.sr_ci,
            "p": row.p,
            "p_holm": row.p_holm,
            "items": row.n_items,
            "of_items": row.of_items,
            "groups": row.n_groups,
            "same_frames": row.same_frames,
            "source": row.source,
        }
        for row in rows
    ]
    other = "; some pairs began with OTHER first frames" if any(row.same_frames is False for row in rows) else ""
    notes = [f"{_note_on_tests('the table')}{other}", *_remarks(rows)]
    columns = ("systems", "category", "VLM %", "VLA %", "VLM − VLA [95 %]", "p (Holm)", "items")
    return Table.of("VLM − VLA", columns, cells, names=2, mean=MEAN, notes=notes, numbers=tuple(numbers))


def stages_table(joins: Sequence[KnownUsedTable]) -> Table:
    """Return items with the VLM's answer, the probe and success right, each in both layouts.

    Items with the probe right are counted where the answer is shown.
    """
    pairs = [(join, row) for join in joins for row in join.rows]
    cells = [
        (
            f"{join.vlm} · {join.policy}",
            row.category if row.category == OVERALL else category_of(row.category).title,
            Cell(row.n_items),
            Cell(row.answered_correctly),
            Cell("not shown" if row.has_signal is False else _encoded_items(join, row)),
            Cell(row.acted_correctly),
            Cell(row.answered_and_encoded),
            Cell(row.share_not_acted_on, percent, row.share_not_acted_on_ci or (None, None)),
        )
        for join, row in pairs
    ]
    numbers = [
        {
            "vlm": join.vlm,
            "policy": join.policy,
            "view": join.view,
            "category": row.category,
            "items": row.n_items,
            "answered": row.answered_correctly,
            "encoded": _encoded_items(join, row),
            "acted_on": row.acted_correctly,
            "answered_and_encoded": row.answered_and_encoded,
            "share_not_acted_on": row.share_not_acted_on,
            "ci": row.share_not_acted_on_ci,
            "signal": row.has_signal,
        }
        for join, row in pairs
    ]
    columns = (
        "systems",
        "category",
        "items",
        "answer right",
        "probe right",
        "success",
        "answer and probe right",
        "of these without success %",
    )
    notes = [
        "items right in both layouts, which guessing manages in 25 %; lost: share of answered and encoded ones"
    ]
    if any(row.has_signal is False for _, row in pairs):
        notes.append("not shown: probes are not shown to exceed chance and every control")
    texts = [text for join in joins for text in join.notes if text not in without_signal(join.rows)]
    notes += dict.fromkeys(text.removesuffix(".") for text in texts)
    return Table.of("Stages", columns, cells, names=2, mean=OVERALL, notes=notes, numbers=tuple(numbers))


def _encoded_items(join: KnownUsedTable, row: CategoryCounts) -> int | None:
    """Return the encoded items of categories whose probes have signal; the overall row is their sum."""
    if row.encoded is None or row.has_signal is False:
        return None
    inside = join.rows if row.category == OVERALL else (row,)
    return sum(part.encoded or 0 for part in inside if part.has_signal and part.category != OVERALL)


def _title(category: str) -> str:
    return category if category == MEAN else category_of(category).title


def _difference_numbers(row: Difference) -> Number:
    models = row.sr_models
    return {
        "system": row.group,
        "minus": row.minus,
        "category": row.category,
        "difference": row.sr,
        "ci": row.sr_ci,
        "p": row.p,
        "p_holm": row.p_holm,
        "items": row.n_items,
        "of_items": row.of_items,
        "groups": row.n_groups,
        "p_over_models": None if models is None else models.p,
        "least_p_over_models": None if models is None else models.smallest_p,
        "models_ci": None if models is None else models.ci,
    }


# -- tables by name ----------------------------------------------------------------------------------------------


_OF_RUNS: Mapping[str, Callable[[RetentionTable], Table]] = {
    "success": success_table,
    "vlms": vlm_table,
    "sides": sides_table,
}
_OF_PROBED_RUNS: Mapping[str, Callable[[RetentionTable], Table]] = {
    "probing": probing_table,
    "as-paper": attrgetter("as_paper"),
}


def make_table(study: LoadedStudy, name: str, partial: bool = False) -> Table:
    """Make a table of a study file from stored runs alone: no model and no simulator; raises as `open_run` too.

    Args:
        study: The study whose runs are stored.
        name: Name of the table in the file.
        partial: Accept runs that are missing or unfinished; the note names them.

    Raises:
        UsageError: For an unknown name.
        RunIncompleteError: For runs that are missing.
    """
    if name not in study.study.tables:
        raise UsageError(complaint_of_unknown("table", name, list(study.study.tables)))
    table = study.study.tables[name]
    if study.pack is not None and table.kind == "drift":
        return _packed_table(study.file.parent, study.pack, name)
    subject = f"the table {name!r}"
    stored = stored_runs(study, _selection(study, table), subject, partial, _categories(table))
    provenances = [provenance for run in stored.runs for provenance in run.run.provenances.values()]
    different = ", ".join(differences(provenances))  # what changes numbers, such as the version of torch
    versions = [f"runs were made with different {different}"] if different else []
    printed = _table_of_kind(study, table, stored, name, partial)
    printed = printed.with_notes([*stored.missing, *stored.unfinished, *versions])
    return replace(printed, is_partial=bool(stored.unfinished), numbers=_numbers(printed.numbers, stored))


def make_each[Made](
    names: Iterable[str], make: Callable[[str], Made], partial: bool
) -> tuple[dict[str, Made], dict[str, str]]:
    """Make a table or figure of every name; return also the reasons why others are missing.

    Raises as `make`, unless `partial`.
    """
    by_name, missing = dict[str, Made](), dict[str, str]()
    for name in names:
        try:
            by_name[name] = make(name)
        except ProbeKitError as error:
            if not partial:
                raise
            missing[name] = str(error)
    return by_name, missing


def _numbers(numbers: Sequence[Number], stored: StoredRuns) -> tuple[Number, ...]:
    """Return numbers with the plan's names of runs, because an archive is unpacked at another location.

    A value that is not defined is None, because JSON has no NaN.
    """
    names = {run.location: run.cell.name for run in stored.runs}
    defined = ({name: _defined_value(value) for name, value in number.items()} for number in numbers)
    return tuple(
        {**number, "run": names[number["run"]]} if number.get("run") in names else number for number in defined
    )


def _defined_value(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_defined_value, value))
    return None if isinstance(value, float) and not isfinite(value) else value


def _categories(table: TableTable) -> tuple[str, ...] | None:
    return None if table.categories is None else slugs(table.categories)


def _packed_table(archive: Path, pack: Pack, name: str) -> Table:
    """Return a table as it was packed, because it is made of activations."""
    file = archive / TABLES / f"{name}.json"
    try:
        return table_of_record(load_json(file))
    except FileNotFoundError:
        why = pack.missing.get(f"table {name}", "it was not made")
        raise UsageError(f"the archive holds no table {name!r}: {why}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunDamagedError(f"{file} is no record of a table ({error!r}). Fetch the archive again") from error


def _table_of_kind(study: LoadedStudy, table: TableTable, stored: StoredRuns, name: str, partial: bool) -> Table:
    def keys(runs: Sequence[StoredRun]) -> list[str]:
        return [probe_key(study, run, run.run, partial) for run in runs]

    labels, opened = stored.labels, [run.run for run in stored.runs]
    no_keys = [""] * len(opened)  # tables without probes read none
    if table.kind in _OF_RUNS:
        return _OF_RUNS[table.kind](retention_table(opened, labels=labels, pairs=(), keys=no_keys))
    if table.kind == "score":
        scores, elsewhere = retention_table(opened, labels=labels, pairs=(), keys=no_keys), table.elsewhere
        if elsewhere is None:
            return score_table(scores)
        values = elsewhere.values
        by_location = {run.location: values[run.cell.model] for run in stored.runs if run.cell.model in values}
        return score_table(scores, elsewhere.title, elsewhere.source, by_location)
    if table.kind == "vlm-vla":
        vlms = retention_table(opened, labels=labels, pairs=(), keys=no_keys, vlm_vla=_sources(study, stored.runs))
        return vlm_vla_table(vlms.vlm_vla)
    if table.kind in _OF_PROBED_RUNS:
        parts = [run.probed.in_wording() for run in stored.runs]
        of_parts = [probe_key(study, run, part, partial) for run, part in zip(stored.runs, parts, strict=True)]
        categories = _categories(table)
        return _OF_PROBED_RUNS[table.kind](
            retention_table(parts, labels=labels, pairs=(), categories=categories, keys=of_parts)
        )
    if table.kind == "drift":
        return _drift(study, study.study.drift[table.drift or ""], stored, name, partial)
    if table.kind == "stages":
        return stages_table(_joins(study, stored, partial))
    comparison = study.study.comparisons[table.comparison or ""]
    if comparison.groups is not None:
        models = study.study.models
        groups = {
            group: [run for run in stored.runs if group in models[run.cell.model].groups]
            for group in comparison.groups
        }
        members = [run for of_group in groups.values() for run in of_group]
        return group_table(
            retention_table(
                {group: [run.run for run in of_group] for group, of_group in groups.items()},
                labels=labels,
                keys=keys(members),
                origins={run.location: _origin(study, run.cell.model) for run in members},
            ),
            f"Groups of models: {name}",
        )
    title = "Ablation" if comparison.chain is None else "Chain"
    pairs = _pairs(comparison, stored.runs)
    return difference_table(
        retention_table(opened, labels=labels, pairs=pairs, keys=keys(stored.runs)), f"{title}: {name}"
    )


def _selection(study: LoadedStudy, table: TableTable) -> Callable[[PlannedRun], ItemSelection | None]:
    if table.kind == "drift":
        pairs = study.study.drift[table.drift or ""].pairs
        names = {cell.name for pair in pairs for side in pair for cell in runs_of_side(study.cells, side)}
        return lambda cell: cell.selection if cell.name in names else None
    comparison = study.study.comparisons.get(table.comparison or "")
    if comparison is None:
        return lambda cell: cell.selected(table.runs or ())
    models, ways = _compared_models(study, comparison)
    asks = comparison.pairs is not None  # a chain and groups are of policies

    def select(cell: PlannedRun) -> ItemSelection | None:
        blocks = table.runs is None or cell.selected(table.runs) is not None
        is_compared = cell.model in models and cell.way in ways and (asks or not cell.asks) and blocks
        return cell.selection if is_compared else None

    return select


def _compared_models(study: LoadedStudy, comparison: ComparisonTable) -> tuple[list[str], list[str]]:
    """Return the models of a comparison, and their conditions: of its pairs, else the first that all have."""
    if comparison.pairs is not None:
        return comparison.pairs.models, comparison.pairs.conditions
    groups = set(comparison.groups or ())
    models = comparison.chain or [name for name, model in study.study.models.items() if groups & set(model.groups)]
    planned = [{cell.way for cell in study.cells if cell.model == name and not cell.asks} for name in models]
    common = set.intersection(*planned) if planned else set()
    return models, [way for way in study.study.conditions if way in common][:1]


def _pairs(comparison: ComparisonTable, runs: Sequence[StoredRun]) -> list[tuple[str, str]]:
    """Return the locations of the runs that are compared, each the first minus the second."""
    if comparison.pairs is not None:
        reference, other = comparison.pairs.conditions
        by_cell = {(run.cell.model, run.cell.way, run.cell.seed): run.location for run in runs}
        return [
            (location, by_cell[model, reference, seed])
            for (model, way, seed), location in by_cell.items()
            if way == other and (model, reference, seed) in by_cell
        ]
    chain = comparison.chain or []
    # Every step, then the whole way; of two models that is the step itself.
    steps = [*zip(chain[1:], chain, strict=False), *([(chain[-1], chain[0])] if len(chain) > 2 else [])]
    by_model = {(run.cell.model, run.cell.seed): run.location for run in runs}
    return [
        (by_model[late, seed], by_model[early, seed])
        for late, early in steps
        for seed in dict.fromkeys(run.cell.seed for run in runs)
        if (late, seed) in by_model and (early, seed) in by_model
    ]


def _sources(study: LoadedStudy, runs: Sequence[StoredRun]) -> list[tuple[str, str]]:
    """Return the locations of the VLM runs and policy runs whose backbones are the same according to the file."""
    return [
        (vlm.location, policy.location)
        for policy in runs
        for vlm in runs
        if vlm.cell.asks
        and not policy.cell.asks
        and study.study.models[policy.cell.model].vlm == vlm.cell.model
        and vlm.cell.seed == policy.cell.seed
    ]


def _drift(study: LoadedStudy, table: DriftTable, stored: StoredRuns, name: str, partial: bool) -> Table:
    by_name, labels = {run.cell.name: run for run in stored.runs}, stored.labels
    drifts: dict[tuple[str, str], list[CategoryDrift]] = {}
    for cells in ([runs_of_side(study.cells, side) for side in pair] for pair in table.pairs):
        for pair in product(*cells):
            before, after = (by_name.get(cell.name) for cell in pair)
            if before is None or after is None or before.cell.seed != after.cell.seed:
                continue
            runs = (before, after)
            of_pair = measure_drift(
                before.probed.in_wording(),
                after.probed.in_wording(),
                table.view,
                {run.location: labels[run.location] for run in runs},
                [study_probes(study, run, run.probed.in_wording(), partial) for run in runs],
            )
            printed = set(before.run.items["category"])
            drifts[labels[before.location], labels[after.location]] = [
                drift for drift in of_pair if drift.category in printed
            ]
    return drift_table(drifts, name, table.view)


def _joins(study: LoadedStudy, stored: StoredRuns, partial: bool) -> list[KnownUsedTable]:
    """Join every policy run with the run of its VLM, with the probes of the policy where there are any."""
    runs = {run.location: run for run in stored.runs}
    probes = {location: study_probes(study, run, run.probed, partial) for location, run in runs.items()}
    joins = [
        replace(
            match_runs(scored(runs[vlm].run, "text"), runs[policy].run, probes[policy]),
            vlm=stored.labels[vlm],
            policy=stored.labels[policy],
        )
        for vlm, policy in _sources(study, stored.runs)
    ]
    return correct_joins(joins)


def _origin(study: LoadedStudy, model: str) -> str:
    """Return the model that a model was trained from, or itself: the first of the chain of `finetuned_from`."""
    while (earlier := study.study.models[model].finetuned_from) is not None:
        model = earlier
    return model
