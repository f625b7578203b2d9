"""How single values of a retention row read in a table for people."""

from collections.abc import Callable, Sequence

from probe_kit.retention.behaviour.run_labels import full_name
from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.estimators.bootstrap_draws import Limits
from probe_kit.retention.rows.row import RetentionRow

Column = tuple[str, Callable[[RetentionRow], str]]
"""Heading, and what a row shows under it."""


NOT_ACTED = "n/a"
"""In place of a success rate, for a model that was listened to."""


def percent(value: float | None, digits: int = 1) -> str:
    """A share as a percentage, with one decimal unless told otherwise; a dash for None."""
    return "–" if value is None else f"{100 * value:.{digits}f}"


def number(value: float | None, digits: int = 2) -> str:
    """A number with two decimals; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def model_name(row: RetentionRow) -> str:
    """The model, marked if its weights are random or it was only listened to, and its group if there is one."""
    return full_name(row.label or row.model, row.random_weights, row.listened, row.group)


def with_limits(value: str, limits: Limits | None, write: Callable[[float | None], str]) -> str:
    """A value with its interval, if it has one."""
    if limits is None or value == "–":
        return value
    low, high = limits
    return f"{value} [unbounded]" if low is None or high is None else f"{value} [{write(low)}, {write(high)}]"


def category_name(row: RetentionRow) -> str:
    """As the suite has it."""
    return row.category


def view_name(row: RetentionRow) -> str:
    """How tokens became one vector; a dash without probes."""
    return row.view or "–"


def success_value(row: RetentionRow) -> str:
    """SR in percent without its interval; n/a for a model that did not act."""
    return NOT_ACTED if row.sr is None else percent(row.sr)


def backbone_value(row: RetentionRow) -> str:
    """Accuracy of the backbone's best site in percent, with its interval."""
    return with_limits(percent(row.backbone_accuracy), row.backbone_ci, percent)


def action_value(row: RetentionRow) -> str:
    """The same where the action is made."""
    return with_limits(percent(row.action_accuracy), row.action_ci, percent)


def backbone_share(row: RetentionRow) -> str:
    """Accuracy of the backbone's best site without its interval."""
    return percent(row.backbone_accuracy)


def action_share(row: RetentionRow) -> str:
    """The same where the action is made."""
    return percent(row.action_accuracy)


def difference_test(_: RetentionRow) -> str:
    """Nothing: only differences between runs are tested here, see `probe_kit.retention.columns.lines`."""
    return ""


DIFFERENCE_TEST: Column = ("p (Holm)", difference_test)
"""Column of tables of several runs."""


def success_interval(row: RetentionRow) -> str:
    """SR in percent with its interval; n/a for a model that did not act, or for a rule that needs trajectories."""
    return NOT_ACTED if row.sr is None else with_limits(percent(row.sr), row.sr_ci, percent)


def _judged(cell: Callable[[RetentionRow], str]) -> Callable[[RetentionRow], str]:
    """Nothing for a run that keeps no trajectories."""
    return lambda row: "–" if row.sr_idle is None else cell(row)


RULE_COLUMNS: list[Column] = [
    ("answered", _judged(lambda row: percent(row.share_answered))),
    (
        "SR of answered [95 %]",
        _judged(lambda row: with_limits(percent(row.sr_answered), row.sr_answered_ci, percent)),
    ),
    (
        "SR of grasped [95 %]",
        _judged(lambda row: with_limits(percent(row.sr_grasped), row.sr_grasped_ci, percent)),
    ),
    ("answers that never left the start", _judged(lambda row: percent(row.share_unmoved_answers))),
    ("doing nothing scores", _judged(lambda row: percent(row.sr_idle))),
    ("in both zones", _judged(lambda row: percent(row.share_both_zones) if row.share_both_zones else "–")),
]
"""What stands beside a success rate, because an outcome rule may give it away; in percent."""


FOLLOWED_COLUMNS: list[Column] = [
    (
        "follows / against",
        lambda row: "–" if row.follows is None else f"{percent(row.follows)} / {percent(row.against)}",
    ),
    ("used", lambda row: row.used or "–"),
]
"""What stored interventions say beside a success rate; shares in percent."""


def followed(rows: Sequence[RetentionRow]) -> bool:
    """Whether any row was intervened on."""
    return any(row.follows is not None for row in rows)


ANSWER_SCORES: list[Column] = [
    ("by text", lambda row: percent(row.accuracy_text)),
    ("by logits", lambda row: percent(row.accuracy_logits)),
    ("without letter bias", lambda row: percent(row.accuracy_order_balanced)),
    ("unreadable", lambda row: percent(row.share_unparsable)),
    ("near ties", lambda row: percent(row.share_near_tie)),
]
"""What answers of VLM runs say by each score, in percent."""
ANSWER_MEASURES: list[Column] = [
    ("option mass", lambda row: number(row.option_mass)),
    ("letter bias", lambda row: number(row.letter_bias)),
]
"""What else there is to know of them, in no unit or logits."""
ANSWER_LEGEND = (
    "a constant answer is right in one half; without letter bias: options exchanged; letter bias: logits by which "
    "the option named first is preferred; near ties: choices that rounding may have made"
)


def rule_name(rows: Sequence[RetentionRow]) -> str:
    """The outcome rule of a table, as its title names it."""
    return f"outcome rule {', '.join(dict.fromkeys(row.rule for row in rows))}"


def retention_value(row: RetentionRow) -> str:
    """Bounded retention with its interval, or why there is none; after a mean, what it leaves out."""
    if not row.retention_defined:
        return row.retention_note
    return " ".join(filter(None, [bounded_value(row), row.retention_note and f"({row.retention_note})"]))


def bounded_value(row: RetentionRow) -> str:
    """Bounded retention with its interval; n/a where retention is not defined."""
    if not row.retention_defined:
        return "n/a"
    return with_limits(number(row.retention_bounded), row.retention_bounded_ci, number)


def area_value(row: RetentionRow) -> str:
    """Area retention with its interval; a dash where retention is not defined."""
    if not row.retention_defined:
        return "–"
    return with_limits(number(row.retention_area), row.retention_area_ci, number)


def debiased_value(row: RetentionRow) -> str:
    """Debiased retention with its interval; a dash where retention is not defined."""
    if not row.retention_defined:
        return "–"
    return with_limits(number(row.retention_debiased), row.retention_ci, number)


def plain_value(row: RetentionRow) -> str:
    """The published ratio; a dash where retention is not defined."""
    return number(row.retention) if row.retention_defined else "–"


FURTHER_RETENTION: list[Column] = [
    ("area [95 %]", area_value),
    ("debiased [95 %]", debiased_value),
    ("published", plain_value),
]
"""What stands behind bounded retention, which every table leads with."""


def margin_value(row: RetentionRow) -> str:
    """The Δ that decides the regime, in points: over as many items as count."""
    return percent(row.chance_margin)


def paper_margin(row: RetentionRow) -> str:
    """The paper's Δ in points, over episodes; it decides nothing here."""
    return percent(row.chance_margin_episodes)


def place(layer: int | None, iteration: int | None = None, ties: int | None = None) -> str:
    """Where the best site is: its layer, after @ the iteration where the stream has several, and after + how many
    other sites are as good.
    """
    if layer is None:
        return "–"
    more = f" +{ties}" if ties else ""
    return f"{layer}{more}" if iteration is None else f"{layer} @{iteration}{more}"


def backbone_place(row: RetentionRow) -> str:
    """Where the backbone's best site is."""
    return place(row.backbone_layer, None, row.backbone_ties)


def action_place(row: RetentionRow) -> str:
    """Where the best site of the action is."""
    return place(row.action_layer, row.action_iteration, row.action_ties)


def first_iteration(row: RetentionRow) -> str:
    """Accuracy of the best layer at the first iteration, in percent; a dash where the stream runs once."""
    return percent(row.action_first_accuracy)


def call_value(row: RetentionRow) -> str:
    """Which captured inference was probed, from 0; a dash without probes."""
    return "–" if row.call is None else str(row.call)


def call_words(call: int) -> str:
    """A captured inference in words: 0 is the only one before the arm has moved."""
    return f"call {call}" + (", before anything moves" if call == 0 else ", counted from 0")


def beats(row: RetentionRow) -> str:
    """What the backbone's best site is better than, and what not; says so if only chance was asked."""
    found = {name: better for name, better in row.backbone_exceeds.items() if better is not None}
    if set(found) == {"chance"}:
        return "against chance only" if found["chance"] else "not chance"
    return ", ".join(name if better else f"not {name}" for name, better in found.items()) or "–"


def once_per_category(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """Success rates do not depend on the view: the first row of each run and category."""
    return list({(row.run, row.category): row for row in reversed(rows)}.values())[::-1]


def title(what: str, rows: Sequence[RetentionRow]) -> str:
    """Title of a table: what it shows, on which suites, and whether any weights are random."""
    marked = "; random weights" if any(row.random_weights for row in rows) else ""
    marked += "; listened to: no success rate" if any(row.listened for row in rows) else ""
    return f"{what} ({', '.join(dict.fromkeys(row.suite for row in rows))}{marked})"


def probed(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """The rows that have probes."""
    return [row for row in rows if row.view is not None]


# -- controls ------------------------------------------------------------------------------------------------

ABOVE_CHANCE = "above chance"
"""How a cell ends that tables colour red: the suite gives the answer away without a model."""


def baseline(name: str) -> Callable[[RetentionRow], str]:
    """Writes a baseline's accuracy in percent, and whether it is above chance."""

    def cell(row: RetentionRow) -> str:
        return percent(row.baselines.get(name)) + (f" {ABOVE_CHANCE}" if name in row.leaks else "")

    return cell


CONTROL_PARTS: dict[str, Sequence[Column]] = {
    "What gives the answer away without the model": [
        ("position", baseline("position")),
        ("instruction", baseline("instruction")),
        ("pixels", baseline("pixels")),
        ("binding", baseline("binding")),
    ],
    "Selectivity": [
        ("selectivity: backbone", lambda row: percent(row.backbone_selectivity)),
        ("action", lambda row: percent(row.action_selectivity)),
    ],
    "Against the untrained network": [
        (
            "backbone − untrained",
            lambda row: with_limits(
                percent(row.backbone_minus_untrained), row.backbone_minus_untrained_ci, percent
            ),
        ),
        (
            "action − untrained",
            lambda row: with_limits(percent(row.action_minus_untrained), row.action_minus_untrained_ci, percent),
        ),
    ],
}
"""Columns of the controls, by the question they answer."""

CONTROL_COLUMNS: list[Column] = [
    ("category", category_name),
    *(column for columns in CONTROL_PARTS.values() for column in columns),
]


def controlled(rows: Sequence[RetentionRow]) -> bool:
    """Whether any row was held against a control."""
    return any(row.baselines or row.untrained for row in rows)


# -- wordings ------------------------------------------------------------------------------------------------

WORDING_COLUMNS: list[tuple[str, Callable[[WordingPair], str]]] = [
    ("wordings", lambda row: f"{row.wording} / {row.other}"),
    ("n", lambda row: str(row.n_episodes)),
    ("SR %", lambda row: f"{percent(row.sr)} / {percent(row.other_sr)}"),
    ("only one", lambda row: f"{row.only} / {row.only_other}"),
    ("p", lambda row: number(row.p, 3)),
    ("p by group", lambda row: number(row.p_groups, 3)),
    ("Holm", lambda row: number(row.p_holm, 3)),
]
"""Beside the category."""


def wording_title(row: WordingPair) -> str:
    """Whose wordings are compared."""
    return f"Wordings, {row.label}"
