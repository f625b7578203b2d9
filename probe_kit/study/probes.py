"""The probes that a study file names, and whether they are stored with their run."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Literal

from probe_kit.errors import ProbeKitError
from probe_kit.study.cells import Cell
from probe_kit.study.expansion import control_of
from probe_kit.study.failures import Failures
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.stored import of_blocks, part_of, probe_key_of
from probe_kit.train.results.store import read_controls, read_probes, settings_of

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


def probes_of(study: LoadedStudy, cell: Cell) -> Iterator[tuple[str, ProbesTable]]:
    """Yield the tables of probes that a cell belongs to, by name."""
    for name, table in study.study.probes.items():
        if not cell.unavailable and of_blocks(table.runs)(cell) is not None:
            yield name, table


def planned_probes(study: LoadedStudy, cell: Cell, run: "Run") -> Iterator[PlannedProbes]:
    """Yield the state of the probes of a whole run."""
    failures = Failures(study.study.folder)
    for name, table in probes_of(study, cell):
        why = _why_missing(study, table, cell, run)
        failure = failures.of(cell, name) if why else None
        if failure is not None:
            yield PlannedProbes(name, "failed", failure.reason)
        else:
            yield PlannedProbes(name, "missing" if why else "stored", why)


def _why_missing(study: LoadedStudy, table: ProbesTable, cell: Cell, run: "Run") -> str:
    """Return why the probes of a table are to be fitted, empty if they and all of their controls are stored."""
    selection = of_blocks(table.runs)(cell)
    assert selection is not None, "the table is one of `probes_of`"
    if not run.streams:
        return "the run has no activations"
    stored = read_probes(run.location)
    try:
        bundle = stored.get(probe_key_of(table, part_of(run, cell, selection).in_wording()))
    except ProbeKitError:  # such as too few groups, which fitting says at length
        return "not fitted"
    if bundle is not None:
        absent = [name for name in controls_of(study, table, cell) if name not in read_controls(bundle).names]
        return f"without the control {', '.join(absent)}" if absent else ""
    of_target = [bundle for bundle in stored.values() if settings_of(bundle).target == table.target]
    if not of_target:
        return "not fitted"
    former = asdict(settings_of(max(of_target, key=lambda bundle: bundle.times.get("asked", ""))))
    changes = [
        f"{name} {_text(former[name])} → {_text(value)}"
        for name, value in table.model_dump(include=set(_FITTED)).items()
        if _text(former[name]) != _text(value)
    ]
    return "; ".join(changes) or "of other episodes"


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def controls_of(study: LoadedStudy, table: ProbesTable, cell: Cell) -> list[str]:
    """Return the controls that the probes of a cell have; an untrained network has no untrained network."""
    has_untrained = control_of(study.study, study.cells, cell) is not None
    return [name for name in table.controls if name != "untrained" or has_untrained]
