"""Probes that a study file names: what decides them, and whether they are stored."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from probe_kit.study.cells import Cell
from probe_kit.study.expansion import control_of
from probe_kit.study.ledger import Entry, settings_changed
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.tables.stored_runs import of_blocks
from probe_kit.train.results.store import is_stored

if TYPE_CHECKING:
    from probe_kit.runs import Run


@dataclass(frozen=True)
class PlannedProbes:
    """Probes of one run. name: of their table in the file. why: in words, unless they are stored."""

    name: str
    state: Literal["stored", "missing", "failed"]
    why: str = ""


def probes_of(study: LoadedStudy, cell: Cell) -> Iterator[tuple[str, ProbesTable]]:
    """The tables of probes that a cell belongs to, by name."""
    for name, table in study.study.probes.items():
        if not cell.unavailable and of_blocks(table.runs)(cell) is not None:
            yield name, table


def control_cell(study: LoadedStudy, cell: Cell, table: ProbesTable) -> Cell | None:
    """The run of the untrained network; None where the table asks for no such control, or the model has none."""
    return control_of(study.study, study.cells, cell) if "untrained" in table.controls else None


def what_decides(table: ProbesTable, cell: Cell, run: "Run", control: "Run | None") -> dict[str, Any]:
    """All that the probes of a run follow from, as plain values."""
    selection = of_blocks(table.runs)(cell)
    assert selection is not None, "the table is one of `probes_of`"
    fitted = table.model_dump(exclude={"runs"})
    stamps = {"run": run.stamp, "untrained": None if control is None else control.stamp}
    return {**fitted, "items": selection.counts(cell.suite), **stamps}


def planned_probes(name: str, known: Mapping[str, Any] | None, entry: Entry, run: "Run") -> PlannedProbes:
    """The state of the probes `name` of a run. known: what decides them, None without the run of their control."""
    stored = entry.probes.get(name)
    if stored is not None and known is not None and stored.known == known and is_stored(run.location, stored.key):
        return PlannedProbes(name, "stored")
    if name in entry.probe_failures:
        return PlannedProbes(name, "failed", entry.probe_failures[name].reason)
    if known is None:
        return PlannedProbes(name, "missing", "waits for the untrained network")
    if stored is None or stored.known == known:
        return PlannedProbes(name, "missing", "not fitted")
    return PlannedProbes(name, "missing", "; ".join(settings_changed(stored.known, known)))
