"""Putting the page together: one HTML file with everything in it."""

from collections.abc import Sequence
from pathlib import Path

from probe_kit._system.drafts import write_whole
from probe_kit._tables.heat import heat_key
from probe_kit._tables.table import Table
from probe_kit._terminal.plain_text import without_places
from probe_kit.errors import UsageError
from probe_kit.retention.columns.comparisons import known_used_tables
from probe_kit.retention.columns.modes import Modes, modes_of
from probe_kit.retention.columns.tables import SUBJECTS
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.displays.report_figures import collect_figures
from probe_kit.retention.joins import joins_of
from probe_kit.retention.report.episodes import PICTURES, EpisodeGrid, episode_grid
from probe_kit.retention.report.label_sections import stored_label_sections
from probe_kit.retention.report.opening import Question, opening_curve, opening_question, opening_row
from probe_kit.retention.report.pictures import Picture, arranged, data_uri
from probe_kit.retention.report.provenance import citation, provenance
from probe_kit.retention.report.render import render
from probe_kit.retention.report.summaries import RunInWords, read_run
from probe_kit.retention.report.words import words_of
from probe_kit.retention.rows.outcome_rules import under_rule
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.train.data.run_reader import RunReader
from probe_kit.version import __version__


def write_report(
    runs: Sequence[RunReader],
    path: Path | str,
    table: RetentionTable | None = None,
    *,
    pictures: int = PICTURES,
) -> Path:
    """Write the report of `runs` as one HTML file, whole or not at all, and return its path.

    table: their retention table, made with its defaults if it is not given. pictures: at most so many episodes
    show their frames. Raises UsageError without runs.
    """
    path = Path(path)
    page = report_html(runs, table, pictures=pictures)
    write_whole(path, page)
    return path


def report_html(
    runs: Sequence[RunReader], table: RetentionTable | None = None, *, pictures: int = PICTURES
) -> str:
    """The page as text; the same runs and probes give the same text. See `write_report`."""
    if not runs:
        raise UsageError("a report needs at least one run")
    table = table or retention_table(runs)
    called = {row.run.location: model_name(row) for row in table.rows}
    as_judged = [under_rule(run, table.rule, table.last_steps) for run in runs]
    exhibits = [exhibit for exhibit in collect_figures(runs, table) if not exhibit.is_table]
    names = [called[str(run.location)] for run in runs]
    joins = joins_of(runs, table)
    sentence, bibtex = citation(runs)
    rows = table.all_rows
    modes = modes_of(rows)
    places = tuple(path for run in runs for path in (run.location.address, str(run.location)))
    tables = _tables(table)
    summary = table.summary_table
    shown_names = [without_places(name, places) for name in names]
    grid = episode_grid(as_judged, shown_names, pictures)
    in_words = _in_words(table)
    labels = stored_label_sections(runs, names, places)
    question, curve = _opening(table, runs, shown_names, grid, places)
    label_tables = [table for label in labels for table in label.tables]
    further_tables = table.further_tables
    joined = [part for joined in joins.tables for part in known_used_tables(joined)]
    return render(
        "page.html.jinja",
        places,
        modes=modes,
        answered=_ANSWERED[modes],
        did="What it answers" if modes == "answers" else "What it does",
        reached="What reaches the answer" if modes == "answers" else "What reaches the action",
        title=listed(names),
        suites=list(dict.fromkeys(run.suite for run in runs)),
        version=__version__,
        finding=table.summary,
        summary=summary,
        question=question,
        curve=curve,
        in_words=in_words,
        warnings=[(views[0].name, warning) for views in in_words for warning in views[0].warnings],
        notes=table.notes,
        tables=tables,
        wordings=table.wording_tables,
        further=further_tables,
        joined=joined,
        join_notes=[*joins.refused, *dict.fromkeys(note for joined in joins.tables for note in joined.notes)],
        pictures={
            subject: arranged(exhibits, subject, names, places)
            for subject in ("behaviour", "probes", "retention", "interventions", "join")
        },
        grid=grid,
        several=len(runs) > 1,
        provenance=[
            provenance(name, run, table.results.get(str(run.location)))
            for name, run in zip(names, runs, strict=True)
        ],
        labels=labels,
        words=words_of(
            [
                summary,
                *(part for of_subject in tables.values() for part in of_subject),
                *label_tables,
                *further_tables,
                *joined,
            ]
        ),
        heat=heat_key(),
        sentence=sentence,
        bibtex=bibtex,
    )


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


def listed(names: Sequence[str]) -> str:
    """A, B and C."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
