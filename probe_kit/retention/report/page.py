"""The page put together: one HTML file with everything in it, for every target."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from probe_kit._system.counting import enumerated
from probe_kit._system.drafts import write_whole
from probe_kit._tables.heat import heat_key
from probe_kit._tables.table import Table
from probe_kit._terminal.plain_text import without_places
from probe_kit.errors import UsageError
from probe_kit.retention.columns.comparisons import known_used_tables
from probe_kit.retention.columns.modes import Modes, modes_of
from probe_kit.retention.columns.tables import SUBJECTS
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.report_figures import collect_figures
from probe_kit.retention.joins import joins_of
from probe_kit.retention.report.episodes import PICTURES, EpisodeGrid, episode_grid
from probe_kit.retention.report.label_sections import label_sections, stored_label_sections
from probe_kit.retention.report.opening import Question, opening_curve, opening_question, opening_row
from probe_kit.retention.report.pictures import Picture, arranged, data_uri
from probe_kit.retention.report.provenance import citation, provenance
from probe_kit.retention.report.render import render
from probe_kit.retention.report.summaries import RunInWords, read_run
from probe_kit.retention.report.words import words_of
from probe_kit.retention.rows.outcome_rules import under_rule
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.runs.reader import RunReader
from probe_kit.version import __version__


def write_report(
    runs: Sequence[RunReader],
    path: Path | str,
    table: RetentionTable | None = None,
    *,
    pictures: int = PICTURES,
) -> Path:
    """Write the report of `runs` as one HTML file, whole or not at all, and return its path.

    table: their retention table, of sides with its defaults if it is not given. pictures: at most so many episodes
    show their frames; a page of labels shows none. Raises UsageError without runs, and for a run that the table
    was not made of.
    """
    path = Path(path)
    page = report_html(runs, table, pictures=pictures)
    write_whole(path, page)
    return path


def report_html(
    runs: Sequence[RunReader], table: RetentionTable | None = None, *, pictures: int = PICTURES
) -> str:
    """Return the page as text; the same runs and probes give the same text. See `write_report`."""
    if not runs:
        raise UsageError("a report needs at least one run")
    table = table or retention_table(runs)
    called = {row.run.location: model_name(row) for row in table.rows}
    exhibits = [exhibit for exhibit in collect_figures(runs, table) if not exhibit.is_table]
    names = [called[str(run.location)] for run in runs]
    places = tuple(path for run in runs for path in (run.location.address, str(run.location)))
    summary = table.summary_table
    if table.is_of_sides:
        sides, tables = _sides(runs, table, exhibits, names, places, pictures)
        labels = stored_label_sections(runs, names, places)
    else:
        sides, tables = {}, []
        labels = label_sections(runs, table, exhibits, names, places)
    sentence, bibtex = citation(runs)
    return render(
        "page.html.jinja",
        places,
        is_of_sides=table.is_of_sides,
        title=enumerated(names if table.is_of_sides else table.targets),
        suites=list(dict.fromkeys(run.suite for run in runs)),
        version=__version__,
        finding=table.summary,
        summary=summary,
        notes=table.notes,
        several=len(runs) > 1,
        provenance=[
            provenance(
                name,
                run,
                [results for (location, _), results in table.results.items() if location == str(run.location)],
            )
            for name, run in zip(names, runs, strict=True)
        ],
        interventions=arranged(exhibits, "interventions", names, places),
        labels=labels,
        words=words_of([summary, *tables, *(part for label in labels for part in label.tables)]),
        sentence=sentence,
        bibtex=bibtex,
        **sides,
    )


def _sides(
    runs: Sequence[RunReader],
    table: RetentionTable,
    exhibits: Sequence[ReportFigure],
    names: Sequence[str],
    places: tuple[str, ...],
    pictures: int,
) -> tuple[dict[str, Any], list[Table]]:
    """Return what the page shows of sides alone, such as success, episodes and answers; and all tables of it."""
    modes = modes_of(table.all_rows)
    shown_names = [without_places(name, places) for name in names]
    grid = episode_grid([under_rule(run, table.rule, table.last_steps) for run in runs], shown_names, pictures)
    in_words = _in_words(table)
    question, curve = _opening(table, runs, shown_names, grid, places)
    joins = joins_of(runs, table)
    joined = [part for join in joins.tables for part in known_used_tables(join)]
    tables, further_tables = _tables(table), table.further_tables
    content = {
        "modes": modes,
        "answered": _ANSWERED[modes],
        "did": "What it answers" if modes == "answers" else "What it does",
        "reached": "What reaches the answer" if modes == "answers" else "What reaches the action",
        "question": question,
        "curve": curve,
        "in_words": in_words,
        "warnings": [(views[0].name, warning) for views in in_words for warning in views[0].warnings],
        "tables": tables,
        "wordings": table.wording_tables,
        "further": further_tables,
        "joined": joined,
        "join_notes": [*joins.refused, *dict.fromkeys(note for join in joins.tables for note in join.notes)],
        "pictures": {
            subject: arranged(exhibits, subject, names, places)
            for subject in ("behaviour", "probes", "retention", "join")
        },
        "grid": grid,
        "heat": heat_key(),
    }
    return content, [*(part for of_subject in tables.values() for part in of_subject), *further_tables, *joined]


_ANSWERED: dict[Modes, str] = {
    "acts": "the answer is where the cube ends",
    "answers": "the answer is what the model says",
    "both": "a policy answers by where the cube ends, a model that was asked by what it says",
}


def _tables(table: RetentionTable) -> dict[str, list[Table]]:
    """Return the tables by subject."""
    by_subject: dict[str, list[Table]] = {subject: [] for subject in SUBJECTS.values()}
    for title, part in table.tables().items():
        by_subject[SUBJECTS[title]].append(part)
    return by_subject


def _opening(
    table: RetentionTable,
    runs: Sequence[RunReader],
    names: Sequence[str],
    grid: EpisodeGrid,
    places: tuple[str, ...],
) -> tuple[Question | None, Picture | None]:
    """The question and the curve of the first screen."""
    row = opening_row(table)
    if row is None:
        return None, None
    position = [str(run.location) for run in runs].index(str(row.run.location))
    question, curve = opening_question(row, names[position], grid), opening_curve(row, table, position)
    if curve is None:
        return question, None
    return question, Picture(curve.title, names[position], curve.reading, *data_uri(curve, places), False)


def _in_words(table: RetentionTable) -> list[list[RunInWords]]:
    """Per run, its sentences per view."""
    by_run: dict[tuple[str | None, str], list[RunInWords]] = {}
    for mean in table.means:
        rows = [
            r
            for r in table.rows
            if (r.group, r.run.location, r.view) == (mean.group, mean.run.location, mean.view)
        ]
        by_run.setdefault((mean.group, mean.run.location), []).append(read_run([*rows, mean]))
    return list(by_run.values())
