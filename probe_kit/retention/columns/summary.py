"""The summary: a row and a sentence per category, the same in every format."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from probe_kit._tables.numbers import Limits, number, points, signed, whole, with_limits
from probe_kit._tables.table import Cell, Heading, Row, Table
from probe_kit.intervene.results.verdict import describe_readouts
from probe_kit.retention.columns.findings import finding
from probe_kit.retention.columns.sentences import chance_only, describe_category, knows, verdict
from probe_kit.retention.columns.text import (
    P_DECIDES,
    by_run,
    difference_test,
    is_vlm,
    model_name,
    models_p,
    title_of,
)
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.parts import StreamPart
from probe_kit.retention.rows.row import MEAN, RetentionRow

MARK = "✓"
"""After a share: the stream exceeds chance and a control, or the regime of the behaviour is knowledge."""
_LEGENDS = {
    "VLM %": "VLM: share of its answers that are right; its name ends on the prompt and the size of the picture",
    "backbone %": "Backbone: accuracy of probes in the backbone, at sites that other questions chose",
    "action %": "Action: the same at the action's sites",
    "success %": "Success: the cube ends on the correct picture",
    "retention": "Retention: share of the backbone's signal left in the action",
}
"""What a column shows."""
_TESTS = {
    "p (Holm)": "p: exact, of a difference in success or answers, (corrected for all categories and pairs); "
    f"{P_DECIDES}",
    "p over models (least)": "p over models: exact, models as the unit (the least that so few models allow)",
}
"""What a column of differences shows."""
HEADING_HELP = {
    heading: f"{meaning[:1].upper()}{meaning[1:]}."
    for heading, legend in (_LEGENDS | _TESTS).items()
    for meaning in [legend.partition(": ")[2]]
} | {"verdict": "What all numbers of the category say together."}
"""The same as entries of the glossary."""


@dataclass(frozen=True)
class CategorySummary:
    """One category of a policy, or of a VLM alone. asked: the VLM's row of the same category."""

    row: RetentionRow
    asked: RetentionRow | None = None

    @property
    def name(self) -> str:
        """The category as it is spelt at the beginning of a sentence."""
        return title_of(self.row.category)

    @property
    def cells(self) -> tuple[str, ...]:
        """What stands under `HEADINGS`."""
        row, asked = self.row, self.row if is_vlm(self.row) else self.asked
        acts = None if is_vlm(row) else row
        return (
            "–" if asked is None else _share(asked.success.sr, asked.success.ci, knows(asked)),
            _share(row.backbone.score, row.backbone.ci, _is_marked(row.backbone)),
            _share(row.action.score, row.action.ci, _is_marked(row.action)),
            "–" if acts is None else _share(acts.success.sr, acts.success.ci, knows(acts)),
            _retention(row),
            "" if row.category == MEAN else str(verdict(row)),
        )

    @property
    def finding(self) -> str:
        """The finding in one short sentence, to be set behind the category's name."""
        return finding(self.row, self.asked)

    @property
    def details(self) -> str:
        """The finding with all its numbers, their uncertainty and the number of items."""
        return f"{self.name} {describe_category(self.row, self.asked)}"


HEADINGS = ("VLM %", "backbone %", "action %", "success %", "retention", "verdict")


def _is_marked(part: StreamPart) -> bool:
    return part.has_signal and part.is_controlled


def _share(value: float | None, limits: Limits | None, marked: bool) -> str:
    text = with_limits(value, limits, whole)
    return f"{text} {MARK}" if marked and value is not None else text


def _retention(row: RetentionRow) -> str:
    if row.backbone.score is None or row.action.score is None:
        return "–"
    if not row.retention.defined:
        return "n/a"
    return with_limits(row.retention.value, row.retention.ci, number)


# -- runs --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunSummary:
    """A row and a sentence per category of a run. beside: the VLM that was asked the same questions, or empty."""

    run: str
    beside: str
    categories: tuple[CategorySummary, ...]
    mean: CategorySummary

    @property
    def title(self) -> str:
        """Whose summary it is."""
        return " · ".join(name for name in (self.run, self.beside) if name)

    @property
    def sentences(self) -> tuple[str, ...]:
        """One per category, all beginning at one column."""
        width = max(len(one.name) for one in self.categories)
        return tuple(f"{one.name.ljust(width)}  {one.finding}" for one in self.categories)


def summary_table(found: Sequence[RunSummary], differences: Sequence[Difference] = ()) -> Table:
    """A row per category and run, and the mean; below them the differences of runs. Empty columns are left out."""
    names = list(dict.fromkeys(one.row.category for run in found for one in run.categories))
    if any(len(run.categories) > 1 for run in found):
        names.append(MEAN)
    lines: list[Row] = []
    for name in names:
        for run in found:
            own = [one for one in (*run.categories, run.mean) if one.row.category == name]
            lines += [_row(name, run.run, (*one.cells, *[""] * len(_TESTS))) for one in own]
        for row in differences:
            if row.category == name:
                lines.append(_row(name, f"{row.group} − {row.minus}", _difference_cells(row), is_difference=True))
    headings = ("category", "run", *HEADINGS, *_TESTS)
    table = Table(
        title=f"Summary: {' · '.join(dict.fromkeys(run.title for run in found))}",
        headings=tuple(Heading(name, HEADING_HELP.get(name, "")) for name in headings),
        rows=tuple(lines),
        names=2,
        overflow="fold",
    )
    if len(found) < 2 and not differences:
        table = table.only([at for at in range(len(headings)) if at != 1])
    table = table.filled()
    legends = _LEGENDS | _TESTS
    legend = [legends[name] for name in table.columns if name in legends]
    readouts = describe_readouts(one.row.image_swap.use for run in found for one in run.categories)
    return replace(table, notes=(*legend, *filter(None, [readouts]), *_marks(found, table)))


def _row(category: str, run: str, cells: Sequence[str], is_difference: bool = False) -> Row:
    texts = (title_of(category), run, *cells)
    return Row(tuple(map(Cell, texts)), category == MEAN, is_difference)


def _marks(found: Sequence[RunSummary], table: Table) -> list[str]:
    """What the mark says where it stands, and a warning where it cannot stand because no control was run."""
    marked = any(MARK in text for line in table.texts for text in line)
    warning = chance_only([one.row for run in found for one in run.categories])
    return [f"{MARK} above chance, and above every control that was run"] * marked + [warning] * bool(warning)


def _difference_cells(row: Difference) -> tuple[str, ...]:
    sr, backbone, action = (
        with_limits(value, limits, points)
        for value, limits in ((row.sr, row.sr_ci), (row.backbone, row.backbone_ci), (row.action, row.action_ci))
    )
    answered, acted = (sr, "") if row.mode == "answers" else ("", sr)
    ratio = with_limits(row.retention, row.retention_ci, signed)
    over_models = "" if row.sr_models is None else models_p(row.sr_models)
    return answered, backbone, action, acted, ratio, "", "" if over_models else difference_test(row), over_models


def summarise_runs(all_rows: Sequence[RetentionRow]) -> list[RunSummary]:
    """One per run and group of a table's rows and means, by the first view of each.

    Policies have the answers of a VLM of their suite.
    A VLM has a summary of its own only where no policy of its suite is in the table.
    """
    rows = [row for row in all_rows if row.category != MEAN]
    means = [row for row in all_rows if row.category == MEAN]
    asked = [row for row in rows if is_vlm(row) and _asks_for_the_answer(row)]
    asked_means = {row.run.location: row for row in means if is_vlm(row)}
    policies = by_run([row for row in rows if not is_vlm(row)])
    beside = {row.run.suite for row in rows if not is_vlm(row)}
    alone = by_run([row for row in rows if is_vlm(row) and row.run.suite not in beside])
    mean_of = {(mean.key, mean.view): mean for mean in means}
    found = []
    for of_run in (*policies, *alone):
        own = [row for row in of_run if row.view == of_run[0].view]
        same = [row for row in asked if not is_vlm(own[0]) and row.run.suite == own[0].run.suite]
        first = {row.category: row for row in same if row.run.location == same[0].run.location}
        categories = tuple(CategorySummary(row, first.get(row.category)) for row in own)
        vlm_mean = asked_means.get(same[0].run.location) if same else None
        name = model_name(same[0]) if same else ""
        mean = CategorySummary(mean_of[own[0].key, own[0].view], vlm_mean)
        found.append(RunSummary(model_name(own[0]), name, categories, mean))
    return found


def _asks_for_the_answer(row: RetentionRow) -> bool:
    return row.answers.asked_for in (None, "target") and row.answers.picture != "none"
