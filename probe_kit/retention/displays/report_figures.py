"""All figures that fit a table of runs: what `probe-kit retention --figures` saves and the report shows.

Every module of this folder with a function `report_figures` takes part in tables of sides, and with a function
`label_figures` in tables of labels; its constant `PLACE` orders the figures.
"""

from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.retention.columns.text import model_name
from probe_kit.retention.displays.base.report_figure import (
    DrawnRun,
    FigureSource,
    ReportFigure,
    file_names,
)
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".pdf")


def collect_figures(runs: Sequence[RunReader], table: RetentionTable) -> list[ReportFigure]:
    """Return every figure that the runs and their table allow, those of all runs first. Nothing is drawn yet.

    Of labels one after the other; `subject` is the label. Raises UsageError for a run that the table was not made
    of.
    """
    called = {row.run.location: model_name(row) for row in table.rows}
    if strangers := [str(run.location) for run in runs if str(run.location) not in called]:
        raise UsageError(f"the table has no rows of {', '.join(strangers)}; make it of the runs that are drawn")
    stems = run_names(runs)
    if table.is_of_sides:
        probes = [
            (at, stem, table.results_of(run.location))
            for at, (run, stem) in enumerate(zip(runs, stems, strict=True))
        ]
    else:
        labels = dict(zip(table.targets, file_names(table.targets), strict=True))
        probes = [
            (at, f"{stem}-{label}", table.results[str(run.location), target])
            for target, label in labels.items()
            for at, (run, stem) in enumerate(zip(runs, stems, strict=True))
        ]
    drawn = tuple(
        DrawnRun(runs[at], stem, called[str(runs[at].location)], at, results) for at, stem, results in probes
    )
    source = FigureSource(table, drawn)
    figures = [figure for make in _makers(table.is_of_sides) for figure in make(source)]
    order = {target: at for at, target in enumerate(table.targets)}
    return sorted(
        figures, key=lambda figure: (order.get(figure.subject, 0), -1 if figure.run is None else figure.run)
    )


def _makers(of_sides: bool) -> list[Callable[[FigureSource], Iterator[ReportFigure]]]:
    """Return the functions of the modules of this folder that make figures, in the order of their `PLACE`."""
    names = [file.name for file in iter_modules(import_module(__package__).__path__) if not file.ispkg]
    modules = [import_module(f"{__package__}.{name}") for name in names]
    name = "report_figures" if of_sides else "label_figures"
    makers = [module for module in modules if hasattr(module, "PLACE") and hasattr(module, name)]
    return [getattr(module, name) for module in sorted(makers, key=lambda module: module.PLACE)]


def save_figures(exhibits: Sequence[ReportFigure], folder: Path) -> Iterator[Path]:
    """Draw exhibits into `folder` as PNG and PDF, one after the other; gives the path of every PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for exhibit in exhibits:
        path = folder / f"{exhibit.name}{SUFFIXES[0]}"
        with exhibit.drawn() as figure:
            for suffix in SUFFIXES:
                figure.savefig(path.with_suffix(suffix), metadata=_metadata(suffix, exhibit, caption_of(figure)))
        yield path


def caption_of(figure: "Figure") -> str:
    """Return the whole line under a figure; its footer holds the beginning."""
    return str(getattr(figure, "caption", ""))


def _metadata(suffix: str, exhibit: ReportFigure, caption: str) -> dict[str, str | None]:
    """The caption goes with the file, in what readers of its format show of it."""
    if suffix == ".pdf":
        # Without its date a figure of the same numbers has the same bytes.
        return {"Title": exhibit.title, "Subject": f"{caption}. {exhibit.reading}", "CreationDate": None}
    return {"Title": exhibit.title, "Description": f"{caption}. {exhibit.reading}"}


def run_names(runs: Sequence[RunReader]) -> list[str]:
    """Names of the runs; a name that comes again is numbered."""
    names: list[str] = []
    for run in runs:
        name = run.location.name
        count = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{count + 1}" if name in names else name)
    return names
