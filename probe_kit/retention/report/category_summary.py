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
    from probe_kit._terminal.responsive_table import FittingTable

CategoryVerdict = Verdict | Literal["known", "unknown"]

_READ = {True: "can be read in the policy's backbone", False: "cannot be read in its backbone"}
_ACTED: dict[CategoryVerdict, str] = {
    "used": "the policy acts on it",
    "encoded, unused": "the policy does not act on it",
    "absent": "the policy does not act on it",
    "does not follow": "the policy does not act on it",
    "encoded, acted against": "the policy does the opposite",
    "acted against, not found": "the policy does the opposite all the same",
    "acts against": "the policy does the opposite",
    "acted on, not found": "the policy acts on it all the same, so that the probes missed it",
    "follows": "the policy acts on it",
    "inconclusive": "whether the policy acts on it remains open",
}


def verdict(row: RetentionRow) -> CategoryVerdict:
    """What a row of the retention table says: is the answer in the backbone, and does the policy act on it?

    In the backbone: its best site beats chance, family-wise, and every control that was run. Acted on: the action
    follows the pictures when these are exchanged; without a stored intervention, the SR is in the regime of
    knowledge. *Acted on, not found* is a contradiction, and true of no policy: the instrument missed what the
    policy plainly reads. A model that was asked knows a category in which it answers in the regime of knowledge.
    """
    if row.kind == "asks":
        return "known" if row.regime == Regime.KNOWLEDGE else "unknown"
    if row.used is not None:
        return cast("Verdict", row.used)
    if row.regime == Regime.KNOWLEDGE:
        return "used" if row.backbone_signal else "acted on, not found"
    return "encoded, unused" if row.backbone_signal else "absent"


@dataclass(frozen=True)
class CategorySummary:
    """One category: of the reader that was asked (None where nobody was), of the probes, and of the action.

    sr, known_sr, backbone: shares of right episodes, answers and held-out probe decisions.
    """

    category: str
    known: bool | None
    known_sr: float | None
    encoded: bool
    backbone: float | None
    used: CategoryVerdict
    sr: float | None

    @property
    def name(self) -> str:
        """The category as it is spelt at the beginning of a sentence."""
        spelt = spell(self.category)
        return spelt[:1].upper() + spelt[1:]

    @property
    def outcome(self) -> str:
        """The three in a few words."""
        known = {True: "known; ", False: "not known; ", None: ""}[self.known]
        return known + str(self.used)

    @property
    def sentence(self) -> str:
        """The same in plain words, with the numbers they rest on."""
        parts = []
        if self.known is not None:
            answered = f"answers {percent(self.known_sr)} % of the questions right"
            parts.append(f"the reader {'knows it' if self.known else 'does not know it'} ({answered})")
        parts.append(f"the answer {_READ[self.encoded]} (probe {percent(self.backbone)} %)")
        right = f" (right in {percent(self.sr)} % of the episodes)" if self.sr is not None else ""
        parts.append(f"{_ACTED[self.used]}{right}")
        return f"{self.name}: {', '.join(parts[:-1])}, and {parts[-1]}."


@dataclass(frozen=True)
class PolicySummary:
    """A policy's chapters. reader: what was asked beside it, empty for nobody."""

    policy: str
    reader: str
    chapters: tuple[CategorySummary, ...]

    def to_rich(self) -> "FittingTable":
        """A line per category: known, encoded and used, with the share each rests on."""
        from probe_kit._terminal.responsive_table import Cell, FittingTable, Part

        marks = {True: "yes", False: "no", None: "not asked"}
        cells = tuple(
            (
                Cell(f"{marks[one.known]} ({percent(one.known_sr)})" if one.known is not None else marks[None]),
                Cell(f"{marks[one.encoded]} ({percent(one.backbone)})"),
                Cell(f"{one.used} ({percent(one.sr)})"),
            )
            for one in self.chapters
        )
        return FittingTable(
            title=f"Known, encoded, used: {' · '.join(name for name in (self.reader, self.policy) if name)}",
            caption="known: share of answers the reader gets right, %; encoded: of held-out decisions of the best "
            "probe; used: the verdict, and the share of episodes that end on the right picture",
            name="category",
            names=tuple(one.name for one in self.chapters),
            styles=("",) * len(self.chapters),
            parts=(Part("", ("known", "encoded", "used"), cells),),
        )


def policy_summaries(rows: Sequence[RetentionRow]) -> list[PolicySummary]:
    """One per probed policy of a retention table, by the first view of each, beside the first VLM run.

    Runs that were only listened to, or not probed, have none; so have policies on another suite than the reader's
    no reader.
    """
    asked = [row for row in rows if row.category != MEAN and _asks_for_the_answer(row)]
    acted: dict[str, list[RetentionRow]] = {}
    for row in rows:
        if row.kind == "acts" and row.category != MEAN and not row.listened and row.backbone_accuracy is not None:
            acted.setdefault(row.run, []).append(row)
    return [_story([row for row in own if row.view == own[0].view], asked) for own in acted.values()]


def _asks_for_the_answer(row: RetentionRow) -> bool:
    return row.kind == "asks" and row.asked_for in (None, "target") and row.picture != "none"


def _story(rows: Sequence[RetentionRow], asked: Sequence[RetentionRow]) -> PolicySummary:
    same = [row for row in asked if row.suite == rows[0].suite]
    first = {row.category: row for row in same if row.run == same[0].run}
    reader = model_name(same[0]) if same else ""
    return PolicySummary(
        model_name(rows[0]), reader, tuple(_chapter(row, first.get(row.category)) for row in rows)
    )


def _chapter(row: RetentionRow, asked: RetentionRow | None) -> CategorySummary:
    return CategorySummary(
        category=row.category,
        known=None if asked is None else verdict(asked) == "known",
        known_sr=None if asked is None else asked.sr,
        encoded=row.backbone_signal,
        backbone=row.backbone_accuracy,
        used=verdict(row),
        sr=row.sr,
    )
