"""The page put together: one HTML file with everything in it, for every target."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.counting import enumerated
from probe_kit._system.drafts import write_whole
from probe_kit._system.escaping import without_places
from probe_kit._tables.content import heat_key
from probe_kit._tables.table import Table
from probe_kit.errors import UsageError
from probe_kit.retention.columns.comparisons import known_used_tables
from probe_kit.retention.columns.sentences import conclusion
from probe_kit.retention.columns.tables import SUBJECTS
from probe_kit.retention.columns.text import Modes, model_name, modes_of, title_of
from probe_kit.retention.displays.bars import joins_of
from probe_kit.retention.displays.layer_curves import LayerCurveDisplay
from probe_kit.retention.displays.report_figure import ONLY_FILLED, ReportFigure, collect_figures
from probe_kit.retention.displays.style import caption, legend_above, panels
from probe_kit.retention.report.episodes import PICTURES, EpisodeGrid, episode_grid
from probe_kit.retention.report.parts import (
    Picture,
    arranged,
    citation,
    data_uri,
    provenance,
    render,
    warnings_of,
    words_of,
)
from probe_kit.retention.rows.outcome_rules import under_rule
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import Task
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults, best_sites_table
from probe_kit.train.results.store import stored_targets
from probe_kit.train.results.summary import best_sites_findings
from probe_kit.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ANSWERED: dict[Modes, str] = {
    "acts": "the answer is where the cube ends",
    "answers": "the answer is what the model says",
    "both": "a policy answers by where the cube ends, a model that was asked by what it says",
}
_SIDES = {"left": "on the left", "right": "on the right"}
_OUTCOMES = {
    "correct": "the cube ended on it",
    "wrong": "the cube ended on the other picture",
    "oob": "the cube ended on neither picture",
}
_ANSWERS = {
    "correct": "the model answers right",
    "wrong": "the model answers wrong",
    "oob": "no answer could be read",
}
_TASKS: dict[Task, str] = {"binary": "binary", "classes": "categorical", "continuous": "continuous"}


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
    write_whole(path, report_html(runs, table, pictures=pictures))
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
    sides: dict[str, Any] = {}
    tables = [summary]
    if table.is_of_sides:
        sides, of_sides = _sides(runs, table, exhibits, names, places, pictures)
        tables += of_sides
        labels = _stored_labels(runs, names, places)
    else:
        labels = _labels(runs, table, exhibits, names, places)
    tables += [part for label in labels for part in (label["retention"], *label["probes"])]
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
            provenance(name, run, [probes for (at, _), probes in table.results.items() if at == str(run.location)])
            for name, run in zip(names, runs, strict=True)
        ],
        interventions=arranged(exhibits, "interventions", names, places),
        labels=labels,
        words=words_of(
            [summary, *tables, *(part for label in labels for part in (label["retention"], *label["probes"]))]
        ),
        sentence=sentence,
        bibtex=bibtex,
        **sides,
    )


# -- sides -------------------------------------------------------------------------------------------------------


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
    warnings: dict[tuple[str | None, str], list[tuple[str, str]]] = {}
    further_views = []
    for mean in table.means:
        rows = [row for row in table.rows if (*row.key, row.view) == (*mean.key, mean.view)]
        if mean.key in warnings:  # the summary is of the first view
            sentences = [f"{title_of(row.category)}: {conclusion(row)}" for row in rows]
            further_views.append((f"{model_name(mean)}, view {mean.view}", sentences))
        else:
            warnings[mean.key] = [(model_name(mean), sentence) for sentence in warnings_of(mean, rows)]
    opening, question, curve = opening_row(table), None, None
    if opening is not None:
        position = [str(run.location) for run in runs].index(opening.run.location)
        question = _question(opening, shown_names[position], grid)
        if (exhibit := _opening_curve(opening, table, position)) is not None:
            source = data_uri(exhibit, places)
            curve = Picture(exhibit.title, shown_names[position], exhibit.reading, *source, False)
    joins, refused = joins_of(runs, table)
    joined = [part for join in joins for part in known_used_tables(join)]
    tables: dict[str, list[Table]] = {subject: [] for subject in SUBJECTS.values()}
    for title, part in table.tables().items():
        tables[SUBJECTS[title]].append(part)
    further_tables = table.further_tables
    content = {
        "modes": modes,
        "answered": _ANSWERED[modes],
        "did": "What it answers" if modes == "answers" else "What it does",
        "reached": "What reaches the answer" if modes == "answers" else "What reaches the action",
        "question": question,
        "curve": curve,
        "further_views": further_views,
        "warnings": [warning for of_run in warnings.values() for warning in of_run],
        "tables": tables,
        "wordings": table.wording_tables,
        "further": further_tables,
        "joined": joined,
        "join_notes": [*refused, *dict.fromkeys(note for join in joins for note in join.notes)],
        "pictures": {
            subject: arranged(exhibits, subject, names, places)
            for subject in ("behaviour", "probes", "retention", "join")
        },
        "grid": grid,
        "heat": heat_key(),
    }
    return content, [*(part for of_subject in tables.values() for part in of_subject), *further_tables, *joined]


def opening_row(table: RetentionTable) -> RetentionRow | None:
    """The category to open with: one that the backbone holds and the action does not, if there is one.

    Of runs with probes the first category with signal is next, and then the first at all; None without rows.
    """
    rows = [category.row for run in table.summary for category in run.categories]
    probed = [row for row in rows if row.backbone.score is not None]
    encoded = [row for row in probed if row.backbone.has_signal]
    lost = [row for row in encoded if not row.action.has_signal]
    return next(iter((*lost, *encoded, *probed, *rows)), None)


def _question(row: RetentionRow, name: str, grid: EpisodeGrid) -> Mapping[str, Any] | None:
    """The first episode of the row's category with a picture, of this run by its name; None without one.

    Its card, its picture as a data URI, and how it ended, in words.
    """
    for card in grid.cards:
        if card["run"] == name and card["category"] == row.category and card["picture"] is not None:
            outcome = (_ANSWERS if card["asked"] else _OUTCOMES).get(card["outcome"], "it was captured only")
            answer = f": {card['answer']}" if card["answer"] else ""
            frames = "First frame" if card["frames"] == 1 else "First and last frame"
            caption = f"{frames}. The correct picture lies {_SIDES[card['side']]}{answer}; {outcome}."
            return {"card": card, "source": f"data:image/webp;base64,{grid.picture(card)}", "caption": caption}
    return None


def _opening_curve(row: RetentionRow, table: RetentionTable, position: int) -> ReportFigure | None:
    """Accuracy by layer of the row's category; None where it was not probed. position: of the run."""
    results = table.results_of(row.run.location)
    if results is None or row.backbone.score is None:
        return None
    output = "answer" if modes_of([row]) == "answers" else "action"
    iterations = "best" if table.iterations == "all" else table.iterations
    display = LayerCurveDisplay.from_results(results, row.category, row.view, iterations)
    return ReportFigure(
        "opening", f"Where the answer can be read: {title_of(row.category)}", "summary",
        "How often a linear probe names the side of the correct picture, by layer: in the backbone, and where the "
        f"{output} is made. {ONLY_FILLED}.",
        position, partial(_together, display),
    )  # fmt: skip


def _together(display: LayerCurveDisplay) -> "Figure":
    """All streams on the same axes, with a legend and no more."""
    figure, (axes,) = panels(1, 4.7, 2.0)
    display.plot(axes)
    axes.set_title("", loc="left")
    axes.set_ylabel(display.measure, fontsize=8.5)
    legend_above(figure, axes.get_legend_handles_labels()[0])
    caption(figure, *display.certificates)
    return figure


# -- labels ------------------------------------------------------------------------------------------------------


def _labels(
    runs: Sequence[RunReader],
    table: RetentionTable,
    exhibits: Sequence[ReportFigure],
    names: Sequence[str],
    places: tuple[str, ...],
    of_run: str = "",
) -> list[dict[str, Any]]:
    """Return a section per label of the table.

    Its rows of the table and what they say, its figures, its best sites beside their controls, a table per run,
    and what the probes say. exhibits: figures of the table. names: of the runs. of_run: name of the run where
    sections are of one.
    """
    sections: list[dict[str, Any]] = []
    for target in table.targets:
        of_target = table.of_target(target)
        probes = {name: table.results[str(run.location), target] for name, run in zip(names, runs, strict=True)}
        several = len(probes) > 1
        section = {
            "target": target,
            "run": of_run,
            "measured": _measured(next(iter(probes.values()))),
            "retention": of_target.tables()["Retention"],
            "sentences": [category.details for run in of_target.summary for category in run.categories],
            "pictures": arranged(exhibits, target, names, places),
            "probes": [
                replace(best_sites_table([of]), title=f"Best sites and controls{f', {name}' if several else ''}")
                for name, of in probes.items()
            ],
            "notes": [
                f"{name}: {sentence}" if several else sentence
                for name, of in probes.items()
                for sentence in best_sites_findings(of)
            ],
        }
        sections.append(section)
    return sections


def _stored_labels(
    runs: Sequence[RunReader], names: Sequence[str], places: tuple[str, ...]
) -> list[dict[str, Any]]:
    """A section per run and label column of which the run has probes; none for other runs."""
    sections = []
    for run, name in zip(runs, names, strict=True):
        if targets := list(stored_targets(run)):
            table = retention_table([run], target=targets)
            of_run = name if len(runs) > 1 else ""
            sections += _labels([run], table, collect_figures([run], table), [name], places, of_run)
    return sections


def _measured(results: ProbeResults) -> str:
    settings, curve = results.settings, next(iter(results.curves.values()))
    classes = f" of {len(curve.classes)} classes" if settings.task == "classes" else ""
    return f"A {_TASKS[settings.task]} label{classes}; the score is {METRICS[settings.task]}."
