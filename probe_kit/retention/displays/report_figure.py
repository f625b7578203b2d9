"""The figures of reports and of `--figures`: each with its explanation, and which of them fit a table."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from inspect import isfunction
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, Literal, Self

from probe_kit.retention.behaviour import TableRun
from probe_kit.retention.compare.known_used import Joins, join_runs
from probe_kit.retention.displays.display import SIGNAL
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import EVERYWHERE
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ONLY_FILLED = f"Only filled markers are evidence: {SIGNAL}"
DOTS = f"Dots mark evidence: {SIGNAL}"


@dataclass(frozen=True)
class DrawnRun:
    """A run of a table; of labels, a run with one label each.

    Attributes:
        of_table: The run in the form that the table reads.
        stem: Beginning of its files' names.
        position: Position among the runs.
        results: Its probes, None without any.
    """

    of_table: TableRun
    stem: str
    position: int
    results: ProbeResults | None

    @property
    def run(self) -> RunReader:
        """The run with its outcomes as they were stored."""
        return self.of_table.run

    @property
    def judged(self) -> RunReader | None:
        """The run with its outcomes by the table's rule; None without any."""
        return self.of_table.judged if self.of_table.is_judged else None

    @property
    def name(self) -> str:
        """Its name in legends."""
        return self.of_table.name


@dataclass(frozen=True)
class FigureSource:
    """The table and the runs that figures of a report are made of.

    Attributes:
        table_runs: Every run of the table once.
        runs: The same runs, label by label.
    """

    table: RetentionTable
    table_runs: tuple[TableRun, ...]
    runs: tuple[DrawnRun, ...]

    @classmethod
    def of(cls, runs: Sequence[RunReader], table: RetentionTable) -> Self:
        """Read runs of a table, label by label.

        Raises:
            UsageError: For a run that the table has no rows of.
        """
        table_runs = table.runs_of(runs)
        numbered = list(enumerate(zip(table_runs, file_names([run.location.name for run in runs]), strict=True)))
        if not table.labels:
            drawn = [DrawnRun(run, stem, at, table.results_of(run.location)) for at, (run, stem) in numbered]
        else:
            labels = dict(zip(table.targets, file_names(table.targets), strict=True))
            drawn = [
                DrawnRun(run, f"{stem}-{label}", at, table.results[run.location, target])
                for target, label in labels.items()
                for at, (run, stem) in numbered
            ]
        return cls(table, tuple(table_runs), tuple(drawn))

    @cached_property
    def joins(self) -> Joins:
        """Answer, probe and success of every pair of a VLM run and a policy run."""
        return join_runs(self.table_runs, self.table.results)

    def figures(self) -> "list[ReportFigure]":
        """Return every figure that the runs and their table allow, those of all runs first. Nothing is drawn yet.

        Figures of labels come one label after the other; their `subject` is the label.
        """
        figures = [figure for make in _makers("labels" if self.table.labels else "sides") for figure in make(self)]
        order = {target: at for at, target in enumerate(self.table.targets)}
        return sorted(
            figures, key=lambda figure: (order.get(figure.subject, 0), -1 if figure.run is None else figure.run)
        )


@dataclass(frozen=True)
class ReportFigure:
    """A figure that can be drawn.

    Attributes:
        name: File stem.
        subject: The numbers that it shows, such as `behaviour` or `probes`.
        reading: Explanation of the figure, in plain language.
        run: Its position among the runs, None if it shows all of them.
        draw: Makes the figure.
        is_detail: Whether the main figures can be read without it.
    """

    name: str
    title: str
    subject: str
    reading: str
    run: int | None
    draw: "Callable[[], Figure]"
    is_detail: bool = False

    @contextmanager
    def drawn(self) -> "Iterator[Figure]":
        """Yield the figure and close it afterwards, so that pyplot keeps none of many."""
        from matplotlib import pyplot as plt

        figure = self.draw()
        try:
            yield figure
        finally:
            plt.close(figure)


Maker = Callable[[FigureSource], Iterator[ReportFigure]]


def in_report(rank: int, *targets: Literal["sides", "labels"]) -> Callable[[Maker], Maker]:
    """Mark a function that yields figures of reports and `--figures`.

    Args:
        rank: Its place in the order of the figures.
        *targets: The tables that it draws, those of sides by default.
    """

    def mark(make: Maker) -> Maker:
        vars(make).update(rank=rank, targets=targets or ("sides",))
        return make

    return mark


def figure_of(read: Callable[..., Any], *arguments: Any) -> "Figure":
    """Return the figure of a display that draws on axes of its own.

    Args:
        read: Makes the display from the arguments.
        *arguments: Arguments of `read`.
    """
    from matplotlib.figure import Figure

    figure = read(*arguments).plot().ax_.figure
    assert isinstance(figure, Figure)
    return figure


def in_view(title: str, view: str, views: Sequence[str]) -> str:
    """Return the title, with the view where there are several."""
    return f"{title}, view {view}" if len(views) > 1 else title


def view_suffix(view: str, views: Sequence[str]) -> str:
    """Return the end of a file's name; the first view needs none."""
    return "" if view == views[0] else f"-{view.replace(':', '-')}"


# -- probes of a run in a view -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ProbedView:
    """The probes of a run in one view: of all categories of a side, or of a label in one category."""

    drawn: DrawnRun
    results: ProbeResults
    view: str
    category: str | None

    @property
    def curve(self) -> ProbeCurve:
        """The probes of its category, or of the first one."""
        return self.results.curves[self.category or self.results.settings.categories[0], self.view]

    def figure(
        self,
        name: str,
        title: str,
        reading: str,
        draw: "Callable[..., Figure]",
        *more: Any,
        is_detail: bool = False,
    ) -> ReportFigure:
        """Return a figure of these probes for a report; those of other views than the first are details.

        Args:
            name: Name of the figure in file names.
            title: Title without the view.
            reading: Explanation of the figure, in plain language.
            draw: Makes the figure from results, view and `more`.
            *more: Further arguments of `draw`.
            is_detail: Whether the main figures can be read without it.
        """
        settings = self.results.settings
        views = settings.views
        category = self.category or EVERYWHERE
        of_category = "" if category == EVERYWHERE else f"-{file_names([category])[0]}"
        return ReportFigure(
            f"{self.drawn.stem}{of_category}-{name}{view_suffix(self.view, views)}",
            in_view(title, self.view, views), "probes" if settings.balanced else settings.target, reading,
            self.drawn.position, partial(draw, self.results, self.view, *more),
            is_detail=is_detail or self.view != views[0],
        )  # fmt: skip


def probed_views(source: FigureSource) -> Iterator[ProbedView]:
    """Yield the probed views of each run; of labels the categories and views of the rows, label by label."""
    for drawn in source.runs:
        results = drawn.results
        if results is None:
            continue
        if results.settings.balanced:
            for view in results.settings.views:
                yield ProbedView(drawn, results, view, None)
            continue
        for row in source.table.rows:
            if (row.target, row.run.location) == (results.settings.target, str(drawn.run.location)):
                yield ProbedView(drawn, results, row.view or "", row.category)


def file_names(texts: Sequence[str]) -> list[str]:
    """Return folders of runs, or label columns, as parts of file names, no two alike."""
    names: list[str] = []
    for text in texts:
        name = re.sub(r"[^\w.-]+", "-", text).strip(".-") or "label"
        tries = (name, *(f"{name}-{number}" for number in range(2, len(texts) + 1)))
        used = {other.casefold() for other in names}
        names.append(next(free for free in tries if free.casefold() not in used))
    return names


SUFFIXES = (".png", ".pdf")


def collect_figures(runs: Sequence[RunReader], table: RetentionTable) -> list[ReportFigure]:
    """Return the figures of runs, see `FigureSource.figures`.

    Raises:
        UsageError: For a run that has no rows in the table.
    """
    return FigureSource.of(runs, table).figures()


def _makers(target: str) -> list[Maker]:
    """Return the functions of this folder that `in_report` marks, in their order."""
    makers: dict[Maker, int] = {}
    for file in iter_modules(import_module(__package__).__path__):
        functions = filter(isfunction, vars(import_module(f"{__package__}.{file.name}")).values())
        makers |= {make: vars(make)["rank"] for make in functions if target in vars(make).get("targets", ())}
    return sorted(makers, key=makers.__getitem__)


def save_figures(figures: Sequence[ReportFigure], folder: Path) -> Iterator[Path]:
    """Draw figures into `folder` as PNG and PDF, one after the other; yield the path of every PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for report_figure in figures:
        path = folder / f"{report_figure.name}{SUFFIXES[0]}"
        with report_figure.drawn() as figure:
            for suffix in SUFFIXES:
                figure.savefig(
                    path.with_suffix(suffix), metadata=_metadata(suffix, report_figure, caption_of(figure))
                )
        yield path


def caption_of(figure: "Figure") -> str:
    """Return the whole line under a figure; its footer holds the beginning."""
    return str(getattr(figure, "caption", ""))


def _metadata(suffix: str, report_figure: ReportFigure, caption: str) -> dict[str, str | None]:
    """Return the caption as metadata of the file, under the keys that readers of its format show."""
    if suffix == ".pdf":
        # Without its date a figure of the same numbers has the same bytes.
        return {
            "Title": report_figure.title,
            "Subject": f"{caption}. {report_figure.reading}",
            "CreationDate": None,
        }
    return {"Title": report_figure.title, "Description": f"{caption}. {report_figure.reading}"}
