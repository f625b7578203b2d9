"""The columns of the tables, each declared once: terminal, Markdown, LaTeX, report and glossary only render them.

A column names the field that it shows, `part.field` of `RetentionRow`, which is also its place in JSON and in data
frames. It also has a heading, an entry in the glossary, a text, and a sort key. `TABLES` lists the columns of each
table. To add a column: compute the field where its part is made, and declare the column here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Literal

from probe_kit._tables.numbers import number, p_text, percent, points, with_sign
from probe_kit._tables.table import Cell, absent
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.choices import Section
from probe_kit.retention.columns.text import (
    ABOVE_CHANCE,
    P_DECIDES,
    Modes,
    above_chance,
    difference_test,
    exceeds_text,
    models_test,
    published_value,
    regime_value,
    retention_value,
    site_cell,
    success_interval,
    verdict_text,
)
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.statistics.significance import SIGNIFICANCE

Labels = Literal["none", "some", "all"]
Show = Callable[[RetentionRow], Cell]
Sort = Callable[[RetentionRow], Any]


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column of a table.

    Attributes:
        key: The field that it shows, as `part.field`.
        heading: Its heading with the unit, the same in all formats.
        help: Its entry in the glossary.
        cell: The value of a row with its format, and its interval where it has one.
        sort: The value that the report sorts by, the field itself by default.
        difference: The same of a difference between runs; None for an empty cell.
        heat: Whether the report and LaTeX colour it by `sort`, from 0 to 1.
        averaged: Whether a category mean averages the field.
        also_averaged: Further fields of the same column that are averaged.
        strong: Whether a row is bold; None for no row.
        note: Text that the report shows on pointing at the cell.
        answers: Heading and help where the rows are of models that were asked, if these differ.
        both: Heading where the rows are of both, if it is not the one behind the other.
        labels: Heading and help where the rows are of labels, if these differ.
    """

    key: str
    heading: str
    help: str
    cell: Show
    sort: Sort | None = None
    difference: Callable[[Difference], Cell] | None = None
    heat: bool = False
    averaged: bool = False
    also_averaged: tuple[str, ...] = ()
    strong: Callable[[RetentionRow], bool] | None = None
    note: Callable[[RetentionRow], str] | None = None
    answers: tuple[str, str] | None = None
    both: str = ""
    labels: tuple[str, str] | None = None

    def worded(self, modes: Modes, labels: Labels = "none") -> "Column":
        """Return the column with the words for its rows.

        Args:
            modes: Whether they are of policies, of models that were asked, or of both.
            labels: Whether none, some or all of them are of labels.
        """
        if self.labels is not None and labels == "all":
            heading, meaning = self.labels
            return replace(self, heading=heading, help=meaning)
        if self.labels is not None and labels == "some":
            (heading, meaning), side = self.labels, self.worded(modes)
            return replace(side, heading=f"{side.heading} / {heading}", help=f"{side.help} Of a label: {meaning}")
        if self.answers is None or modes == "acts":
            return self
        heading, meaning = self.answers
        if modes == "answers":
            return replace(self, heading=heading, help=meaning)
        both = self.heading if heading == self.heading else self.both or f"{self.heading} / {heading}"
        return replace(
            self, heading=both, help=f"{self.help} Of a model that was asked: {meaning[:1].lower()}{meaning[1:]}"
        )

    def sort_value(self, row: RetentionRow) -> Any:
        """Return the value that a row is sorted by in this column; None for last."""
        return attrgetter(self.key)(row) if self.sort is None else self.sort(row)


@dataclass(frozen=True)
class ColumnGroup:
    """Columns that answer one question.

    Attributes:
        detail: Whether it is shown only where there is room, in Markdown and the report.
        section: The section of `--details` that shows them.
    """

    title: str
    columns: tuple[Column, ...]
    detail: bool = False
    section: Section = "success"


def share(key: str, heading: str, meaning: str, **more: Any) -> Column:
    """Return a column of a share in percent, averaged over categories."""
    read = attrgetter(key)
    column = Column(
        key=key, heading=heading, help=meaning, cell=lambda row: Cell(read(row), percent), averaged=True
    )
    return replace(column, **more)


def interval(key: str, ci: str, heading: str, meaning: str, **more: Any) -> Column:
    """Return a column of a share in percent with its 95 % interval, averaged over categories."""
    read, limits = attrgetter(key), attrgetter(ci)

    def cell(row: RetentionRow) -> Cell:
        return Cell(read(row), percent, limits(row))

    return replace(Column(key=key, heading=heading, help=meaning, cell=cell, averaged=True), **more)


def p_value(key: str, heading: str, meaning: str, **more: Any) -> Column:
    """Return a column of p-values with three decimals, bold below 0.05."""
    read = attrgetter(key)

    def low(row: RetentionRow) -> bool:
        value = read(row)
        return value is not None and value < SIGNIFICANCE

    column = Column(key=key, heading=heading, help=meaning, cell=lambda row: Cell(read(row), p_text), strong=low)
    return replace(column, **more)


def _judged_column(column: Column) -> Column:
    """Return the column, empty for a run that keeps no trajectories; `sr_idle` is known wherever they are."""
    cell = column.cell
    return replace(column, cell=lambda row: Cell(None) if row.rules.sr_idle is None else cell(row))


# -- what the policy did, and what the VLM answered ----------------------------------------------------------

SR = Column(
    key="success.sr",
    heading="SR % [95 %]",
    help="Success rate: share of episodes in which the cube ended on the correct picture. In brackets the 95 % "
    "interval, groups of questions as the unit. Two pictures: guessing gives 50 %.",
    cell=success_interval,
    difference=lambda row: Cell(row.sr, points, row.sr_ci),
    heat=True,
    averaged=True,
    strong=lambda row: row.success.regime == Regime.KNOWLEDGE,
)
ACCURACY = replace(
    SR,
    heading="accuracy % [95 %]",
    help="Share of questions that the VLM answers right, by the score that was chosen. In brackets the 95 % "
    "interval, groups of questions as the unit. Two pictures: guessing gives 50 %.",
)
DIFFERENCE_P = Column(
    key="difference.p",
    heading="p (Holm)",
    help="Of a difference between two runs, p: how often two equally good runs would differ at least this much on "
    "these questions. Signs of whole groups are flipped. In brackets: corrected by Holm for all categories and "
    "pairs. "
    f"{P_DECIDES[:1].upper()}{P_DECIDES[1:]}.",
    cell=lambda _: absent(""),
    sort=lambda _: None,
    difference=difference_test,
)
_MODELS = (
    "Of a difference between groups of models: how often models that are dealt to the groups at random would "
    "differ at least this much. It is exact, and the model is the unit. In brackets: the least p that so few "
    "models allow, and Welch's 95 % interval over models. Where p and the interval disagree, p decides. A "
    "dash stands for p where the spreads of the groups are too unlike: then only the interval holds. Other "
    "numbers of the row are of these models on other items."
)
SR_MODELS = Column(
    key="difference.sr_models",
    heading="p over models (least)",
    help=_MODELS,
    cell=lambda _: absent(""),
    sort=lambda _: None,
    difference=lambda row: models_test(row.sr_models, points),
)
RETENTION_MODELS = replace(
    SR_MODELS,
    key="difference.retention_models",
    heading="retention, p over models (least)",
    difference=lambda row: models_test(row.retention_models, with_sign),
)
MARGIN = share(
    "success.chance_margin",
    "± Δ %",
    "The margin around 50 % that guessing alone can reach; it decides the regime. It depends on the number "
    "of questions. Questions that share a picture and are answered alike count as fewer.",
    averaged=False,
)
PAPER_MARGIN = share(
    "success.chance_margin_episodes",
    "paper's Δ %",
    "The same margin if every episode counts as a question of its own, as in the paper. It decides nothing here.",
    averaged=False,
)
REGIME = Column(
    key="success.regime",
    heading="regime",
    help="Knowledge: further above 50 % than guessing leads with this many questions. Not "
    "reliable: nearer to 50 %. "
    "Failure: further below 50 % than guessing leads; the policy misses both "
    "pictures or prefers the wrong one. In a mean the normalised "
    "score: the success rate on a scale where guessing is 0 and perfection 100.",
    cell=lambda row: Cell(regime_value(row)),
    sort=lambda row: row.success.sr,
    answers=(
        "regime",
        "Knowledge: further above 50 % than guessing leads with this many questions. Not "
        "reliable: nearer to 50 %. "
        "Failure: further below 50 % than guessing leads; the answers cannot be read, or "
        "the wrong one is preferred. In a mean the "
        "normalised score: the accuracy on a scale where guessing is 0 and perfection 100.",
    ),
)
LEFT = share(
    "success.sr_left",
    "left %",
    "Success rate where the correct picture lay on the left.",
    heat=True,
    answers=("left %", "Accuracy where the correct picture lay on the left."),
)
RIGHT = share(
    "success.sr_right",
    "right %",
    "Success rate where it lay on the right. If left and right differ much, the policy prefers a side.",
    heat=True,
    answers=(
        "right %",
        "Accuracy where it lay on the right. If left and right differ much, the model prefers a side.",
    ),
)
FOLLOWS = Column(
    key="image_swap.follow_rate",
    heading="follow / reversal %",
    help="With the two pictures swapped, and nothing else: share of episodes whose action turns to the other "
    "side. "
    "After the slash: share in which it does the reverse.",
    cell=lambda row: (
        Cell(None)
        if row.image_swap.follow_rate is None
        else Cell(row.image_swap.follow_rate, percent, after=f" / {percent(row.image_swap.reversal_rate)}")
    ),
    sort=lambda row: row.image_swap.net_follow_rate,
    averaged=True,
    also_averaged=("image_swap.reversal_rate", "image_swap.net_follow_rate"),
    strong=lambda row: row.image_swap.is_used,
    note=lambda row: row.image_swap.explanation,
)
USED = Column(
    key="image_swap.use.behaviour",
    heading="used",
    help="Whether the action depends on the answer, by the image swap. Not used: it moves the action by less than "
    "a tenth of the policy's reach, while another category's answer is used.",
    cell=lambda row: Cell(None if row.image_swap.use is None else row.image_swap.use.verdict),
    sort=lambda row: row.image_swap.net_follow_rate,
    strong=lambda row: row.image_swap.is_used,
    note=lambda row: row.image_swap.explanation,
)
WRONG = share(
    "success.share_wrong",
    "wrong %",
    "Share of episodes that ended on the other picture.",
    answers=("wrong %", "Share of questions in which the other picture was named."),
)
OUTSIDE = share("success.share_outside", "outside %", "Share of episodes that ended on neither picture.")
UNREAD = replace(
    OUTSIDE, heading="unread %", help="Share of questions without an answer, or with several, by the chosen score."
)
NEVER_MOVED = share(
    "success.share_never_moved",
    "never moved %",
    "Share of all episodes in which the cube was never carried away: a failed grasp rather than a wrong "
    "answer. They are among those outside.",
)
INVALID_ACTION = share(
    "success.share_invalid_action",
    "invalid actions %",
    "Share of the policy's steps in which it put out something that is no action, such as text. Magma then holds "
    "still; OpenVLA takes the nearest action, as its authors do.",
)
ORIGINAL = share(
    "success.sr_original",
    "original %",
    "Success rate in the layout as drawn.",
    answers=("original %", "Accuracy in the layout as drawn."),
)
SWAPPED = share(
    "success.sr_swapped",
    "swapped %",
    "Success rate with the two pictures exchanged.",
    answers=("swapped %", "Accuracy with the two pictures exchanged."),
)
GOES_LEFT = share(
    "success.side_preference",
    "goes left %",
    "Among episodes that reached a picture, the share that ended on the left one. 50 % means no preference "
    "for a side.",
    averaged=False,
    answers=(
        "answers left %",
        "Among the answers that could be read, the share that named the left one. 50 % means no preference "
        "for a side.",
    ),
    both="goes left / answers left %",
)


def _right_twice(row: RetentionRow) -> Cell:
    paired = row.success.paired
    if paired is None:
        return Cell(None)
    return Cell(paired.both, after=f" of {paired.both + paired.exactly_one + paired.none}")


RIGHT_TWICE = Column(
    key="success.paired.both",
    heading="right twice",
    help="Questions answered correctly in both layouts, of those that ran in both. A habit of going to one side "
    "cannot produce these.",
    cell=_right_twice,
    sort=lambda row: None if row.success.paired is None else row.success.paired.both,
    answers=(
        "right twice",
        "Questions answered correctly in both layouts, of those that were asked in both. A habit of naming one "
        "side cannot produce these.",
    ),
)
RIGHT_TWICE_P = replace(
    p_value(
        "success.paired.p",
        "p (twice)",
        "How often luck alone would give at least so many questions right in both layouts, rather than wrong "
        "in both.",
    ),
    cell=lambda row: Cell(None if row.success.paired is None else row.success.paired.p, p_text),
    sort=lambda row: None if row.success.paired is None else row.success.paired.p,
    strong=lambda row: row.success.paired is not None and row.success.paired.p < SIGNIFICANCE,
)
SIZES = Column(
    key="success.n_episodes",
    heading="n (items)",
    help="Episodes, and in brackets questions; each question is asked in two layouts.",
    cell=lambda row: Cell(row.success.n_episodes, after=f" ({row.success.n_items})"),
)

# -- what the outcome rule makes of it -----------------------------------------------------------------------

RULES = tuple(
    map(
        _judged_column,
        (
            share(
                "rules.share_answered",
                "answered %",
                "Share of episodes in which the cube ended in the zone of either picture, right or wrong.",
            ),
            interval(
                "rules.sr_answered",
                "rules.sr_answered_ci",
                "SR of answered % [95 %]",
                "Success among episodes in which the cube ended in a zone: an episode without an "
                "answer is not a wrong answer.",
            ),
            interval(
                "rules.sr_grasped",
                "rules.sr_grasped_ci",
                "SR of grasped % [95 %]",
                "Success among episodes in which both fingers ever touched the cube.",
            ),
            share(
                "rules.share_unmoved_answers",
                "unmoved answers %",
                "Share of answered episodes in which the cube was never more than 3 cm from its start.",
            ),
            share("rules.sr_idle", "doing nothing scores %", "Success rate of a policy that does nothing."),
            share(
                "rules.share_both_zones",
                "in both zones %",
                "Share of episodes that end in the zones of both pictures; they count as correct.",
                cell=lambda row: Cell(row.rules.share_both_zones or None, percent),
            ),
        ),
    )
)


def radius_columns(rows: Sequence[RetentionRow]) -> tuple[Column, ...]:
    """Return a column of success rates per zone radius that any row was scored at."""
    return tuple(map(_radius, dict.fromkeys(radius for row in rows for radius in row.rules.sr_by_epsilon)))


def _radius(radius: str) -> Column:
    def value(row: RetentionRow) -> float | None:
        return row.rules.sr_by_epsilon.get(radius)

    return Column(
        key=f"rules.sr_by_epsilon.{radius}",
        heading=f"SR % at {1000 * float(radius):g} mm",
        help="Success rate if the cube had to end this close to the middle of the correct picture.",
        cell=lambda row: Cell(value(row), percent),
        sort=value,
        heat=True,
    )


# -- how a VLM answered --------------------------------------------------------------------------------------

ANSWERS = (
    WRONG,
    UNREAD,
    share("answers.accuracy_text", "by text %", "Share of questions that the text answers right."),
    share(
        "answers.accuracy_logits",
        "by logits %",
        "Share of questions in which the logit of the right option is larger than that of the wrong one. A "
        "constant answer is right in half.",
    ),
    share(
        "answers.accuracy_order_balanced",
        "order-balanced %",
        "The same with the logits averaged over both orders of the options, without a preference for a letter.",
    ),
    share("answers.share_unparsable", "unparsable %", "Share of answers in text that could not be parsed."),
    share(
        "answers.share_by_clause",
        "by clause %",
        "Share of text answers, right or wrong, that stand among other words and are read by rules about "
        "clauses and denials. The others are a letter or a side and nothing else.",
    ),
    share(
        "answers.accuracy_strict",
        "strict %",
        "Share right by text if answers among other words count as unparsable. It is given where they are "
        "more than 5 %.",
    ),
    share("answers.share_near_tie", "near ties %", "Share of choices that rounding alone may have decided."),
    share(
        "answers.option_mass",
        "option mass",
        "Mean probability that the model gives to all admissible answers together.",
        cell=lambda row: Cell(row.answers.option_mass, number),
    ),
    share(
        "answers.letter_bias",
        "letter bias",
        "Mean logit by which the option named first is preferred.",
        cell=lambda row: Cell(row.answers.letter_bias, number),
    ),
)

# -- probes and retention ------------------------------------------------------------------------------------


def _where_defined(key: str) -> Sort:
    read = attrgetter(key)
    return lambda row: read(row) if row.retention.defined else None


RETENTION = Column(
    key="retention.value",
    heading="retention [95 %]",
    help="Share of the backbone's signal that can be read where the action is made: the action's score above one "
    "half over the backbone's. In a mean: the ratio of the mean scores. “No limits”: the backbone is not known "
    "well enough to divide by. n/a: its signal is not shown.",
    cell=retention_value,
    sort=_where_defined("retention.value"),
    difference=lambda row: Cell(row.retention, with_sign, row.retention_ci),
    heat=True,
    note=lambda row: row.retention.note,
    answers=(
        "retention [95 %]",
        "Share of the backbone's signal that can be read where the answer is made: the answer's score above one "
        "half over the backbone's. n/a: the backbone's signal is not shown.",
    ),
)
PUBLISHED = Column(
    key="retention.published",
    heading="published ratio",
    help="The paper's formula: accuracies of the best sites above one half, action over backbone. Both are "
    "maxima, so that it is biased where signals are weak. In a mean: the mean of these ratios.",
    cell=published_value,
    sort=_where_defined("retention.published"),
)
PROBE_MINUS_SR = share(
    "controls.probe_minus_sr",
    "probe − SR %",
    "Backbone score minus success rate, in percentage points: how much more can be read than the policy acts on.",
    answers=(
        "probe − accuracy %",
        "Backbone score minus the accuracy of the answers, in points: what can be read but is not said.",
    ),
    both="probe − SR / probe − accuracy %",
)
_P = (
    "How often the best layer of a stream would look at least this good with labels that are permuted at "
    "random. Family-wise: it takes into account that all layers were tried."
)
_PEAK = "Accuracy of the best site on the same questions by which it was chosen. It is therefore too high."
_CHANCE = (
    "Chance at the site with the largest score above chance: the mean score of probes whose labels were exchanged "
    "between groups."
)
_LABEL_PEAK = (
    "Held-out score of a label at the site with the largest score above chance: accuracy balanced between "
    "classes, or R². It is too high, because the site was chosen by it."
)
_ABOVE_CHANCE = (
    "Score of a label above chance at sites that other groups chose, with its 95 % interval. Chance is subtracted "
    "at each site. Bold: the signal is shown."
)
_LAYER = (
    "Layer that the best probe reads: 0 is the input of the first block, the last number the output of the "
    "last block. Of several equally good layers the first is given; after + stands the number of the others."
)
_SCORE = (
    "Accuracy of a linear probe on questions that were used neither to train it nor to choose its site. It "
    "is balanced between the sides, so that chance is 50 %. Bold: above chance and every control."
)
_VERDICT = (
    "Shown: above chance, family-wise, and above every control that was run. Absent, for a linear probe: not "
    "shown, and the best site's accuracy is at most the stated limit, which is below 65 % by default; so "
    "many items would have shown 65 %. Not shown: everything else, with the limit of what it could be."
)
_EXCEEDS = (
    "The controls that the best site is shown to exceed, paired by question: chance; random-features, an "
    "untrained conjunction of pictures and words; untrained, the same network with random weights."
)


def _score(part: str, name: str, **words: Any) -> Column:
    """Return the column of the cross-fitted score of a stream: accuracy of a side, or a label's above chance."""
    read = attrgetter(part)

    def cell(row: RetentionRow) -> Cell:
        of = read(row)
        return above_chance(of) if row.label else Cell(of.score, percent, of.ci)

    return Column(
        key=f"{part}.score",
        heading=f"{name} % [95 %]",
        cell=cell,
        sort=lambda row: read(row).above if row.label else read(row).score,
        difference=lambda row: Cell(getattr(row, part), points, getattr(row, f"{part}_ci")),
        averaged=True,
        strong=lambda row: read(row).has_signal,
        labels=(f"{part} above chance", _ABOVE_CHANCE),
        **words,
    )


def _peak(part: str, **words: Any) -> Column:
    """Return the column of the score of a stream's best site: accuracy of a side, or the metric of a label."""
    read = attrgetter(part)
    return Column(
        key=f"{part}.peak",
        heading=f"{part} peak %",
        help=_PEAK,
        cell=lambda row: Cell(read(row).peak, number if row.label else percent),
        averaged=True,
        labels=(f"{part} peak", _LABEL_PEAK),
        **words,
    )


def _chance(part: str) -> Column:
    """Return the column of a label's chance at the best site of a stream; one half for a side, without a cell."""
    read = attrgetter(f"{part}.chance")
    return Column(
        key=f"{part}.chance", heading=f"{part} chance", help=_CHANCE, cell=lambda row: Cell(read(row), number)
    )


BACKBONE = _score("backbone", "backbone", help=f"In the vision-language backbone. {_SCORE}")
BACKBONE_VERDICT = Column(
    key="backbone.verdict",
    heading="in the backbone",
    help=_VERDICT,
    cell=lambda row: Cell(verdict_text(row.backbone)),
    sort=lambda row: row.backbone.at_most,
)
BACKBONE_LAYER = Column(
    key="backbone.layer",
    heading="backbone layer",
    help=_LAYER,
    cell=lambda row: site_cell(row.backbone.layer, None, row.backbone.ties),
)
BACKBONE_P = p_value("backbone.p_fwe", "backbone p", _P)
BACKBONE_PEAK, BACKBONE_CHANCE = _peak("backbone"), _chance("backbone")
EXCEEDS = Column(
    key="backbone.exceeds",
    heading="backbone exceeds",
    help=_EXCEEDS,
    cell=lambda row: Cell(exceeds_text(row.backbone)),
    sort=lambda row: exceeds_text(row.backbone),
)
_IN_ACTION = "Where the action is made: in the action expert, or at the positions that choose action tokens."
ACTION = _score(
    "action",
    "action",
    help=f"{_IN_ACTION} {_SCORE}",
    answers=("answer % [95 %]", f"At the position that chooses the first token of the answer. {_SCORE}"),
)
ACTION_VERDICT = Column(
    key="action.verdict",
    heading="in the action",
    help=_VERDICT,
    cell=lambda row: Cell(verdict_text(row.action)),
    sort=lambda row: row.action.at_most,
    answers=("in the answer", _VERDICT),
)
ACTION_LAYER = Column(
    key="action.layer",
    heading="action layer @iteration",
    help=f"{_LAYER} After @: the flow-matching step or action token, counted from 0. At 0 the stream has seen no "
    "action yet.",
    cell=lambda row: site_cell(row.action.layer, row.action.iteration, row.action.ties),
    answers=("answer layer", _LAYER),
)
ACTION_P = p_value("action.p_fwe", "action p", _P, answers=("answer p", _P))
ACTION_PEAK = _peak("action", answers=("answer peak %", _PEAK), both="action peak / answer peak %")
ACTION_CHANCE = _chance("action")
FIRST_ITERATION = share(
    "action.first_peak",
    "first iteration %",
    "Best layer at the first iteration, before the network has seen any part of the action. Later iterations "
    "already contain the decision: a noisy action, or the tokens before.",
    answers=("first iteration %", "Best layer at the first iteration."),
)
METRIC = Column(
    key="task",
    heading="metric",
    help="The score of a label: accuracy balanced between its classes, or R² of a quantity.",
    cell=lambda row: Cell(row.metric if row.label else None),
)


GROUPS = Column(
    key="controls.n_groups",
    heading="groups",
    help="Independent groups of questions; questions that share a picture count once.",
    cell=lambda row: Cell(row.controls.n_groups),
)

# -- controls ------------------------------------------------------------------------------------------------


def _baseline(name: str) -> Column:
    """Return the column of a baseline's accuracy in percent, and whether it is above chance."""

    def cell(row: RetentionRow) -> Cell:
        leaks = name in row.controls.leaks
        mark = f" {ABOVE_CHANCE}" if leaks else ""
        return Cell(row.controls.baselines.get(name), percent, after=mark, alarm=leaks)

    return Column(
        key=f"controls.baselines.{name}",
        heading=f"{name} %",
        help=_BASELINES[name],
        cell=cell,
        sort=lambda row: row.controls.baselines.get(name),
    )


_LEAK = " Red: the suite gives the answer away without a model."
_BASELINES = {
    "position": f"Accuracy of the same probe if it sees the layout alone, not the model.{_LEAK}",
    "instruction": f"Accuracy of the same probe if it sees the words alone, not the model.{_LEAK}",
    "pixels": f"Accuracy of the same probe if it sees the two pictures alone, not the model.{_LEAK}",
    "random-features": (
        "Accuracy of the same probe on random features of pictures and words. The backbone must exceed it."
    ),
}
BASELINES = tuple(map(_baseline, _BASELINES))
_SELECTIVITY = "Accuracy above that of the same probe on random labels, at the best site"
_UNTRAINED = "The same probes on another run of the same episodes, usually with untrained weights, subtracted"

BY_LAYOUT = ColumnGroup(
    "By layout and item", (ORIGINAL, SWAPPED, GOES_LEFT, RIGHT_TWICE, RIGHT_TWICE_P, SIZES), True
)

TABLES: Mapping[str, tuple[ColumnGroup, ...]] = {
    "Success rate": (
        ColumnGroup(
            "Does it act on the answer?",
            (SR, SR_MODELS, DIFFERENCE_P, MARGIN, PAPER_MARGIN, REGIME, LEFT, RIGHT),
        ),
        ColumnGroup("Where the cube ended", (WRONG, OUTSIDE, NEVER_MOVED, INVALID_ACTION)),
        ColumnGroup("With the two pictures swapped", (FOLLOWS, USED), section="interventions"),
        ColumnGroup("What the outcome rule makes of it", RULES, section="rules"),
        BY_LAYOUT,
    ),
    "Accuracy of answers": (
        ColumnGroup("Does it know the answer?", (ACCURACY, SR_MODELS, DIFFERENCE_P, MARGIN, REGIME, LEFT, RIGHT)),
        ColumnGroup("How it answered", ANSWERS, section="answers"),
        BY_LAYOUT,
    ),
    "Retention": (
        ColumnGroup(
            "What is retained",
            (METRIC, RETENTION, RETENTION_MODELS, PUBLISHED, PROBE_MINUS_SR),
            section="retention",
        ),
        ColumnGroup(
            "In the backbone",
            (BACKBONE, BACKBONE_VERDICT, BACKBONE_LAYER, BACKBONE_P, EXCEEDS),
            section="probes",
        ),
        ColumnGroup(
            "Where the action is made",
            (ACTION, ACTION_VERDICT, ACTION_LAYER, ACTION_P, FIRST_ITERATION),
            section="probes",
        ),
        ColumnGroup(
            "Best sites, not corrected for having been chosen",
            (BACKBONE_PEAK, BACKBONE_CHANCE, ACTION_PEAK, ACTION_CHANCE, GROUPS),
            True,
            section="probes",
        ),
    ),
    "Controls": (
        ColumnGroup("What gives the answer away without the model", BASELINES, section="controls"),
        ColumnGroup(
            "Selectivity",
            (
                share("backbone.selectivity", "backbone selectivity %", f"{_SELECTIVITY} of the backbone."),
                share("action.selectivity", "action selectivity %", f"{_SELECTIVITY} of the action."),
            ),
            section="controls",
        ),
        ColumnGroup(
            "Against the untrained network",
            (
                interval(
                    "backbone.minus_untrained",
                    "backbone.minus_untrained_ci",
                    "backbone − untrained %",
                    f"{_UNTRAINED}: backbone.",
                ),
                interval(
                    "action.minus_untrained",
                    "action.minus_untrained_ci",
                    "action − untrained %",
                    f"{_UNTRAINED}: where the action is made.",
                ),
            ),
            section="controls",
        ),
    ),
}
"""The groups of columns of each table in order, by its title."""


_OF_ONE_MODE: Mapping[str, Modes] = {"Success rate": "acts", "Accuracy of answers": "answers"}


def all_columns(modes: Modes = "both") -> tuple[Column, ...]:
    """Return every column of the tables of such rows once, in order and with their words."""
    tables = [groups for title, groups in TABLES.items() if modes in ("both", _OF_ONE_MODE.get(title, modes))]
    every = [column.worded(modes) for groups in tables for group in groups for column in group.columns]
    # Both tables of behaviour share some.
    return tuple({(column.key, column.heading): column for column in every}.values())


def averaged_fields() -> tuple[str, ...]:
    """Return the fields that a category mean averages, as `part.field`."""
    every = [
        field
        for column in all_columns()
        for field in (*((column.key,) if column.averaged else ()), *column.also_averaged)
    ]
    return tuple(dict.fromkeys(every))
