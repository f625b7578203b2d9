"""The stored runs of a study, restricted to the selection of its blocks, and the reasons why others are missing.

A folder's name says which run should lie in it. No number is taken before the content says the same: settings,
weights, wordings and suite.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._terminal.console import say
from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError, SettingsMismatchError, UsageError
from probe_kit.extract.parts import is_here
from probe_kit.hooks.checkpoints.checkpoint import COMMIT_DIGITS, is_on_hub, without_revision
from probe_kit.runs import open_run
from probe_kit.runs.store import locate
from probe_kit.study.cells import Failures, ItemSelection, PlannedRun
from probe_kit.study.file_contents import content_of
from probe_kit.study.reading import LoadedStudy, load_study, shipped_studies
from probe_kit.study.schema import ProbesTable
from probe_kit.study.study_folder import Change, PlayedModel, changed_settings
from probe_kit.train.probe_sweep import probe_settings
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import is_stored, load_results, read_probes, settings_of

if TYPE_CHECKING:
    from probe_kit.runs import Run


_MOST_PRINTED = 3


def differences(run: "Run", cell: PlannedRun, played: PlayedModel | None = None) -> Iterator[str]:
    """Yield the settings in which a run is not one of `cell`, in words, stored value first.

    Args:
        run: The stored run.
        cell: The cell that it may belong to.
        played: The cell's model as it was played; None if that is not known.
    """
    changes = chain(
        changed_settings(run.root.own_settings, cell),
        [("wordings", list(run.wordings), list(cell.settings.wordings or ()))],
        _weights(run, cell, played),
    )
    for name, stored, expected in changes:
        if stored != expected:
            yield f"{name}: stored {_short(stored)}, expected {_short(expected)}"
    contents = cell.suite.contents
    if not contents:  # they are not known, and the run's items are not read
        return
    hashes = dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True))
    if changed := [name for name, content in hashes.items() if contents.get(name) != content]:
        state = "changed" if changed[0] in contents else "is not in the suite"
        yield f"item {changed[0]!r} {state} since it was played ({len(changed)} of {len(hashes)} items)"


def _weights(run: "Run", cell: PlannedRun, played: PlayedModel | None) -> Iterator[Change]:
    """Yield what the process that loaded the model recorded of it, and what the cell's model is.

    A card has the commit of a hub id. A file may name a branch or nothing: then repository and folder count. Of a
    local checkpoint the content counts, wherever its files lie: by the weights that were loaded from it. A run of
    an earlier version left no record of them: it is compared if the files still lie where it had loaded them.
    """
    if not run.commits():
        return
    card: Mapping[str, Any] = run.certificate.get("policy") or {}
    if cell.settings.model.random_weights and "weights_seed" in card:
        yield "weights_seed", card["weights_seed"], cell.settings.model.weights_seed
    stored, expected = str(card.get("checkpoint")), str(cell.settings.model.checkpoint)
    if is_on_hub(stored) and is_on_hub(expected):
        has_commit = len(expected.partition("@")[2]) == COMMIT_DIGITS
        names = [name if has_commit else without_revision(name) for name in (stored, expected)]
        yield "checkpoint", names[0], names[1]
    if played is not None:
        policy: Mapping[str, Any] = run.root.own_settings.get("policy") or {}
        yield "weights_sha256", run.weights_sha256, played.weights_sha256
        # Another version may name more of what a model reads.
        common = sorted(policy.keys() & played.policy.keys())
        yield from ((f"policy.{name}", policy[name], played.policy[name]) for name in common)
    elif is_here(stored) and is_here(expected) and content_of(stored) != content_of(expected):
        yield "checkpoint", stored, expected


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def check_same_items(runs: Sequence["Run"]) -> None:
    """Raise SettingsMismatchError for two runs that hold different items under one id, naming both runs."""
    contents = [dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True)) for run in runs]
    for (run, items), (other, other_items) in combinations(zip(runs, contents, strict=True), 2):
        changed = [name for name in items if name in other_items and items[name] != other_items[name]]
        if changed and run.suite.partition("#")[0] == other.suite.partition("#")[0]:
            raise SettingsMismatchError(
                f"{run.location} and {other.location} hold different items as {changed[0]!r} "
                f"({len(changed)} in all): their suites have one name and version and other content. Play both "
                "with one suite, or give the changed suite another version"
            )


def check_same_weights(runs: Sequence[tuple[PlannedRun, "Run"]]) -> None:
    """Raise SettingsMismatchError for two runs of one model that were played with different weights.

    A model that acts and answers may load other parts of its checkpoint for either.
    """
    first: dict[tuple[str, bool], Run] = {}
    for cell, run in runs:
        other = first.setdefault((cell.model, cell.asks), run)
        if other.weights_sha256 != run.weights_sha256:
            raise SettingsMismatchError(
                f"{other.location} and {run.location} are runs of {cell.model!r} with different weights "
                f"({str(other.weights_sha256)[:12]} and {str(run.weights_sha256)[:12]}). The checkpoint was "
                "changed in between, or a folder was moved: remove one of them, and run the study again"
            )


@dataclass(frozen=True)
class StoredRun:
    """A run of the study, and its cell.

    Attributes:
        run: The run with the items that a table prints.
        probed: The run with the items that the file's probes are fitted to.
    """

    cell: PlannedRun
    run: "Run"
    probed: "Run"

    @property
    def location(self) -> str:
        """The run's location, by which tables name runs."""
        return str(self.run.location)


@dataclass(frozen=True)
class StoredRuns:
    """The runs that a table is made of, in the order of the file.

    Attributes:
        missing: Reasons why the other runs are not in the table.
        unfinished: Episodes that `study run` would still play of both, in words; only of partial tables.
        labels: By location the model's label, with condition or ask and seed where a model has several runs,
            stored or not.
    """

    runs: tuple[StoredRun, ...]
    missing: tuple[str, ...]
    unfinished: tuple[str, ...]
    labels: Mapping[str, str]


def stored_runs(
    study: LoadedStudy,
    select: Callable[[PlannedRun], ItemSelection | None],
    subject: str,
    partial: bool = False,
    categories: Sequence[str] | None = None,
) -> StoredRuns:
    """Open the stored runs of a study.

    Args:
        study: The study whose runs are stored.
        select: Returns the selection of a cell that is printed; None leaves the cell out.
        subject: The table or figure that is made of them, for messages.
        partial: Accept runs that are missing or unfinished; they are named.
        categories: Slugs, all by default.

    Raises:
        RunIncompleteError: For a run that is missing, unfinished or damaged, unless `partial`.
        UsageError: For no stored run.
        SettingsMismatchError: For a run of another cell.
    """
    runs, missing, unfinished, models = list[StoredRun](), list[str](), list[str](), list[str]()
    for cell in study.cells:
        selection = select(cell)
        if selection is None:
            continue
        models.append(cell.model)
        label = _label(study, cell, True)
        if cell.unavailable:
            missing.append(f"{label} is missing: {cell.unavailable}")
            continue
        try:
            stored = open_cell(study, cell, selection, partial, categories)
        except SettingsMismatchError:
            raise
        except ProbeKitError as error:
            if not partial:
                raise RunIncompleteError(
                    f"{cell.name} is not whole: {_first_sentence(error)}. Finish it with `probe-kit study run "
                    f"{study.typed}`, or accept what is there (--partial)"
                ) from error
            unfinished.append(f"{label} is missing: {_why_missing(study, cell, error)}")
        else:
            runs.append(stored)
            if len(stored.run.episodes) < stored.run.planned:
                unfinished.append(f"{label} has {len(stored.run.episodes)} of {stored.run.planned} episodes")
    if not runs:
        raise UsageError(f"no run of {subject} is stored. Play it with `probe-kit study run {study.typed}`")
    check_same_items([stored.run for stored in runs])
    check_same_weights([(stored.cell, stored.run) for stored in runs])
    labels = {run.location: _label(study, run.cell, models.count(run.cell.model) > 1) for run in runs}
    return StoredRuns(tuple(runs), tuple(missing), tuple(unfinished), labels)


def _why_missing(study: LoadedStudy, cell: PlannedRun, error: ProbeKitError) -> str:
    failure = None if study.archive is not None else Failures(study.study.folder).of(cell)
    if failure is not None:
        return failure.reason
    return "not played yet" if isinstance(error, RunNotFoundError) else _first_sentence(error)


def _first_sentence(error: ProbeKitError) -> str:
    """Return the finding of an error, without its advice on a single run."""
    return str(error).partition(". ")[0].removesuffix(".")


def open_matching(study: LoadedStudy, cell: PlannedRun, partial: bool) -> "Run":
    """Open the run of a cell, checked to be of its settings, weights and suite; raises as `open_run` too.

    Args:
        study: The study of the cell.
        cell: The cell whose run is opened.
        partial: Accept missing episodes.

    Raises:
        SettingsMismatchError: For the run of another cell, which it names.
    """

    def find_model(any_cell: PlannedRun) -> PlayedModel | None:
        return None if study.home is None else study.home.played_model(any_cell)

    if study.home is not None:
        study.home.check_unambiguous(cell)
    try:
        run = open_run(locate(cell.location(study.study.folder)), allow_partial=partial)
    except RunNotFoundError as error:
        if study.home is not None and (hint := study.home.hint(cell)):
            raise RunNotFoundError(
                f"{hint}. Give the file a path that is here, or that of a stored run"
            ) from error
        raise
    problems = list(differences(run, cell, find_model(cell)))
    packed = None if study.pack is None else study.pack.runs.get(cell.name)
    if not problems and packed is not None and packed.settings_sha256 != run.settings_sha256:
        hashes = f"{run.settings_sha256[:12]}, noted {packed.settings_sha256[:12]}"
        problems = [f"settings and weights hash {hashes}"]
    if not problems:
        return run
    cells = (other for other in study.cells if other.name != cell.name)
    owners = (other.name for other in cells if not any(differences(run, other, find_model(other))))
    owner = next((f" It is a run of {name}." for name in owners), "")
    more = f" and {len(problems) - _MOST_PRINTED} more" if len(problems) > _MOST_PRINTED else ""
    raise SettingsMismatchError(
        f"{run.location} should hold the run of {cell.name}, and holds another one: "
        f"{'; '.join(problems[:_MOST_PRINTED])}{more}.{owner} Move each folder back to its own name, or remove "
        f"this one and run `probe-kit study run {study.typed}`"
    )


def open_stored(study: LoadedStudy, cell: PlannedRun, partial: bool = False) -> "Run":
    """Open the run of a cell as `open_matching` does, checked to hold all items of its blocks.

    Raises as `open_matching` too.

    Args:
        study: The study of the cell.
        cell: The cell whose run is opened.
        partial: Accept missing episodes.

    Raises:
        RunIncompleteError: For a run of fewer items.
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
    cell: PlannedRun,
    selection: ItemSelection,
    partial: bool = False,
    categories: Sequence[str] | None = None,
) -> StoredRun:
    """Open the stored run of a cell, restricted to a selection; raises as `open_stored`."""
    run = open_stored(study, cell, partial)
    of_probes = (cell.selected(table.runs) for table in study.study.shown_probes.values())
    fitted = next((of_table for of_table in of_probes if of_table is not None), None)
    part = part_of(run, cell, selection, categories)
    return StoredRun(cell, part, part if fitted is None else part_of(run, cell, fitted))


def part_of(
    run: "Run", cell: PlannedRun, selection: ItemSelection, categories: Sequence[str] | None = None
) -> "Run":
    """Return the selected part of a run, which may hold more: of other blocks or a former state of the file."""
    counts = selection.counts(cell.suite)
    counts = {name: count for name, count in counts.items() if categories is None or name in categories}
    if counts == run.items["category"].value_counts().to_dict():
        return run
    return run.only(list(counts), selection.items)


# -- probes ------------------------------------------------------------------------------------------------------


def probe_key(study: LoadedStudy, stored: StoredRun, run: "Run", partial: bool) -> str:
    """Return the key of the probes that the file's tables fit to a run; empty for none.

    Probes that were fitted otherwise, by hand or for a former state of the file, give no number.

    Args:
        study: The study of the run.
        stored: The run and its cell.
        run: The part of the stored run that is printed.
        partial: Accept a run without the probes of the file.

    Raises:
        RunIncompleteError: For a run without the probes of the file, unless `partial`.
    """
    tables = {
        name: table
        for name, table in study.study.shown_probes.items()
        if stored.cell.selected(table.runs) is not None
    }
    if not tables or not run.streams:
        return ""

    def keys(of_run: "Run") -> list[str]:
        candidates = (probe_key_of(table, of_run) for table in tables.values())
        return [key for key in candidates if is_stored(of_run.location, key)]

    if stored_keys := keys(run):
        return stored_keys[-1]  # of several, which share the run through two blocks, the last of the file
    if partial or keys(stored.probed.in_wording()):  # they are fitted to other items
        return ""
    other_keys = [key for key, bundle in read_probes(run.location).items() if settings_of(bundle).balanced]
    also = f" It has those of other settings: {', '.join(other_keys)}." if other_keys else ""
    names = ", ".join(f"[probes.{name}]" for name in tables)
    raise RunIncompleteError(
        f"{stored.cell.name} has no probes of {names}.{also} Fit them with `probe-kit study run {study.typed}`, "
        "or accept what is there (--partial)"
    )


def study_probes(study: LoadedStudy, stored: StoredRun, run: "Run", partial: bool) -> ProbeResults | None:
    """Return the probes of the file that are stored of a run, None without any; raises as `probe_key`."""
    key = probe_key(study, stored, run, partial)
    return load_results(run, key) if key else None


def probe_key_of(table: ProbesTable, run: "Run") -> str:
    """Return the key of the probes that a table of the file fits to a run."""
    return probe_settings(
        run, views=table.views, permutations=table.permutations, target=table.target, seed=table.seed
    ).key


# -- names -------------------------------------------------------------------------------------------------------


def _label(study: LoadedStudy, cell: PlannedRun, several: bool) -> str:
    label = study.study.models[cell.model].label or cell.model
    seed = f", seed {cell.seed}" if cell.seed else ""
    return f"{label} · {cell.way}{seed}" if several or seed else label


def stored_runs_by_name(name: str) -> "list[Run] | None":
    """Return the stored runs of a study file, or of a study of the package; None for a name of neither.

    Runs that are missing are named on the terminal.

    Raises:
        UsageError: If none is stored, and as `load_study` does.
    """
    if not (name.endswith(".toml") or (name in shipped_studies() and not Path(name).exists())):
        return None
    study = load_study(name)
    stored = stored_runs(study, lambda cell: cell.selection, str(study.file), partial=True)
    for remark in (*stored.missing, *stored.unfinished):
        say(remark)
    return [run.probed for run in stored.runs]
