"""Known, encoded, used, in one plain sentence per category: what a report opens with."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, cast

from probe_kit.intervene.kinds.image_swap.verdict import Verdict
from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.text import model_name, percent
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.text import spell

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import ResponsiveTable

CategoryVerdict = Verdict | Literal["known", "unknown", "acted on", "encoded, not acted on"]
"""A verdict on an image swap, or what success rate and probes say where none is stored: these never say *used*."""

_READ = {True: "can be read in the policy's backbone", False: "cannot be read in its backbone"}
_ACTED: dict[CategoryVerdict, str] = {
    "used": "the policy acts on it",
    "encoded, unused": "the policy does not act on it",
    "acted on": "the policy acts on it",
    "encoded, not acted on": "the policy does not act on it",
    "absent": "the policy does not act on it",
    "does not follow": "the policy does not act on it",
    "encoded, acted against": "the policy does the opposite",
    "acted against, not found": "the policy does the opposite",
    "acts against": "the policy does the opposite",
    "acted on, not found": "the policy acts on it although the probes did not find it",
    "follows": "the policy acts on it",
    "inconclusive": "whether the policy acts on it remains open",
}


def verdict(row: RetentionRow) -> CategoryVerdict:
    """What a row of the retention table says: is the answer in the backbone, and does the policy act on it?

    In the backbone: its best site exceeds chance, family-wise, and every control that was run. With a stored image
    swap the verdict is that of `probe_kit.intervene`. Without one, the SR in the regime of knowledge says *acted
    on*: only an intervention shows that what is read is used. *Acted on, not found*: the probes missed what the
    policy acts on. A VLM knows a category in which it answers in the regime of knowledge.
    """
    if row.run.mode == "answers":
        return "known" if row.success.regime == Regime.KNOWLEDGE else "unknown"
    if row.image_swap.used is not None:
        return cast("Verdict", row.image_swap.used)
    if row.success.regime == Regime.KNOWLEDGE:
        return "acted on" if row.backbone.has_signal else "acted on, not found"
    return "encoded, not acted on" if row.backbone.has_signal else "absent"


@dataclass(frozen=True)
class CategorySummary:
    """One category: of the VLM (None without one), of the probes, and of the action.

    sr, reader_sr, backbone: shares of right episodes, answers and held-out probe decisions.
    """

    category: str
    reader_above_chance: bool | None
    reader_sr: float | None
    encoded: bool
    backbone: float | None
    verdict: CategoryVerdict
    sr: float | None

    @property
    def name(self) -> str:
        """The category as it is spelt at the beginning of a sentence."""
        spelt = spell(self.category)
        return spelt[:1].upper() + spelt[1:]

    @property
    def outcome(self) -> str:
        """The three in a few words."""
        known = {True: "known; ", False: "not known; ", None: ""}[self.reader_above_chance]
        return known + str(self.verdict)

    @property
    def sentence(self) -> str:
        """The same in plain words, with the numbers they rest on."""
        parts = []
        if self.reader_above_chance is not None:
            answered = f"answers {percent(self.reader_sr)} % of the questions right"
            parts.append(
                f"the reader {'knows it' if self.reader_above_chance else 'does not know it'} ({answered})"
            )
        parts.append(f"the answer {_READ[self.encoded]} (probe {percent(self.backbone)} %)")
        right = f" (right in {percent(self.sr)} % of the episodes)" if self.sr is not None else ""
        parts.append(f"{_ACTED[self.verdict]}{right}")
        return f"{self.name}: {', '.join(parts[:-1])}, and {parts[-1]}."


@dataclass(frozen=True)
class PolicySummary:
    """A policy's categories. reader: what was asked beside it, empty for nobody."""

    policy: str
    reader: str
    categories: tuple[CategorySummary, ...]

    def to_rich(self) -> "ResponsiveTable":
        """A line per category: known, encoded and used, with the share each rests on."""
        from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

        marks = {True: "yes", False: "no", None: "not asked"}
        cells = tuple(
            (
                Cell(
                    f"{marks[one.reader_above_chance]} ({percent(one.reader_sr)})"
                    if one.reader_above_chance is not None
                    else marks[None]
                ),
                Cell(f"{marks[one.encoded]} ({percent(one.backbone)})"),
                Cell(f"{one.verdict} ({percent(one.sr)})"),
            )
            for one in self.categories
        )
        return ResponsiveTable(
            title=f"Known, encoded, used: {' · '.join(name for name in (self.reader, self.policy) if name)}",
            caption="known: share of answers the reader gets right, %; encoded: of held-out decisions of the best "
            "probe; used: the verdict, and the share of episodes that end on the right picture",
            name="category",
            names=tuple(one.name for one in self.categories),
            styles=("",) * len(self.categories),
            parts=(Part("", ("known", "encoded", "used"), cells),),
        )


def policy_summaries(rows: Sequence[RetentionRow]) -> list[PolicySummary]:
    """One per probed policy of a retention table, by the first view of each, beside the first VLM run.

    Runs that only captured, or not probed, have none; so have policies on another suite than the reader's
    no reader.
    """
    asked = [row for row in rows if row.category != MEAN and _asks_for_the_answer(row)]
    acted: dict[str, list[RetentionRow]] = {}
    for row in rows:
        if (
            row.run.mode == "acts"
            and row.category != MEAN
            and not row.run.capture_only
            and row.backbone.score is not None
        ):
            acted.setdefault(row.run.location, []).append(row)
    return [_story([row for row in own if row.view == own[0].view], asked) for own in acted.values()]


def _asks_for_the_answer(row: RetentionRow) -> bool:
    return (
        row.run.mode == "answers" and row.answers.asked_for in (None, "target") and row.answers.picture != "none"
    )


def _story(rows: Sequence[RetentionRow], asked: Sequence[RetentionRow]) -> PolicySummary:
    same = [row for row in asked if row.run.suite == rows[0].run.suite]
    first = {row.category: row for row in same if row.run.location == same[0].run.location}
    reader = model_name(same[0]) if same else ""
    return PolicySummary(
        model_name(rows[0]), reader, tuple(_chapter(row, first.get(row.category)) for row in rows)
    )


def _chapter(row: RetentionRow, asked: RetentionRow | None) -> CategorySummary:
    return CategorySummary(
        category=row.category,
        reader_above_chance=None if asked is None else verdict(asked) == "known",
        reader_sr=None if asked is None else asked.success.sr,
        encoded=row.backbone.has_signal,
        backbone=row.backbone.score,
        verdict=verdict(row),
        sr=row.success.sr,
    )
