"""All figures of a table of labels: what `retention --target --figures` saves and the report shows."""

import re
from collections.abc import Iterator, Sequence
from functools import partial

from probe_kit.errors import UsageError
from probe_kit.retention.displays.base.report_figure import ONLY_FILLED, ReportFigure, in_view, view_suffix
from probe_kit.retention.displays.labels.class_confusion import class_confusions
from probe_kit.retention.displays.labels.label_curve import label_curves
from probe_kit.retention.displays.labels.predicted_values import predicted_values
from probe_kit.retention.displays.labels.step_scores import step_scores
from probe_kit.retention.displays.report_figures import run_names
from probe_kit.retention.labels.table import LabelRetentionTable
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.probe_results import ProbeResults


def label_figures(runs: Sequence[RunReader], table: LabelRetentionTable) -> list[ReportFigure]:
    """The figures of every label, run and view of a table, label by label; `subject` is the label.

    Nothing is drawn yet. Raises UsageError for a run that the table was not made of.
    """
    locations = {location for location, _ in table.results}
    if strangers := [str(run.location) for run in runs if str(run.location) not in locations]:
        raise UsageError(f"the table has no rows of {', '.join(strangers)}; make it of the runs that are drawn")
    stems = file_names(table.targets)
    return [
        figure
        for target, of_label in zip(table.targets, stems, strict=True)
        for position, (run, of_run) in enumerate(zip(runs, run_names(runs), strict=True))
        for category, view in _places(table, run, target)
        for figure in _of_view(
            table.results[str(run.location), target], category, view, f"{of_run}-{of_label}", position, target
        )
    ]


def _places(table: LabelRetentionTable, run: RunReader, target: str) -> list[tuple[str, str]]:
    """Categories and views of the table's rows."""
    of_run = (row.retention for row in table.rows if row.location == str(run.location))
    return [(estimate.category, estimate.view) for estimate in of_run if estimate.target == target]


def file_names(targets: Sequence[str]) -> list[str]:
    """Label columns as parts of file names, no two alike."""
    names: list[str] = []
    for target in targets:
        name = re.sub(r"[^\w.-]+", "-", target).strip(".-") or "label"
        tries = (name, *(f"{name}-{number}" for number in range(2, len(targets) + 1)))
        used = {other.casefold() for other in names}
        names.append(next(free for free in tries if free.casefold() not in used))
    return names


def _of_view(
    results: ProbeResults, category: str, view: str, stem: str, position: int, target: str
) -> Iterator[ReportFigure]:
    views, curve = results.settings.views, results.curves[category, view]
    stem += "" if category == "all" else f"-{file_names([category])[0]}"
    suffix = view_suffix(view, views)
    yield ReportFigure(
        f"{stem}-layer-curves{suffix}", in_view("Layer curves", view, views), target,
        "How well a linear probe decodes the label in groups it has not seen, layer by layer, with 95 % intervals "
        f"over groups. {ONLY_FILLED}. Grey: what the same probes reach with labels exchanged between groups. "
        "Dotted: the best control.",
        position, partial(label_curves, results, view, category), is_detail=view != views[0],
    )  # fmt: skip
    if curve.steps.size > 1:
        yield ReportFigure(
            f"{stem}-steps{suffix}", in_view("Score by step", view, views), target,
            "The same by inference, at the best site of each part, beside controls. Classes are balanced among "
            "those of the step. A step of one class is easy, so compare with the controls at that step.",
            position, partial(step_scores, results, view, category), is_detail=view != views[0],
        )  # fmt: skip
    if curve.classes:
        yield ReportFigure(
            f"{stem}-confusion{suffix}", in_view("Confusion matrix", view, views), target,
            "Which class the best site of each part predicts for which, in groups it has not seen. Each row sums "
            "to 100 %; the mean of the diagonal is the balanced accuracy.",
            position, partial(class_confusions, results, view, category), is_detail=view != views[0],
        )  # fmt: skip
    else:
        yield ReportFigure(
            f"{stem}-predicted{suffix}", in_view("Predicted against true", view, views), target,
            "A point per sample, predicted by the best site of each part in groups it has not seen. Colours are "
            "groups. Predictions are clipped to the range of the training labels.",
            position, partial(predicted_values, results, view, category), is_detail=view != views[0],
        )  # fmt: skip
