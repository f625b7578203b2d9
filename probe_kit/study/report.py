"""The report of a study: one HTML file with its state, every table and figure, and the settings of its runs."""

from dataclasses import dataclass
from pathlib import Path

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.drafts import write_whole
from probe_kit._tables.table import Table
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.report.parts import Picture, citation, data_uri, provenance, render, words_of
from probe_kit.study.figures import make_figures
from probe_kit.study.plan import StudyPlan, plan_study
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.stored import stored_runs
from probe_kit.study.tables import make_each, make_table
from probe_kit.version import __version__


@dataclass(frozen=True)
class StudyReport:
    """html: the page. missing: by table or figure, why it is not there. is_partial: whether a run is missing."""

    html: str
    missing: dict[str, str]
    is_partial: bool


def write_study_report(study: LoadedStudy, path: Path | str, partial: bool = False) -> StudyReport:
    """Write the report of a study as one HTML file, whole or not at all.

    partial: leave out what is missing; the page names it with the reason.
    Raises UsageError where no run is stored, and what `make_table` and `make_figures` raise.
    """
    report = study_report(study, partial)
    write_whole(Path(path), report.html)
    return report


def study_report(study: LoadedStudy, partial: bool = False) -> StudyReport:
    """The page as text, from stored runs alone. It needs no network, and holds no path of this machine."""
    file = study.study
    tables, no_table = make_each(file.tables, lambda name: make_table(study, name, partial), partial)
    figures, no_figure = make_each(file.figures, lambda name: make_figures(study, name, partial), partial)
    missing = {f"table {name}": why for name, why in no_table.items()}
    missing |= {f"figure {name}": why for name, why in no_figure.items()}
    runs = stored_runs(study, lambda cell: cell.selection, str(study.file), partial=True)
    labels, plan = runs.labels(study), plan_study(study)
    places = tuple(name for stored in runs.runs for name in (stored.run.location.address, stored.location))
    state = _state(plan)
    drawn = {name: [_picture(stored, places) for stored in of_name] for name, of_name in figures.items()}
    sentence, bibtex = citation([stored.run for stored in runs.runs])
    html = render(
        "study.html.jinja",
        places,
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
        provenance=[provenance(labels[stored.location], stored.run, []) for stored in runs.runs],
        words=words_of([state, *tables.values()]),
        sentence=sentence,
        bibtex=bibtex,
    )
    partly = bool(missing) or bool(runs.unfinished) or any(of_name.is_partial for of_name in tables.values())
    return StudyReport(html, missing, partly)


def _state(plan: StudyPlan) -> Table:
    """A row per run: what is stored of it."""
    cells = [
        (
            planned.cell.model,
            planned.run_text,
            ", ".join(planned.cell.selections),
            str(planned.cell.episodes),
            planned.words,
        )
        for planned in plan.cells
    ]
    return Table.of("Runs", ("model", "run", "blocks", "episodes", "state"), cells, names=2)


def _picture(figure: ReportFigure, places: tuple[str, ...]) -> Picture:
    return Picture(figure.title, "", figure.reading, *data_uri(figure, places), extra=False)
