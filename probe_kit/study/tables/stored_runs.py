"""The stored runs that a table is made of, restricted to what its blocks select, and why others are missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._terminal.console import say
from probe_kit.errors import (
    ProbeKitError,
    RunIncompleteError,
    RunNotFoundError,
    SettingsMismatchError,
    UsageError,
)
from probe_kit.runs import open_run
from probe_kit.runs.store import locate
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.ledger import Entry, Ledger
from probe_kit.study.matching import check_run_of_cell, check_same_items
from probe_kit.study.reading import LoadedStudy, load_study, shipped_studies
from probe_kit.study.schema import ProbesTable
from probe_kit.train.probe_sweep import probe_settings
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import is_stored, load_results, read_probes, settings_of

if TYPE_CHECKING:
    from probe_kit.runs import Run
    from probe_kit.runs.store import Location


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
    Raises RunIncompleteError for a run that is missing, unfinished or damaged, unless `partial`, and
    SettingsMismatchError for a run that is not its cell's, and RunDamagedError for a damaged ledger.
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
        noted_run(study, cell)  # a damaged record is no missing run, and has an advice of its own
        try:
            own = open_cell(study, cell, selection, partial, categories)
            found.append(own)
            if done := _part_done(own.run):
                unfinished.append(f"{label} has {done} episodes")
        except SettingsMismatchError:
            raise
        except ProbeKitError as error:
            if not partial:
                raise RunIncompleteError(
                    f"{cell.name} is not whole: {_seen(error)}. Finish it with `probe-kit study run {study.file}`,"
                    " or accept what is there (--partial)"
                ) from error
            unfinished.append(f"{label} is missing: {_why_missing(study, cell, error)}")
    check_same_items([one.run for one in found])
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


def noted_run(study: LoadedStudy, cell: Cell, entry: Entry | None = None) -> tuple["Location", str | None]:
    """The location of a cell's run, and the hash of its settings and weights, by ledger or archive.

    The hash is None without a record. entry: the cell's record in the ledger, read where None.
    Raises RunDamagedError for a record that was changed.
    """
    home = locate(cell.location(study.study.folder))
    if study.pack is not None:
        packed = study.pack.runs.get(cell.name)
        return home, None if packed is None else packed.settings_sha256
    played = (Ledger(study.study.folder).of(cell) if entry is None else entry).played
    if played is None:
        return home, None
    return locate(played.served_by) if played.served_by else home, played.settings_sha256


def open_matching(study: LoadedStudy, cell: Cell, partial: bool, entry: Entry | None = None) -> "Run":
    """The run of a cell, found to be of its settings, weights and suite.

    entry: as of `noted_run`. Raises what `open_run` raises, and SettingsMismatchError for the run of another cell.
    """
    location, settings_sha256 = noted_run(study, cell, entry)
    run = open_run(location, allow_partial=partial)
    check_run_of_cell(run, cell, study.cells, settings_sha256, study.file)
    return run


def open_stored(study: LoadedStudy, cell: Cell, partial: bool = False) -> "Run":
    """The run of a cell, as `open_matching` gives it, found to hold all items of its blocks.

    partial: accept missing episodes. Raises what `open_matching` raises, and RunIncompleteError for a run of fewer
    items.
    """
    run = open_matching(study, cell, partial)
    planned = run.items["category"].value_counts().to_dict()
    expected = cell.selection.counts(cell.suite)
    fewer = [name for name, count in expected.items() if planned.get(name, 0) < count]
    if fewer and not partial:
        name = fewer[0]
        raise RunIncompleteError(f"{run.location} has {planned.get(name, 0)} of {expected[name]} items of {name}")
    return run


def open_cell(
    study: LoadedStudy,
    cell: Cell,
    selection: Selection,
    partial: bool = False,
    categories: Sequence[str] | None = None,
) -> StoredRun:
    """The stored run of a cell, restricted to a selection. Raises what `open_stored` raises."""
    run = open_stored(study, cell, partial)
    of_probes = (of_blocks(table.runs)(cell) for table in study.study.probes.values())
    fitted = next((one for one in of_probes if one is not None), None)
    shown = _part(run, cell, selection, categories)
    return StoredRun(cell, shown, shown if fitted is None else _part(run, cell, fitted, None))


def probe_keys(study: LoadedStudy, runs: Sequence[tuple[StoredRun, "Run"]], partial: bool) -> list[str]:
    """Of each run the key of the probes that the file's tables fit to it; empty for none.

    runs: what is stored of a cell, and the part of it that is shown. Probes that were fitted otherwise, by hand or
    for a former state of the file, give no number.
    Raises RunIncompleteError for a run without the probes of the file, unless `partial`.
    """
    return [_probe_key(study, stored, run, partial) for stored, run in runs]


def study_probes(study: LoadedStudy, stored: StoredRun, run: "Run", partial: bool) -> ProbeResults | None:
    """The probes of the file that are stored of a run, None without any. Raises as `probe_keys`."""
    key = _probe_key(study, stored, run, partial)
    return load_results(run, key) if key else None


def _probe_key(study: LoadedStudy, stored: StoredRun, run: "Run", partial: bool) -> str:
    tables = [
        (name, table)
        for name, table in study.study.probes.items()
        if table.target == "correct" and of_blocks(table.runs)(stored.cell) is not None
    ]
    if not tables or not run.streams:
        return ""
    if stored_keys := _stored_keys(tables, run):
        return stored_keys[-1]
    if partial or _stored_keys(tables, stored.probed.in_wording()):  # then other items are shown than were fitted
        return ""
    others = [key for key, bundle in read_probes(run.location).items() if settings_of(bundle).is_side]
    also = f" It has those of other settings: {', '.join(others)}." if others else ""
    names = ", ".join(f"[probes.{name}]" for name, _ in tables)
    raise RunIncompleteError(
        f"{stored.cell.name} has no probes of {names}.{also} Fit them with `probe-kit study run {study.file}`, or "
        "accept what is there (--partial)"
    )


def _stored_keys(tables: Sequence[tuple[str, ProbesTable]], run: "Run") -> list[str]:
    """The keys of those probes of the tables that are stored of a run."""
    return [key for _, table in tables if is_stored(run.location, key := _key_of(table, run))]


def _key_of(table: ProbesTable, run: "Run") -> str:
    """The key of the probes that a table of the file fits to a run."""
    return probe_settings(
        run, views=table.views, permutations=table.permutations, target=table.target, seed=table.seed
    ).key


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
