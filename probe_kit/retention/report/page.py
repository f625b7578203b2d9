"""The page of a report, one HTML file with everything in it, for runs of any target; and the parts of any page."""

import json
import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote
from xml.etree import ElementTree

from probe_kit._system.counting import list_names
from probe_kit._system.drafts import write_whole
from probe_kit._system.escaping import without_folders
from probe_kit._tables.content import heat_key
from probe_kit._tables.html import environment
from probe_kit._tables.table import Table
from probe_kit.errors import UsageError
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.tables import SUBJECTS, known_used_tables
from probe_kit.retention.columns.text import (
    TERMS,
    VERDICT_HELP,
    Modes,
    conclusion,
    model_name,
    modes_of,
    title_of,
    warnings_of,
)
from probe_kit.retention.displays.display import ProvenanceLine, best_of, caption, legend_above, panels
from probe_kit.retention.displays.layer_curves import LayerCurveDisplay
from probe_kit.retention.displays.report_figure import (
    ONLY_FILLED,
    DrawnRun,
    FigureSource,
    ReportFigure,
    caption_of,
)
from probe_kit.retention.report.episodes import PICTURES, EpisodeGrid, episode_grid
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable, retention_table
from probe_kit.runs.reader import SIDE, RunReader
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
# `oob`, out of bounds, is the paper's word for a cube on neither picture.
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
_OPENING = "opening"
"""The subject of the figure next to the summary."""
_TASKS: dict[Task, str] = {"binary": "binary", "classes": "categorical", "continuous": "continuous"}


@dataclass(frozen=True)
class PageFigure:
    """A figure in the page.

    Attributes:
        run: Name of its run, empty for a figure of all runs.
        reading: Explanation of the figure, in plain language.
        source: The figure as a data URI.
        caption: Its origin in full.
        extra: Whether it is folded.
    """

    title: str
    run: str
    reading: str
    source: str
    caption: str
    extra: bool


PicturesBySubject = Mapping[str, Sequence[Sequence[PageFigure]]]
"""By subject, the figures of each kind, those of several runs side by side."""


def write_report(
    runs: Sequence[RunReader],
    path: Path | str,
    table: RetentionTable | None = None,
    *,
    pictures: int = PICTURES,
) -> Path:
    """Write the report of `runs` as one HTML file, whole or not at all, and return its path.

    Args:
        runs: The runs that the report shows.
        path: The HTML file.
        table: Retention table of the runs; None makes that of sides with its defaults.
        pictures: Largest number of episodes that show their frames; a page of labels shows none.

    Raises:
        UsageError: Without runs, and for a run that the table was not made of.
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
    table = retention_table(runs) if table is None else table
    source = FigureSource.of(runs, table)
    paths = tuple(path for run in runs for path in (run.location.address, str(run.location)))
    names = [without_folders(run.name, paths) for run in source.table_runs]
    opening = None if table.labels else opening_row(source)
    pictures_of = arrange_figures([*source.figures(), *_opening_curves(opening, table.iterations)], names, paths)
    sides: dict[str, Any] = {}
    tables = [table.summary_table]
    if not table.labels:
        grid = episode_grid([run.judged for run in source.table_runs], names, pictures)
        question = None if opening is None else _question(opening[0], names[opening[1].position], grid)
        sides = {"grid": grid, "question": question, **_sides(source, pictures_of)}
        tables += [*(part for of_subject in sides["tables"].values() for part in of_subject)]
        tables += [*sides["further"], *sides["joined"]]
        labels = _stored_labels(runs, names, paths)
    else:
        labels = _labels(table, runs, names, pictures_of)
    tables += [part for label in labels for part in (label["retention"], *label["probes"])]
    sentence, bibtex = citation([run.run for run in source.table_runs])
    return render(
        "page.html.jinja",
        paths,
        of_labels=bool(table.labels),
        title=list_names(table.targets if table.labels else names),
        suites=list(dict.fromkeys(run.suite for run in runs)),
        version=__version__,
        finding=table.summary,
        summary=tables[0],
        notes=table.notes,
        several=len(runs) > 1,
        provenance=[
            provenance(name, run.run, [probes for (at, _), probes in table.results.items() if at == run.location])
            for name, run in zip(names, source.table_runs, strict=True)
        ],
        interventions=pictures_of.get("interventions", []),
        labels=labels,
        words=words_of(tables),
        sentence=sentence,
        bibtex=bibtex,
        **sides,
    )


# -- sides -------------------------------------------------------------------------------------------------------


def _sides(source: FigureSource, pictures_of: PicturesBySubject) -> dict[str, Any]:
    """Return the parts of the page that only sides have, such as success, episodes and answers."""
    table = source.table
    modes = modes_of(table.all_rows)
    warnings_of_run: dict[tuple[str | None, str], list[tuple[str, str]]] = {}
    further_views = []
    for mean in table.means:
        rows = [row for row in table.rows if (*row.key, row.view) == (*mean.key, mean.view)]
        if mean.key in warnings_of_run:  # another view of the same run came first; the summary is of that one
            sentences = [f"{title_of(row.category)}: {conclusion(row)}" for row in rows]
            further_views.append((f"{model_name(mean)}, view {mean.view}", sentences))
        else:
            warnings_of_run[mean.key] = [(model_name(mean), sentence) for sentence in warnings_of(mean, rows)]
    tables: dict[str, list[Table]] = {subject: [] for subject in SUBJECTS.values()}
    for title, part in table.tables().items():
        tables[SUBJECTS[title]].append(part)
    joins = source.joins
    return {
        "modes": modes,
        "answered": _ANSWERED[modes],
        "did": "What it answers" if modes == "answers" else "What it does",
        "reached": "What reaches the answer" if modes == "answers" else "What reaches the action",
        "curve": next((pictures[0] for pictures in pictures_of.get(_OPENING, ())), None),
        "further_views": further_views,
        "warnings": [warning for of_run in warnings_of_run.values() for warning in of_run],
        "tables": tables,
        "wordings": table.wording_tables,
        "further": table.further_tables,
        "joined": [part for join in joins.tables for part in known_used_tables(join)],
        "join_notes": [*joins.refused, *dict.fromkeys(note for join in joins.tables for note in join.notes)],
        "pictures": {
            subject: pictures_of.get(subject, []) for subject in ("behaviour", "probes", "retention", "join")
        },
        "heat": heat_key(),
    }


def opening_row(source: FigureSource) -> tuple[RetentionRow, DrawnRun] | None:
    """Return the category to open with, and its run: one that the backbone holds and the action does not, if any.

    Among runs with probes the first category with signal is next, and then the first at all; None without rows.
    """
    drawn_of = {drawn.of_table.location: drawn for drawn in source.runs}
    rows = [category.row for run in source.table.summary for category in run.categories]
    rows = [row for row in rows if row.run.location in drawn_of]
    probed = [row for row in rows if row.backbone.score is not None]
    encoded = [row for row in probed if row.backbone.has_signal]
    lost = [row for row in encoded if not row.action.has_signal]
    return next(((row, drawn_of[row.run.location]) for row in (*lost, *encoded, *probed, *rows)), None)


def _question(row: RetentionRow, name: str, grid: EpisodeGrid) -> Mapping[str, Any] | None:
    """Return the first episode of the row's category with a picture, of this run by its name; None without one.

    The result holds its card, its picture as a data URI, and its outcome in words.
    """
    for card in grid.cards:
        if card["run"] == name and card["category"] == row.category and card["picture"] is not None:
            outcome = (_ANSWERS if card["asked"] else _OUTCOMES).get(card["outcome"], "it was captured only")
            answer = f": {card['answer']}" if card["answer"] else ""
            frames = "First frame" if card["frames"] == 1 else "First and last frame"
            caption = f"{frames}. The correct picture lies {_SIDES[card['side']]}{answer}; {outcome}."
            return {"card": card, "source": f"data:image/webp;base64,{grid.picture(card)}", "caption": caption}
    return None


def _opening_curves(
    opening: tuple[RetentionRow, DrawnRun] | None, iterations: Iterations
) -> Iterator[ReportFigure]:
    """Yield a figure of accuracy by layer of the row's category; nothing where it was not probed."""
    if opening is None:
        return
    row, drawn = opening
    if drawn.results is None or row.backbone.score is None:
        return
    display = LayerCurveDisplay.from_results(drawn.results, row.category, row.view, best_of(iterations))
    yield ReportFigure(
        "opening", f"Where the answer can be read: {display.title}", _OPENING,
        "How often a linear probe names the side of the correct picture, by layer: in the backbone, and where the "
        f"{'answer' if row.run.mode == 'answers' else 'action'} is made. {ONLY_FILLED}.",
        drawn.position, partial(_together, display),
    )  # fmt: skip


def _together(display: LayerCurveDisplay) -> "Figure":
    """Draw all streams on the same axes, with a legend and no more."""
    figure, (axes,) = panels(1, 4.7, 2.0)
    display.plot(axes)
    axes.set_title("", loc="left")
    axes.set_ylabel(display.measure, fontsize=8.5)
    legend_above(figure, axes.get_legend_handles_labels()[0])
    caption(figure, *display.certificates)
    return figure


# -- labels ------------------------------------------------------------------------------------------------------


def _labels(
    table: RetentionTable,
    runs: Sequence[RunReader],
    names: Sequence[str],
    pictures_of: PicturesBySubject,
    of_run: str = "",
) -> list[dict[str, Any]]:
    """Return a section per label of the table.

    A section holds the label's rows of the table and their sentences, and its figures. It also holds the best
    sites with their controls, a table per run, and sentences on the probes.

    Args:
        table: A retention table of labels.
        runs: Runs of the table.
        names: The name of each run.
        pictures_of: Figures by subject, see `arrange_figures`.
        of_run: Name of the run where sections are of a single one.
    """
    sections: list[dict[str, Any]] = []
    for target in table.targets:
        of_target = table.of_target(target)
        probes = {name: table.results[str(run.location), target] for name, run in zip(names, runs, strict=True)}
        several = len(probes) > 1
        section = {
            "target": target,
            "run": of_run,
            "measured": _describe_metric(next(iter(probes.values()))),
            "retention": of_target.tables()["Retention"],
            "sentences": [category.details for run in of_target.summary for category in run.categories],
            "pictures": pictures_of.get(target, []),
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
    runs: Sequence[RunReader], names: Sequence[str], paths: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Return a section per run and label column of which the run has probes; none for other runs."""
    sections = []
    for run, name in zip(runs, names, strict=True):
        if targets := list(stored_targets(run)):
            table = retention_table([run], target=targets)
            pictures_of = arrange_figures(FigureSource.of([run], table).figures(), [name], paths)
            sections += _labels(table, [run], [name], pictures_of, name if len(runs) > 1 else "")
    return sections


def _describe_metric(results: ProbeResults) -> str:
    settings, curve = results.settings, next(iter(results.curves.values()))
    classes = f" of {len(curve.classes)} classes" if settings.task == "classes" else ""
    return f"A {_TASKS[settings.task]} label{classes}; the score is {METRICS[settings.task]}."


# -- pictures and the template -----------------------------------------------------------------------------------


_HERE = Path(__file__).parent
_ASSETS = {"css": "page.css", "js": "page.js", "episodes_js": "episodes.js"}


def render(template: str, paths: tuple[str, ...], **content: Any) -> str:
    """Return the page; no text in it holds `paths` or another absolute path of this machine."""
    from markupsafe import Markup

    assets = {name: Markup((_HERE / file).read_text(encoding="utf-8")) for name, file in _ASSETS.items()}
    return environment(_HERE, paths=paths).get_template(template).render(**assets, **content)


SVG_LIMIT = 150_000
"""Bytes of an SVG above which a figure is kept as pixels."""
PIXELS_PER_INCH = 200
"""Resolution of figures that are kept as pixels."""
_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_ROUNDED = ("d", "x", "y")
"""Attributes in points, of which a hundredth cannot be seen."""
_FONTS = re.compile(r"'[^;]*sans-serif")
"""The fonts of a text, the first of them matplotlib's; a page has those of the machine that shows it."""
_IN_URI = " !$'()*+,-./:;=?@[]_`{|}~"
"""Characters that a URI in double quotes may hold as they are."""


def arrange_figures(
    figures: Sequence[ReportFigure], names: Sequence[str], paths: tuple[str, ...] = ()
) -> PicturesBySubject:
    """Draw figures, by subject and kind.

    Tables are left out, which the page prints as such. All but the first of a kind and run are extra, to be
    unfolded. Figures of single runs that another figure shows side by side are extra too.

    Args:
        figures: Figures of all runs.
        names: The name of each run.
        paths: Paths that are shortened in texts, see `data_uri`.
    """
    subjects: dict[str, dict[str, list[PageFigure]]] = {}
    together = {(figure.subject, _kind(figure)) for figure in figures if figure.run is None}
    for figure in figures:
        by_title = subjects.setdefault(figure.subject, {})
        run = "" if figure.run is None else names[figure.run]
        kind = _kind(figure)
        before = [other for pictures in by_title.values() for other in pictures]
        extra = any(other.run == run and other.title.partition(",")[0] == kind for other in before)
        extra |= figure.run is not None and (figure.subject, f"{kind} side by side") in together
        picture = PageFigure(figure.title, run, figure.reading, *data_uri(figure, paths), extra)
        by_title.setdefault(figure.title, []).append(picture)
    return {subject: list(by_title.values()) for subject, by_title in subjects.items()}


def _kind(figure: ReportFigure) -> str:
    """Return the title before the first comma, which the category or the view follows."""
    return figure.title.partition(",")[0]


def data_uri(report_figure: ReportFigure, paths: tuple[str, ...] = ()) -> tuple[str, str]:
    """Return the drawn figure as SVG, or WebP if that would be large, with its caption.

    A figure gives the same bytes every time. Its ground is transparent, so that the page's colour shows through.
    Of `paths` and other absolute paths in its words the last part is left.

    Args:
        report_figure: The figure that is drawn.
        paths: Absolute paths of runs.
    """
    import matplotlib as mpl
    from matplotlib.text import Text

    with (
        report_figure.drawn() as figure,
        mpl.rc_context({"svg.hashsalt": "probe_kit", "svg.fonttype": "none", "savefig.transparent": True}),
    ):
        for words in figure.findobj(Text):
            words.set_text(without_folders(words.get_text(), paths))
        file = BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
        svg = compact_svg(file.getvalue())
        if len(svg) <= SVG_LIMIT:
            return f"data:image/svg+xml,{quote(svg, safe=_IN_URI)}", caption_of(figure)
        file = BytesIO()
        pixels = {"lossless": True, "method": 6}
        figure.savefig(file, format="webp", dpi=PIXELS_PER_INCH, pil_kwargs=pixels)
        return encode("image/webp", file.getvalue()), caption_of(figure)


def encode(kind: str, content: bytes) -> str:
    """Return a data URI of bytes of some media type."""
    return f"data:{kind};base64,{b64encode(content).decode()}"


def compact_svg(svg: bytes) -> bytes:
    """Return the same drawing without metadata, comments, line breaks, unused names and fine decimals."""
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _XLINK)
    root = ElementTree.fromstring(svg)
    for metadata in root.findall(f"{{{_SVG}}}metadata"):
        root.remove(metadata)
    used = set(re.findall(r"#([\w-]+)", svg.decode()))
    for element in root.iter():
        element.text, element.tail = ((text or "").strip() or None for text in (element.text, element.tail))
        if element.get("id") not in used:
            element.attrib.pop("id", None)
        for name in _ROUNDED:
            if name in element.attrib:
                element.set(name, _round_path(element.attrib[name]))
        if "style" in element.attrib:
            element.set("style", _FONTS.sub("sans-serif", element.attrib["style"]))
    return ElementTree.tostring(root)


def _round_path(numbers: str) -> str:
    """Return the numbers and letters of a path, of two decimals each and without needless spaces."""
    short = re.sub(r"-?\d+\.\d+(?!e)", lambda match: f"{float(match[0]):.2f}".rstrip("0").rstrip("."), numbers)
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", re.sub(r"\s+", " ", short)).strip()


# -- origin of numbers -------------------------------------------------------------------------------------------

PAPER = "arXiv:2606.19297"


def provenance(name: str, run: RunReader, results: Sequence[ProbeResults]) -> dict[str, Any]:
    """Return the origin of a run's numbers and its probes; runs that were not made by probe_kit have less of it.

    The result holds its name, its line, facts by name, and documents by name as pretty JSON.
    """
    settings, certificate = run.settings, run.certificate
    facts = {
        "run": run.label,
        "model": run.model,
        "weights": "random: untrained" if run.random_weights else "",
        "weights sha256": run.weights_sha256 or "none (scripted)",
        "suite": run.suite,
        "episodes": str(len(run.episodes)),
        "streams": "; ".join(_stream(run, stream) for stream in run.streams) or "none",
        **_protocol(settings),
        "run settings sha256": run.settings_sha256,
        # Empty for a script, which has no hooks; a line without text is not shown.
        "hooks on equals hooks off": {True: "yes, bit for bit", None: ""}.get(
            certificate.get("hooks_on_equals_hooks_off"), "no"
        ),
        "mixed": ", ".join(run.mixed),
        **({f"probes{_describe_target(probes)}": probes.key for probes in results} or {"probes": "none"}),
    }
    documents = {"run settings": settings, "certificate": certificate}
    documents |= {
        f"probe settings{_describe_target(probes)}": {
            "key": probes.key,
            "created": probes.created,
            **asdict(probes.settings),
        }
        for probes in results
    }
    return {
        "name": name,
        "line": ProvenanceLine.of_run(run).line,
        "facts": [(key, value) for key, value in facts.items() if value],
        "documents": [
            (key, json.dumps(value, indent=2, ensure_ascii=False)) for key, value in documents.items() if value
        ],
    }


def _protocol(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the protocol of a run, its differences from the default, and the run's deviations from it."""
    protocol = settings.get("protocol")
    if not protocol:
        return {}
    return {
        "protocol": protocol["name"],
        "deviates from it in": _list_pairs(protocol["deviations"]) or "nothing",
        "it differs from the default in": _list_pairs(
            {name: pair[::-1] for name, pair in protocol["differs_from_default"].items()}
        ),
        "of it cannot be matched": "; ".join(protocol["unmatched"]),
    }


def _list_pairs(pairs: Mapping[str, Sequence[str | None]]) -> str:
    changes = (f"{name} {now or 'nothing'} instead of {was or 'nothing'}" for name, (was, now) in pairs.items())
    return "; ".join(changes)


def citation(runs: Sequence[RunReader]) -> tuple[str, str]:
    """Return a sentence for a methods section, and BibTeX; of the protocol only for runs of its scene."""
    lines = "; ".join(ProvenanceLine.of_run(run).line.replace(" · ", ", ") for run in runs)
    of_scene = any(SIDE in run.episodes for run in runs)
    protocol = f" under the Act2Answer protocol ({PAPER})" if of_scene else ""
    asked_alone = all(run.ask is not None for run in runs)
    shares = "Accuracies of answers about" if asked_alone else "Success rates from"
    limits = f" {shares} a PyBullet scene are comparable with each other, not with those of other simulators."
    sentence = f"Evaluated with probe_kit {__version__}{protocol}: {lines}.{limits if of_scene else ''}"
    software = (
        "@software{probe_kit,\n"
        "  title   = {probe\\_kit: where a Vision-Language-Action model knows the answer, and where it is lost},\n"
        f"  version = {{{__version__}}},\n"
        "  license = {Apache-2.0}\n}"
    )
    paper = (
        "\n\n@misc{act2answer,\n"
        "  title         = {Does {VLA} Even Know the Basics?},\n"
        "  eprint        = {2606.19297},\n"
        "  archivePrefix = {arXiv}\n}"
    )
    return sentence, software + (paper if of_scene else "")


def _stream(run: RunReader, name: str) -> str:
    stream = run.streams[name]
    steps = f" × {stream.iterations} iterations" if stream.iterations else ""
    return f"{name} {stream.layers} layers{steps}, width {stream.width}"


def _describe_target(probes: ProbeResults) -> str:
    return "" if probes.settings.balanced else f" of {probes.settings.target}"


# -- glossary ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Words:
    """The glossary of a page: words of its tables, each with an anchor such as `word-7` that cells link to.

    Attributes:
        entries: Name, meaning and anchor of each word, by the title of the table.
        headings: The anchor of a column's word and meaning; two tables may give a word two meanings.
        values: The anchor of a cell's text that is a word.
    """

    entries: Mapping[str, tuple[tuple[str, str, str], ...]]
    headings: Mapping[tuple[str, str], str]
    values: Mapping[str, str]


def words_of(tables: Sequence[Table]) -> Words:
    """Return the words of all columns of `tables` and of the verdicts in them, and terms that are neither."""
    cells = {cell.value_text for table in tables for row in table.rows for cell in row.cells}
    groups: dict[str, dict[tuple[str, str], None]] = {}
    for table in tables:
        title = re.split("[:,]", table.title)[0]
        entries_of = {(column.text, column.help): None for column in table.headings if column.help}
        groups.setdefault(title, {}).update({word: None for word in entries_of if word not in _all(groups)})
    words = {_word(cell) for cell in cells}
    groups["Verdicts"] = {(name, text): None for name, text in VERDICT_HELP.items() if name in words}
    groups["Further terms"] = {word: None for word in TERMS.items() if word not in _all(groups)}
    anchors = {word: f"word-{number}" for number, word in enumerate(_all(groups))}
    entries = {
        title: tuple((*word, anchors[word]) for word in entries_of)
        for title, entries_of in groups.items()
        if entries_of
    }
    of_values = {
        name: anchor for (name, text), anchor in anchors.items() if (VERDICT_HELP | TERMS).get(name) == text
    }
    return Words(entries, anchors, {cell: of_values[_word(cell)] for cell in cells if _word(cell) in of_values})


def _word(cell: str) -> str:
    """Return a verdict without direction, side and bound: `used` of `against: used (left)`."""
    return cell.removeprefix("against: ").partition(" (")[0]


def _all(groups: Mapping[str, Mapping[tuple[str, str], None]]) -> list[tuple[str, str]]:
    return [word for of_table in groups.values() for word in of_table]
