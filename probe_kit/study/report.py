"""The figures of a study, and its report: one HTML file with its state, tables, figures, and settings of runs."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.drafts import write_whole
from probe_kit._tables.table import Cell, Table
from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.interchange import stored_steering
from probe_kit.retention.displays import curves_side_by_side, dose_response, layer_curve
from probe_kit.retention.displays.display import BLUE, VERMILION, footer, panels, plain
from probe_kit.retention.displays.report_figure import ONLY_FILLED, ReportFigure
from probe_kit.retention.report.page import PageFigure, citation, data_uri, provenance, render, words_of
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.study.cells import slugs
from probe_kit.study.plan import plan_study
from probe_kit.study.rates import domain_scores, episodes_per_category
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import complaint_of_unknown
from probe_kit.study.stored import StoredRuns, stored_runs, study_probes
from probe_kit.study.tables import make_each, make_table
from probe_kit.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def make_figures(study: LoadedStudy, name: str, partial_runs: bool = False) -> list[ReportFigure]:
    """Return the figures of one name, from stored runs alone; nothing is drawn yet.

    A figure of the kind `dose` is one per run that was steered; others are one of all runs.

    Args:
        study: The study whose runs are stored.
        name: Name of the figure in the file.
        partial_runs: Accept runs that are missing or unfinished.

    Raises:
        UsageError: For an unknown name, or where no run has what the figure shows.
        RunIncompleteError: For runs that are missing.
    """
    if name not in study.study.figures:
        raise UsageError(complaint_of_unknown("figure", name, list(study.study.figures)))
    figure = study.study.figures[name]
    categories = None if figure.categories is None else slugs(figure.categories)
    subject = f"the figure {name!r}"
    runs = stored_runs(study, lambda cell: cell.selected(figure.runs), subject, partial_runs, categories)
    if figure.kind == "curves":
        return [_curves(study, name, runs, categories, partial_runs)]
    if figure.kind == "dose":
        return _doses(name, runs)
    opened = [stored.run for stored in runs.runs]
    table = retention_table(opened, labels=runs.labels, pairs=(), keys=[""] * len(opened))
    reading = "Normalised score of the mean over the categories of a domain: 0 for guessing, 100 for perfection."
    return [ReportFigure(name, "Score by domain", "behaviour", reading, None, partial(draw_overview, table))]


def _curves(
    study: LoadedStudy, name: str, runs: StoredRuns, categories: tuple[str, ...] | None, partial_runs: bool
) -> ReportFigure:
    """Return a panel per category and part of the model, a line per system; of one system a line per iteration."""
    stored_probes = {
        runs.labels[stored.location]: study_probes(study, stored, stored.probed.in_wording(), partial_runs)
        for stored in runs.runs
    }
    probes = {label: of_run for label, of_run in stored_probes.items() if of_run is not None}
    if not probes:
        raise UsageError(
            f"no run of the figure {name!r} has the probes of the file; `probe-kit study run {study.typed}` fits "
            "them"
        )
    names, results = list(probes), list(probes.values())
    view = study.study.figures[name].view or results[0].settings.views[0]
    if len(results) == 1 and categories is None:
        draw = partial(layer_curve, results[0], view)
    else:
        draw = partial(curves_side_by_side, results, names, view, categories=categories)
    reading = f"How often a linear probe names the side of the correct picture, layer by layer. {ONLY_FILLED}."
    return ReportFigure(name, "Layer curves", "probes", reading, None, draw)


def _doses(name: str, runs: StoredRuns) -> list[ReportFigure]:
    steered = [stored for stored in runs.runs if stored_steering(stored.run)]
    if not steered:
        raise UsageError(
            f"no run of the figure {name!r} was steered. Steer one with `probe-kit intervene "
            f"{runs.runs[0].location} --kind steer --sites backbone.NN --roles image`"
        )
    reading = "Episodes that turn to the side they are pushed to, minus those that turn from it, by coefficient."
    figures = []
    for at, stored in enumerate(steered):
        cell = stored.cell
        stem = "-".join([name, cell.model, cell.way, *([str(cell.seed)] if cell.seed else [])])
        title = f"Dose and response: {runs.labels[stored.location]}"
        figures.append(ReportFigure(stem, title, "interventions", reading, at, partial(dose_response, stored.run)))
    return figures


def draw_overview(table: RetentionTable) -> "Figure":
    """Draw bars of the normalised score, a panel per domain on one scale, a bar per system.

    Raises:
        UsageError: Where no model acted or answered.
    """
    scores = domain_scores(table)
    if not scores:
        raise UsageError("no model of these runs acted or answered, so there is no score")
    systems = list(dict.fromkeys(system for of_domain in scores.values() for system in of_domain))
    figure, grid = panels(len(scores), width=3.1, height=0.24 * len(systems) + 0.8, columns=min(3, len(scores)))
    for axes, (domain, of_domain) in zip(grid, scores.items(), strict=True):
        values = [of_domain.get(system, 0.0) for system in systems]
        for at in (at for at, system in enumerate(systems) if system not in of_domain):
            axes.text(2, at, "no episodes", fontsize=7, color="0.45", va="center")
        axes.barh(range(len(systems)), values, color=[BLUE if score >= 0 else VERMILION for score in values])
        axes.axvline(0, color="0.45", lw=1)
        plain(axes)
        axes.set_title(domain, fontsize=9, loc="left")
    grid[0].set_yticks(range(len(systems)), systems, fontsize=8)
    grid[0].set_ylim(len(systems) - 0.4, -0.6)
    grid[0].set_xlim(-105, 105)
    footer(figure, f"normalised score: 0 guessing, 100 perfection · n = {episodes_per_category(table)}")
    return figure


# -- the report --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyReport:
    """The report of a study.

    Attributes:
        html: Text of the page.
        missing: By table or figure, the reason why it is not there.
        is_partial: Whether a run is missing.
    """

    html: str
    missing: dict[str, str]
    is_partial: bool


def write_study_report(study: LoadedStudy, path: Path | str, partial: bool = False) -> StudyReport:
    """Write the report of a study as one HTML file, whole or not at all.

    Raises as `make_table` and `make_figures` too.

    Args:
        study: The study whose runs are stored.
        path: The HTML file.
        partial: Leave out what is missing; the page names it with the reason.

    Raises:
        UsageError: Where no run is stored.
    """
    report = study_report(study, partial)
    write_whole(Path(path), report.html)
    return report


def study_report(study: LoadedStudy, partial: bool = False) -> StudyReport:
    """Return the page as text, from stored runs alone. It needs no network, and holds no path of this machine."""
    file = study.study
    tables, no_table = make_each(file.tables, lambda name: make_table(study, name, partial), partial)
    figures, no_figure = make_each(file.figures, lambda name: make_figures(study, name, partial), partial)
    missing = {f"table {name}": why for name, why in no_table.items()}
    missing |= {f"figure {name}": why for name, why in no_figure.items()}
    runs = stored_runs(study, lambda cell: cell.selection, str(study.file), partial=True)
    plan = plan_study(study)
    paths = tuple(name for stored in runs.runs for name in (stored.run.location.address, stored.location))
    rows = [
        (run.cell.model, run.run_text, ", ".join(run.cell.selections), Cell(run.cell.episodes), run.words)
        for run in plan.cells
    ]
    state = Table.of("Runs", ("model", "run", "blocks", "episodes", "state"), rows, names=2)
    drawn = {
        name: [PageFigure(each.title, "", each.reading, *data_uri(each, paths), extra=False) for each in of_name]
        for name, of_name in figures.items()
    }
    sentence, bibtex = citation([stored.run for stored in runs.runs])
    html = render(
        "study.html.jinja",
        paths,
        title=file.name,
        version=__version__,
        several=False,
        suite=study.suite.identity,
        totals=plan.totals(),
        state=state,
        missing=missing,
        skipped=plan.skipped(),
        tables=tables,
        figures=drawn,
        file=read_regular(study.file).decode("utf-8-sig"),
        provenance=[provenance(runs.labels[stored.location], stored.run, []) for stored in runs.runs],
        words=words_of([state, *tables.values()]),
        sentence=sentence,
        bibtex=bibtex,
    )
    partly = bool(missing) or bool(runs.unfinished) or any(of_name.is_partial for of_name in tables.values())
    return StudyReport(html, missing, partly)
