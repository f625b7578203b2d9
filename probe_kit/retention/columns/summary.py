"""The summary: a row and a sentence per category, the same in every format."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast

from probe_kit.intervene.kinds.image_swap.verdict import Verdict
from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.text import (
    difference_interval,
    difference_test,
    is_vlm,
    model_name,
    number,
    p_text,
    percent,
    ratio_difference,
    with_limits,
)
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.estimators.stream_scores import Limits
from probe_kit.retention.rows.parts import StreamPart
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.text import spell

CategoryVerdict = (
    Verdict | Literal["known", "unknown", "encoded", "acted on", "encoded, not acted on", "not shown"]
)
"""A verdict on an image swap, or what success rate and probes say where none is stored: these never say *used*."""
MARK = "✓"
"""After a share: the stream's signal is shown, or the regime of the behaviour is knowledge."""
_LEGENDS = {
    "VLM %": "VLM: share of its answers that are right",
    "backbone %": "Backbone: accuracy of probes in the backbone, at sites that other questions chose",
    "action %": "Action: the same at the action's sites",
    "success %": "Success: the cube ends on the right picture",
    "retention": "Retention: share of the backbone's signal left in the action",
}
"""What a column shows."""


def verdict(row: RetentionRow) -> CategoryVerdict:
    """What a row of the retention table says: is the answer in the backbone, and does the policy act on it?

    In the backbone: its best site exceeds chance, family-wise, and every control that was run. With a stored
    image swap the verdict is that of `probe_kit.intervene`. Without one, the SR in the regime of knowledge says
    *acted on*: only an intervention shows that what is read is used. *Acted on, not found*: the probes missed
    what the policy acts on. *Absent* is said only where the backbone's best site is below a stated accuracy,
    else *not shown*. A VLM knows a category in which it answers in the regime of knowledge.
    """
    if is_vlm(row):
        return "known" if _knows(row) else "unknown"
    nothing: CategoryVerdict = "absent" if row.backbone.verdict == "absent" else "not shown"
    if row.image_swap.used is not None:
        return nothing if row.image_swap.used == "absent" else cast("Verdict", row.image_swap.used)
    if row.success.sr is None:
        return "encoded" if row.backbone.has_signal else nothing
    if _knows(row):
        return "acted on" if row.backbone.has_signal else "acted on, not found"
    return "encoded, not acted on" if row.backbone.has_signal else nothing


def _knows(row: RetentionRow) -> bool:
    return row.success.regime == Regime.KNOWLEDGE


@dataclass(frozen=True)
class CategorySummary:
    """One category of a policy, or of a VLM alone. asked: the VLM's row of the same category."""

    row: RetentionRow
    asked: RetentionRow | None = None

    @property
    def name(self) -> str:
        """The category as it is spelt at the beginning of a sentence."""
        return _name(self.row.category)

    def cells(self, intervals: bool = True) -> tuple[str, ...]:
        """What stands under `HEADINGS`."""
        row, asked = self.row, self.row if is_vlm(self.row) else self.asked
        acts = None if is_vlm(row) else row
        return (
            "–" if asked is None else _share(asked.success.sr, asked.success.ci, _knows(asked), intervals),
            _share(row.backbone.score, row.backbone.ci, row.backbone.has_signal, intervals),
            _share(row.action.score, row.action.ci, row.action.has_signal, intervals),
            "–" if acts is None else _share(acts.success.sr, acts.success.ci, _knows(acts), intervals),
            _retention(row, intervals),
            "" if row.category == MEAN else str(verdict(row)),
        )

    @property
    def sentence(self) -> str:
        """The finding in plain words, with its numbers, their uncertainty and the number of items."""
        parts = [*_answered(self.row if is_vlm(self.row) else self.asked), *_streams(self.row)]
        parts += [] if is_vlm(self.row) else [_acted(self.row)]
        items = self.row.success.n_items
        return f"{self.name} ({items} item{'s' * (items != 1)}): {'; '.join(parts)}. {self.conclusion}"

    @property
    def conclusion(self) -> str:
        """What follows, and what to do next."""
        return (_UNACTED if self.row.success.sr is None else _CONCLUSIONS)[verdict(self.row)]


HEADINGS = ("VLM %", "backbone %", "action %", "success %", "retention", "verdict")
_CONCLUSIONS: dict[CategoryVerdict, str] = {
    "known": "The VLM knows the answer.",
    "unknown": "Not shown that the VLM knows the answer.",
    "used": "The answer is used.",
    "encoded, unused": "Shown in the backbone, not used.",
    "encoded, acted against": "Shown in the backbone; the policy acts against it.",
    "absent": "Absent from the backbone, and the policy does not act on it.",
    "not shown": "Not shown in the backbone, and not acted on: more items would tell.",
    "acted on, not found": "The policy acts on it, and the probes did not find it.",
    "acted against, not found": "The policy acts against it, and the probes did not find it.",
    "follows": "The action follows the pictures; there are no probes.",
    "acts against": "The action goes against the pictures; there are no probes.",
    "does not follow": "The action does not follow the pictures; there are no probes.",
    "inconclusive": "Whether it is used remains open: more items would tell.",
    "encoded": "Shown in the backbone.",
    "acted on": "Whether what is read is used was not tested: run `probe-kit intervene`.",
    "encoded, not acted on": "Shown in the backbone, not acted on. To test its use, run `probe-kit intervene`.",
}


_UNACTED = _CONCLUSIONS | {
    "absent": "Absent from the backbone.",
    "not shown": "Not shown in the backbone: more items would tell.",
}
"""The same of a model that did not act."""


def _share(value: float | None, limits: Limits | None, marked: bool, intervals: bool) -> str:
    text = with_limits(_whole(value), limits if intervals else None, _whole)
    return f"{text} {MARK}" if marked and value is not None else text


def _whole(value: float | None) -> str:
    return percent(value, 0)


def _retention(row: RetentionRow, intervals: bool) -> str:
    if row.backbone.score is None or row.action.score is None:
        return "–"
    if not row.retention.defined:
        return "n/a"
    return with_limits(number(row.retention.value), row.retention.ci if intervals else None, number)


def _range(limits: Limits | None) -> str:
    """Limits of a share in words, with a comma before them."""
    if limits is None or None in limits:
        return ""
    return f", {percent(limits[0], 0)} to {percent(limits[1], 0)}"


def _answered(row: RetentionRow | None) -> list[str]:
    if row is None or row.success.sr is None:
        return []
    return [f"the VLM answers right in {percent(row.success.sr, 0)} %{_range(row.success.ci)}{_margin(row)}"]


def _margin(row: RetentionRow) -> str:
    """Where an interval excludes one half and the regime still says nothing: by what it decides."""
    low = None if row.success.ci is None else row.success.ci[0]
    if low is None or low <= 0.5 or row.success.regime != Regime.NO_RELIABLE_KNOWLEDGE:
        return ""
    return f", less than the {percent(row.success.chance_margin, 0)} points above one half that guessing can reach"


def _streams(row: RetentionRow) -> list[str]:
    """What can be read in the backbone, and where the action is made."""
    action = f"the {row.run.action_name}"
    both = row.backbone.verdict == row.action.verdict == "shown"
    parts = [] if row.backbone.score is None else [_in_stream("the backbone", row.backbone)]
    if row.action.score is not None:
        parts.append(f"so does {action} ({_accuracy(row.action)})" if both else _in_stream(action, row.action))
    return parts


def _accuracy(part: StreamPart) -> str:
    return f"{percent(part.score, 0)} %{_range(part.ci)}"


def _in_stream(name: str, part: StreamPart) -> str:
    most = f"{percent(part.at_most, 0)} %"
    if part.verdict == "absent":
        return f"{name} does not hold it (at most {most})"
    if part.verdict == "shown":
        return f"{name} holds the answer ({_accuracy(part)})"
    missed = [control for control, better in part.exceeds.items() if better is False]
    than = f" to exceed {' and '.join(missed)}" if missed and "chance" not in missed else " to hold it"
    return f"{name} is not shown{than} ({percent(part.score, 0)} %, could be up to {most})"


def _acted(row: RetentionRow) -> str:
    if row.success.sr is None:
        return "the model did not act"
    right = f"the cube ends right in {percent(row.success.sr, 0)} %{_range(row.success.ci)}{_margin(row)}"
    swap = row.image_swap
    if swap.follow_rate is None:
        return right
    followed, limits = percent(swap.follow_rate, 0), swap.net_follow_rate_ci
    if verdict(row) in ("used", "acted on, not found", "follows"):
        return f"the action follows it (in {followed} % of swapped pictures), and {right}"
    most = "" if limits is None or limits[1] is None else f", at most {percent(limits[1], 0)} %"
    return f"the action does not follow it (in {followed} % of swapped pictures{most}), and {right}"


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
        """One per category."""
        return tuple(one.sentence for one in self.categories)


def summary_table(
    found: Sequence[RunSummary], differences: Sequence[Difference] = (), intervals: bool = True
) -> TextTable:
    """A row per category and run, and the mean; below them the differences of runs. Empty columns are left out."""
    several = len(found) > 1
    names = list(dict.fromkeys(one.row.category for run in found for one in run.categories))
    if any(len(run.categories) > 1 for run in found):
        names.append(MEAN)
    lines = []
    for name in names:
        for run in found:
            own = [one for one in (*run.categories, run.mean) if one.row.category == name]
            lines += [(one.name, run.run, *one.cells(intervals)) for one in own]
        gaps = [row for row in differences if row.category == name]
        lines += [(_name(name), f"{row.group} − {row.minus}", *_difference_cells(row, intervals)) for row in gaps]
    headings = ("category", "run", *HEADINGS)
    shown = [at for at in range(len(headings)) if at == 0 or (at == 1 and (several or differences))]
    shown += [at for at in range(2, len(headings)) if any(line[at] not in ("–", "") for line in lines)]
    legend = [_LEGENDS[headings[at]] for at in shown if headings[at] in _LEGENDS]
    return TextTable(
        f"Summary: {' · '.join(dict.fromkeys(run.title for run in found))}",
        ". ".join([*legend, f"{MARK} above every control that was run"]),
        tuple(headings[at] for at in shown),
        tuple(tuple(line[at] for at in shown) for line in lines),
    )


def _difference_cells(row: Difference, intervals: bool) -> tuple[str, ...]:
    sr, backbone, action = (
        difference_interval(value, limits if intervals else None)
        for value, limits in ((row.sr, row.sr_ci), (row.backbone, row.backbone_ci), (row.action, row.action_ci))
    )
    answered, acted = (sr, "") if row.mode == "answers" else ("", sr)
    ratio = ratio_difference(row.retention, row.retention_ci if intervals else None)
    return answered, backbone, action, acted, ratio, _difference_p(row)


def _difference_p(row: Difference) -> str:
    """Over models where a side is a group of several, else over items."""
    if row.sr_models is not None:
        return f"over models p {p_text(row.sr_models.p)} (least {p_text(row.sr_models.smallest_p)})"
    return "" if row.p is None else f"p {difference_test(row)}"


def _name(category: str) -> str:
    spelt = spell(category)
    return spelt[:1].upper() + spelt[1:]


def summarise_runs(all_rows: Sequence[RetentionRow]) -> list[RunSummary]:
    """One per run and group of a table's rows and means, by the first view of each.

    Policies have the answers of a VLM of their suite.
    A VLM has a summary of its own only where no policy of its suite is in the table.
    """
    rows = [row for row in all_rows if row.category != MEAN]
    means = [row for row in all_rows if row.category == MEAN]
    asked = [row for row in rows if is_vlm(row) and _asks_for_the_answer(row)]
    asked_means = {row.run.location: row for row in means if is_vlm(row)}
    policies = _by_run([row for row in rows if not is_vlm(row)])
    beside = {row.run.suite for row in rows if not is_vlm(row)}
    alone = _by_run([row for row in rows if is_vlm(row) and row.run.suite not in beside])
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


def _by_run(rows: Sequence[RetentionRow]) -> list[list[RetentionRow]]:
    found: dict[tuple[str | None, str], list[RetentionRow]] = {}
    for row in rows:
        found.setdefault(row.key, []).append(row)
    return list(found.values())
