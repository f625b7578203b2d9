"""The probes that a study file names, and whether they are stored with their run."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from math import isclose
from typing import TYPE_CHECKING, Literal

from probe_kit.errors import ProbeKitError
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.expansion import control_of
from probe_kit.study.failures import Failures
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.stored import open_matching, part_of, probe_key_of
from probe_kit.train.results.control_scores import Controls, UntrainedScore
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.store import load_results, read_controls, read_probes, settings_of

if TYPE_CHECKING:
    from probe_kit.runs import Run

_FITTED = ("views", "permutations", "seed")
"""The fields of a table that decide its probes, by which the plan says why they are fitted again."""


@dataclass(frozen=True)
class PlannedProbes:
    """Probes of one run. name: of their table in the file. why: in words, unless they are stored."""

    name: str
    state: Literal["stored", "missing", "failed"]
    why: str = ""


def probes_of(study: LoadedStudy, cell: Cell) -> Iterator[tuple[str, ProbesTable, Selection]]:
    """Yield the tables of probes that a cell belongs to, by name, each with what of the run is probed."""
    for name, table in study.study.probes.items():
        selection = cell.selected(table.runs)
        if not cell.unavailable and selection is not None:
            yield name, table, selection


def planned_probes(study: LoadedStudy, cell: Cell, run: "Run") -> Iterator[PlannedProbes]:
    """Yield the state of the probes of a whole run."""
    failures = Failures(study.study.folder)
    for name, table, selection in probes_of(study, cell):
        why = _why_missing(study, table, cell, run, selection)
        failure = failures.of(cell, name) if why else None
        if failure is not None:
            yield PlannedProbes(name, "failed", failure.reason)
        else:
            yield PlannedProbes(name, "missing" if why else "stored", why)


def _why_missing(study: LoadedStudy, table: ProbesTable, cell: Cell, run: "Run", selection: Selection) -> str:
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
    study: LoadedStudy, table: ProbesTable, network: Cell, selection: Selection, controls: Controls
) -> str:
    """Return why probes are to be compared with their untrained network again, empty if they are.

    Stored comparisons do not name the run of the network: they are of it if accuracies are those of its probes.
    """
    try:
        run = part_of(open_matching(study, network, partial=True), network, selection).in_wording()
        curves = load_results(run, probe_key_of(table, run)).curves
    except ProbeKitError:
        return "not compared with its untrained network"
    if not all(is_of_network(score, curves) for score in controls.untrained):
        return "compared with another untrained network"
    return "" if controls.untrained else "without the control untrained"


def is_of_network(score: UntrainedScore, curves: Mapping[tuple[str, str], ProbeCurve]) -> bool:
    """Whether a comparison may be with the network of these curves, which may lack its category or its site."""
    curve = curves.get((score.category, score.view))
    rows = {} if curve is None else {str(site): row for row, site in enumerate(curve.sites)}
    row = rows.get(score.untrained_site)
    if curve is None or row is None:
        return False
    return isclose(curve.correct[row].astype(float).mean(), score.untrained_accuracy)


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def untrained_cell(study: LoadedStudy, table: ProbesTable, cell: Cell) -> Cell | None:
    """Return the run of the untrained network that probes are compared with, None without such a control."""
    return control_of(study.study, study.cells, cell) if "untrained" in table.controls else None
