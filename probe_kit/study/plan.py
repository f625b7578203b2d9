"""The plan of a study: the stored part of each cell and its probes, the reasons for the rest, and its cost.

Everything is read from the runs themselves, and from the failures that are stored with them.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from probe_kit._system.counting import plural
from probe_kit.errors import ProbeKitError, RunIncompleteError, RunNotFoundError, UsageError
from probe_kit.extract.sizes import planned_sizes, space_of
from probe_kit.extract.states import count_calls
from probe_kit.hooks.registry import family_names
from probe_kit.runs import verify_run
from probe_kit.runs.layout import RUN_FILE, StoredStream
from probe_kit.runs.root import read_root
from probe_kit.runs.run_folders import in_units
from probe_kit.runs.store import locate
from probe_kit.study.cells import NOT_TRIED_AGAIN, Failures, ItemSelection, PlannedRun, StudyFailure
from probe_kit.study.expansion import control_of
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable, complaint_of_unknown
from probe_kit.study.stored import open_matching, part_of, probe_key_of
from probe_kit.study.study_folder import changed_settings
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.store import read_controls, read_probes, settings_of

if TYPE_CHECKING:
    from probe_kit.runs import Run


_FITTED = ("views", "permutations", "seed")
"""The fields of a table that decide its probes; the plan names those that changed as the reason to fit again."""


def probes_of(study: LoadedStudy, cell: PlannedRun) -> Iterator[tuple[str, ProbesTable, ItemSelection]]:
    """Yield the tables of probes that a cell belongs to, by name, each with the part of the run that is probed."""
    for name, table in study.study.probes.items():
        selection = cell.selected(table.runs)
        if not cell.unavailable and selection is not None:
            yield name, table, selection


def planned_probes(study: LoadedStudy, cell: PlannedRun, run: "Run") -> dict[str, str]:
    """Return by table why the probes of a whole run are to be fitted; empty for those that are stored."""
    failures, reasons = Failures(study.study.folder), dict[str, str]()
    for name, table, selection in probes_of(study, cell):
        why = _why_missing(study, table, cell, run, selection)
        failure = failures.of(cell, name) if why else None
        reasons[name] = why if failure is None else failure.reason
    return reasons


def _why_missing(
    study: LoadedStudy, table: ProbesTable, cell: PlannedRun, run: "Run", selection: ItemSelection
) -> str:
    """Return why the probes of a table are to be fitted, empty if they and all of their controls are stored."""
    if not run.streams:
        return "the run has no activations"
    stored = read_probes(run.location)
    try:
        bundle = stored.get(probe_key_of(table, part_of(run, cell, selection).in_wording()))
    except ProbeKitError:  # such as too few groups, which fitting says at length
        return "not fitted"
    if bundle is not None:
        controls, names = read_controls(bundle), [name for name in table.controls if name != "untrained"]
        if absent := [name for name in names if name not in controls.names]:
            return f"without the control {', '.join(absent)}"
        network = untrained_cell(study, table, cell)
        return "" if network is None else _why_other_network(study, table, network, selection, controls)
    of_target = [bundle for bundle in stored.values() if settings_of(bundle).target == table.target]
    if not of_target:
        return "not fitted"
    former = asdict(settings_of(max(of_target, key=lambda bundle: bundle.times.get("requested", ""))))
    changes = [
        f"{name} {_text(former[name])} → {_text(value)}"
        for name, value in table.model_dump(include=set(_FITTED)).items()
        if _text(former[name]) != _text(value)
    ]
    return "; ".join(changes) or "of other episodes"


def _why_other_network(
    study: LoadedStudy, table: ProbesTable, network: PlannedRun, selection: ItemSelection, controls: Controls
) -> str:
    """Return why probes are to be compared with their untrained network again, empty if they are."""
    if not controls.untrained_probes:
        return "without the control untrained"
    try:
        run = part_of(open_matching(study, network, partial=True), network, selection).in_wording()
        key = probe_key_of(table, run)
    except ProbeKitError:
        return "not compared with its untrained network"
    return "" if controls.untrained_probes == key else "compared with another untrained network"


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def untrained_cell(study: LoadedStudy, table: ProbesTable, cell: PlannedRun) -> PlannedRun | None:
    """Return the run of the untrained network that probes are compared with, None without such a control."""
    return control_of(study.study, study.cells, cell) if "untrained" in table.controls else None


# -- the plan ----------------------------------------------------------------------------------------------------


State = Literal["new", "partial", "whole", "damaged", "failed", "waiting", "skipped"]
_MOST_CHANGES = 3
"""Largest number of changed settings of a stored run that a line of the plan names."""


@dataclass(frozen=True)
class PlannedCell:
    """A cell, and the state of its run at its location.

    Attributes:
        stored: Episodes of its selection that are stored.
        why: The state in words.
        failure: Failure of the last time it was played.
        waits_for: Failure of another run of its model.
        probes: By table of the file, the reason why they are to be fitted; empty for stored ones.
        sealed: Whether nothing is left to do after its last episode.
        seconds: Mean duration of a stored episode.
        streams: Streams of the stored run.
    """

    cell: PlannedRun
    location: str
    state: State
    stored: int
    why: str
    failure: StudyFailure | None = None
    waits_for: StudyFailure | None = None
    probes: Mapping[str, str] = field(default_factory=dict)
    sealed: bool = True
    seconds: float | None = None
    streams: tuple[StoredStream, ...] | None = None

    @property
    def missing(self) -> int:
        """Episodes that are to be played or asked."""
        return 0 if self.state == "skipped" else self.cell.episodes - self.stored

    @property
    def unprobed(self) -> dict[str, str]:
        """Probes that are to be fitted, each with the reason."""
        return {name: why for name, why in self.probes.items() if why}

    @property
    def words(self) -> str:
        """The state of the run, and of its probes."""
        if not self.probes or self.state != "whole":
            return self.why
        of_probes = [f"probes {name}: {why}" for name, why in self.unprobed.items()] or ["probed"]
        return "; ".join([self.why, *of_probes])

    @property
    def given_up(self) -> bool:
        """Whether the run is tried again only on request."""
        return any(failure and failure.stage in NOT_TRIED_AGAIN for failure in (self.failure, self.waits_for))

    @property
    def run_text(self) -> str:
        """The condition or ask, with the seed where there are several."""
        return self.cell.way + (f", seed {self.cell.seed}" if self.cell.seed else "")


@dataclass(frozen=True)
class StudyPlan:
    """The cells of a study in the order in which models are loaded."""

    study: LoadedStudy
    cells: tuple[PlannedCell, ...]

    @property
    def played(self) -> list[PlannedCell]:
        """All cells except the skipped ones."""
        return [planned for planned in self.cells if planned.state != "skipped"]

    @property
    def complete(self) -> bool:
        """Whether no episode and no probes are missing."""
        return not any(planned.missing or planned.unprobed for planned in self.played)

    def skipped(self) -> dict[str, str]:
        """Return by model the reason why it is not played."""
        return {name: model.unavailable for name, model in self.study.study.models.items() if model.unavailable}

    def totals(self) -> dict[str, int]:
        """Count runs, episodes by the model's task, inferences of policies, and missing episodes and probes."""
        cells = [planned.cell for planned in self.played]
        n_asked = sum(cell.episodes for cell in cells if cell.asks)
        captured = sum(cell.episodes for cell in cells if cell.captured)
        return {
            "runs": len(cells),
            "episodes": sum(cell.episodes for cell in cells),
            "acted": sum(cell.episodes for cell in cells) - n_asked - captured,
            "captured": captured,
            "asked": n_asked,
            "inferences": sum(cell.inferences for cell in cells),
            "missing": sum(planned.missing for planned in self.played),
            "unprobed": sum(len(planned.unprobed) for planned in self.played),
        }

    @cached_property
    def seconds(self) -> dict[str, float]:
        """The seconds of missing episodes by run, where the model has stored episodes of the same kind of work.

        Conditions of one kind of work share a rate per inference, because episodes of one may have more of them.
        """
        spent, counts = defaultdict[str, float](float), defaultdict[str, float](float)
        for planned in self.played:
            if planned.seconds is not None:
                spent[planned.cell.work] += planned.seconds * planned.stored
                counts[planned.cell.work] += planned.cell.units * planned.stored
        return {
            planned.cell.name: spent[work] / counts[work] * planned.missing * planned.cell.units
            for planned in self.played
            if planned.missing and counts[work := planned.cell.work]
        }

    def hours(self) -> dict[str, float | None]:
        """Return the hours of missing episodes by model; None for a model whose rate is not known."""
        return _by_model(
            (
                planned.cell.model,
                None if (seconds := self.seconds.get(planned.cell.name)) is None else seconds / 3600,
            )
            for planned in self.played
            if planned.missing
        )

    def bytes(self) -> dict[str, float | None]:
        """Return the bytes of missing episodes by model, uncompressed, with columns and probes.

        They are counted by stored streams of the model, else as its configuration or its family declares them.
        None where no stream is known before the model is loaded.
        """
        stored = {planned.cell.work: planned.streams for planned in self.played if planned.streams is not None}
        missing = [planned for planned in self.played if planned.missing]
        sizes = [(planned, bytes_per_episode(planned.cell, stored.get(planned.cell.work))) for planned in missing]
        return _by_model(
            (planned.cell.model, None if size is None else size * planned.missing) for planned, size in sizes
        )

    def lines(self) -> list[str]:
        """Return totals, hours and bytes with their source, and skipped models, in words."""
        totals, suite = self.totals(), self.study.suite
        unprobed = f"; probes of {plural(totals['unprobed'], 'run')}" if totals["unprobed"] else ""
        lines = [
            f"suite: {suite.identity}; items from {suite.source}",
            f"{plural(totals['runs'], 'run')}, {plural(totals['episodes'], 'episode')} ({totals['acted']:,} "
            f"acted, {totals['captured']:,} captured without acting, {totals['asked']:,} asked), at most "
            f"{plural(totals['inferences'], 'inference')} of policies (given by shape: no model was loaded)",
            f"missing: {plural(totals['missing'], 'episode')}{unprobed}",
        ]
        hours, unmeasured = _known_sums(self.hours())
        if hours:
            each = ", ".join(f"{model} {value:.2g}" for model, value in hours.items())
            lines.append(f"hours, measured in stored episodes: {sum(hours.values()):.2g} ({each})")
        if unmeasured:
            lines.append(f"hours unknown before a first episode is stored: {', '.join(unmeasured)}")
        sizes, unsized = _known_sums(self.bytes())
        if sizes:
            lines.append(f"bytes: up to {in_units(round(sum(sizes.values())))} before compression")
        if unsized:
            lines.append(f"bytes unknown before the model is loaded: {', '.join(unsized)}")
        return [*lines, *(f"skipped: {model}: {reason}" for model, reason in self.skipped().items())]

    def to_json(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return {
            "study": self.study.study.name,
            "suite": self.study.suite.identity,
            "totals": self.totals(),
            "skipped": self.skipped(),
            "hours": self.hours(),
            "bytes": self.bytes(),
            "runs": [
                {
                    "model": planned.cell.model,
                    "way": planned.cell.way,
                    "seed": planned.cell.seed,
                    "blocks": list(planned.cell.selections),
                    "key": planned.cell.key,
                    "location": planned.location,
                    "state": planned.state,
                    "why": planned.why,
                    "episodes": planned.cell.episodes,
                    "done": planned.stored,
                    "inferences": planned.cell.inferences,
                    "failure": None if planned.failure is None else planned.failure.content,
                    "probes": {name: why or "stored" for name, why in planned.probes.items()},
                }
                for planned in self.cells
            ],
        }


def plan_study(study: LoadedStudy, only: str | None = None) -> StudyPlan:
    """Compare a study with what is stored. Loads no model and writes nothing.

    Args:
        study: The study file, expanded.
        only: A block or a model, whose runs alone are planned; all by default.

    Raises:
        UsageError: For another name.
        RunDamagedError: For the record of a failure that was changed.
    """
    names = [*study.study.models, *(block.name for block in study.study.runs)]
    if only is not None and only not in names:
        raise UsageError(f"--only: {complaint_of_unknown('block or model', only, names)}")
    cells = [cell for cell in study.cells if only is None or only == cell.model or only in cell.selections]
    order = {name: position for position, name in enumerate(study.study.models)}
    planned = [_plan_cell(study, cell) for cell in sorted(cells, key=lambda cell: order[cell.model])]
    return StudyPlan(study, tuple(_waiting(planned)))


def _plan_cell(study: LoadedStudy, cell: PlannedRun) -> PlannedCell:
    location = str(locate(cell.location(study.study.folder)))
    if cell.unavailable:
        return PlannedCell(cell, location, "skipped", 0, f"skipped: {cell.unavailable}")
    try:
        run = open_matching(study, cell, partial=True)
    except (RunNotFoundError, RunIncompleteError):  # the second one was killed before it had a plan
        return _failed_cell(study, PlannedCell(cell, location, "new", 0, _why_new(study, cell)))
    except ProbeKitError as error:
        return PlannedCell(cell, location, "damaged", 0, f"damaged: {error}")
    stored, streams = _stored_episodes(cell, run), tuple(run.root.streams.values())
    if stored < cell.episodes:
        why = f"{stored} of {cell.episodes} episodes"
        partial = PlannedCell(cell, location, "partial", stored, why, seconds=_mean_seconds(run), streams=streams)
        return _failed_cell(study, partial)
    return PlannedCell(
        cell,
        location,
        "whole",
        cell.episodes,
        "whole",
        # An archive has the probes of its runs, and nothing is fitted to it.
        probes={} if study.archive is not None else planned_probes(study, cell, run),
        sealed=run.sealed or not run.streams or study.archive is not None,
        seconds=_mean_seconds(run),
        streams=streams,
    )


def _why_new(study: LoadedStudy, cell: PlannedRun) -> str:
    """Return the changes since the newest run of the same model, condition and seed on this machine, if any."""
    out = study.study.folder
    if study.home is not None and (hint := study.home.hint(cell)):
        return f"new: {hint}"
    keys = () if study.home is None or "://" in out else study.home.keys_of_name(cell)
    files = (Path(out) / cell.folder_of(key) / RUN_FILE for key in keys if key != cell.key)
    former = max(files, key=lambda file: file.stat().st_mtime_ns, default=None)
    if former is None:
        return "new"
    try:
        settings = read_root(locate(former.parent)).own_settings
    except ProbeKitError:
        return "new"
    changes = [
        f"{name.rpartition('.')[2]} {_short(before)} → {_short(after)}"
        for name, before, after in changed_settings(settings, cell)
    ]
    if not changes:  # a run does not store these by value
        return f"new: another checkpoint, or other options, than {former.parent.name}"
    more = f" and {len(changes) - _MOST_CHANGES} more" if len(changes) > _MOST_CHANGES else ""
    return f"new: {', '.join(changes[:_MOST_CHANGES])}{more}"


def _short(value: Any) -> str:
    text = "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}…"


def _failed_cell(study: LoadedStudy, planned: PlannedCell) -> PlannedCell:
    failure = None if study.archive is not None else Failures(study.study.folder).of(planned.cell)
    if failure is None:
        return planned
    why = f"failed ({failure.when}): {failure.reason}"
    why = f"{planned.why}; {why}" if planned.stored else why
    return replace(planned, state="failed", failure=failure, why=why)


def _waiting(cells: list[PlannedCell]) -> Iterator[PlannedCell]:
    """Yield the cells; those wait whose model failed at another run."""
    failed = {
        planned.cell.model: planned.failure
        for planned in cells
        if planned.failure and planned.failure.stage != "episodes"  # which end one run, and not its model
    }
    for planned in cells:
        failure = failed.get(planned.cell.model)
        if failure is None or planned.failure is not None or planned.state in ("whole", "skipped", "damaged"):
            yield planned
        else:
            why = f"{planned.why}; waits, because {failure.run} failed"
            yield replace(planned, state="waiting", waits_for=failure, why=why)


def _stored_episodes(cell: PlannedRun, run: "Run") -> int:
    """Count the episodes of the cell's selection that a run holds, which may hold others as well."""
    selected: set[str] = set()
    for category, count in cell.selection.counts(cell.suite).items():
        items = run.items.loc[run.items["category"] == category, "item_id"]
        selected |= set(items.iloc[:count])
    return int(run.episodes["item_id"].isin(selected).sum())


def _mean_seconds(run: "Run") -> float | None:
    episodes = run.episodes
    if episodes.empty or not {"seconds_inference", "seconds_simulation"} <= set(episodes):
        return None
    total = (episodes["seconds_inference"] + episodes["seconds_simulation"]).dropna()
    return None if total.empty else float(total.mean())


def _by_model(amounts: Iterable[tuple[str, float | None]]) -> dict[str, float | None]:
    """Return the sum of each model, None where an amount is not known."""
    sums: dict[str, float | None] = {}
    for model, amount in amounts:
        before = sums.get(model, 0)
        sums[model] = None if amount is None or before is None else before + amount
    return sums


def _known_sums(sums: Mapping[str, float | None]) -> tuple[dict[str, float], list[str]]:
    return {model: value for model, value in sums.items() if value is not None}, [
        model for model, value in sums.items() if value is None
    ]


def bytes_per_episode(cell: PlannedRun, stored: Sequence[StoredStream] | None) -> int | None:
    """Return the bytes of an episode with the most inferences, if every one is captured.

    Args:
        cell: The cell of the run.
        stored: Streams of a stored run; None for those that the family declares.
    """
    settings = cell.settings
    if stored is None and settings.model.family in family_names():
        sizes = planned_sizes(settings)
        if sizes is None:
            return None
        stored = sizes.streams
    fitted = count_calls(settings, settings.task.execute or 1)  # before the model says how many it executes
    space = space_of(stored or (), 1, fitted)  # a script has no network, and no stream
    return sum(space.values()) - space["report"]


# -- checks of what is stored ------------------------------------------------------------------------------------


def changed_runs(plan: StudyPlan) -> dict[str, tuple[str, ...]]:
    """Compare every byte of stored runs with its hash; return by run the problems found."""
    audits = {
        planned.cell.name: verify_run(planned.location, deep=True)
        for planned in plan.played
        if locate(planned.location).exists(RUN_FILE)
    }
    return {name: audit.problems for name, audit in audits.items() if not audit.ok}


def orphaned_runs(plan: StudyPlan) -> list[str]:
    """Return folders of runs below the study's folder that are no run of the file, such as of former settings.

    Another study with the same folder may use them. Only folders of this machine are searched; none are found at a
    URL.
    """
    out = plan.study.study.folder
    used = {Path(cell.location(out)) for cell in plan.study.cells}
    files = () if "://" in out else Path(out).glob(f"*/*/{RUN_FILE}")
    return sorted(str(file.parent) for file in files if file.parent not in used)
