"""A label in a page: its row of the retention table, its figures, its best sites beside their controls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from probe_kit._tables.table import Table
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.report_figures import collect_figures
from probe_kit.retention.report.pictures import Picture, arranged
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import Task
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import stored_targets
from probe_kit.train.results.summary import best_sites_sentences, best_sites_table


@dataclass(frozen=True)
class LabelSection:
    """One label. run: its name, empty where the section is of all runs. measured: task and metric.

    retention, sentences: its rows of the retention table, and what they say. pictures: by kind, see `arranged`.
    probes: best sites and controls, a table per run. notes: what the probes say, and what was left out.
    """

    target: str
    run: str
    measured: str
    retention: Table
    sentences: tuple[str, ...]
    pictures: list[list[Picture]]
    probes: tuple[Table, ...]
    notes: tuple[str, ...]

    @property
    def tables(self) -> tuple[Table, ...]:
        """All of them."""
        return self.retention, *self.probes


def label_sections(
    runs: Sequence[RunReader],
    table: RetentionTable,
    exhibits: Sequence[ReportFigure],
    names: Sequence[str],
    places: tuple[str, ...],
    of_one: str = "",
) -> list[LabelSection]:
    """Return a section per label of the table.

    exhibits: its figures. names: of the runs. of_one: name of the run where sections are of one.
    """
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
                of_target.tables()["Retention"],
                tuple(category.details for run in of_target.summary for category in run.categories),
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
        if targets := list(stored_targets(run)):
            table = retention_table([run], target=targets)
            sections += label_sections([run], table, collect_figures([run], table), [name], places, of_one)
    return sections


def _measured(results: ProbeResults) -> str:
    settings = results.settings
    curve = next(iter(results.curves.values()))
    classes = f" of {len(curve.classes)} classes" if settings.task == "classes" else ""
    return f"A {_TASKS[settings.task]} label{classes}; the score is {METRICS[settings.task]}."


_TASKS: dict[Task, str] = {"binary": "binary", "classes": "categorical", "continuous": "continuous"}


def _probes_table(results: ProbeResults, title: str) -> Table:
    return replace(best_sites_table([results]), title=title)
