"""A label in a page: its row of the retention table, its figures, its best sites beside their controls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from probe_kit._tables.table import Table
from probe_kit.errors import NoProbesError
from probe_kit.retention.displays.labels import label_figures
from probe_kit.retention.labels.table import LabelRetentionTable, label_retention_table
from probe_kit.retention.report.pictures import Picture, arranged
from probe_kit.train.choices import Task
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, stored_targets
from probe_kit.train.results.summary import best_sites_sentences, best_sites_table


@dataclass(frozen=True)
class LabelSection:
    """One label. run: its name, empty where the section is of all runs. measured: task and metric.

    retention, sentences: its rows of the retention table, and what they say. pictures: by kind, see `arranged`.
    probes: best sites and controls, a table per run. notes: what the probes say, and what was left out. Of a run
    without backbone or action there is no retention, and a sentence says so.
    """

    target: str
    run: str
    measured: str
    retention: Table | None
    sentences: tuple[str, ...]
    pictures: list[list[Picture]]
    probes: tuple[Table, ...]
    notes: tuple[str, ...]

    @property
    def tables(self) -> tuple[Table, ...]:
        """All of them."""
        return self.probes if self.retention is None else (self.retention, *self.probes)


def label_sections(
    runs: Sequence[RunReader],
    table: LabelRetentionTable,
    names: Sequence[str],
    places: tuple[str, ...],
    of_one: str = "",
) -> list[LabelSection]:
    """A section per label of the table. names: of the runs. of_one: name of the run where sections are of one."""
    exhibits = label_figures(runs, table)
    sections = []
    for target in table.targets:
        of_target = table.of_target(target)
        probes = {name: table.results[str(run.location), target] for name, run in zip(names, runs, strict=True)}
        several = len(probes) > 1
        sections.append(
            LabelSection(
                target,
                of_one,
                _measured(next(iter(probes.values()))),
                of_target.text,
                tuple(of_target.sentences),
                arranged(exhibits, target, names, places),
                tuple(
                    _probes_table(results, f"Best sites and controls{f', {name}' if several else ''}")
                    for name, results in probes.items()
                ),
                tuple(
                    f"{name}: {sentence}" if several else sentence
                    for name, results in probes.items()
                    for sentence in best_sites_sentences(results)
                ),
            )
        )
    return sections


def stored_label_sections(
    runs: Sequence[RunReader], names: Sequence[str], places: tuple[str, ...]
) -> list[LabelSection]:
    """A section per run and label column of which the run has probes; none for other runs."""
    sections = []
    for run, name in zip(runs, names, strict=True):
        of_one = name if len(runs) > 1 else ""
        for target in stored_targets(run):
            try:
                table = label_retention_table([run], target)
            except NoProbesError as error:
                sections.append(_without_retention(load_results(run, target=target), of_one, str(error)))
            else:
                sections += label_sections([run], replace(table, tried={}), [name], places, of_one)
    return sections


def _without_retention(results: ProbeResults, of_one: str, reason: str) -> LabelSection:
    return LabelSection(
        results.settings.target, of_one, _measured(results), None, (f"{reason}.",), [],
        (_probes_table(results, "Best sites and controls"),), tuple(best_sites_sentences(results)),
    )  # fmt: skip


def _measured(results: ProbeResults) -> str:
    settings = results.settings
    curve = next(iter(results.curves.values()))
    classes = f" of {len(curve.classes)} classes" if settings.task == "classes" else ""
    return f"A {_TASKS[settings.task]} label{classes}; the score is {METRICS[settings.task]}."


_TASKS: dict[Task, str] = {"binary": "binary", "classes": "categorical", "continuous": "continuous"}


def _probes_table(results: ProbeResults, title: str) -> Table:
    return replace(best_sites_table([results]), title=title)
