"""The words of a retention table: texts of single values, terms that are no column, verdicts and sentences."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import ceil
from typing import Literal, cast

from probe_kit._system.counting import list_names, plural
from probe_kit._tables.numbers import NONE, Write, number, p_text, percent, whole_percent, with_limits
from probe_kit._tables.table import Cell, FixedText, absent
from probe_kit.hooks.contract.sites import label_of
from probe_kit.intervene.verdict import UNTESTED, UseVerdict
from probe_kit.retention.behaviour import Regime, SuccessRate
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.compare.models import ModelTest
from probe_kit.retention.estimators import NO_STEP
from probe_kit.retention.rows.row import RetentionRow, StreamPart
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import GROUPS_FOR_PROBES, items_for_absence
from probe_kit.suite.categories import category_of
from probe_kit.train.choices import EVERYWHERE, SIDES

Modes = Literal["acts", "answers", "both"]

RATE: Mapping[Modes, str] = {
    "acts": "Success rate",
    "answers": "Accuracy of answers",
    "both": "Success rate / accuracy of answers",
}
"""The share of right episodes at the head of a table or an axis."""


def modes_of(rows: Iterable[RetentionRow]) -> Modes:
    """Return the mode of all rows, `both` for a mixture."""
    modes = {row.run.mode for row in rows}
    return "both" if len(modes) > 1 else "answers" if modes == {"answers"} else "acts"


NOT_ACTED = "n/a"
"""The text in place of a success rate, for a model that did not act."""
ABOVE_CHANCE = "above chance"
"""The end of a cell that tables colour red: the suite gives the answer away without a model."""
P_DECIDES = "intervals and p come from different methods: where only one of them excludes zero, p decides"
"""The note on intervals and p.

The exact test under no difference has no inversion: it would be of zero width where all groups agree.
"""
_REGIMES = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


def site_cell(layer: int | None, iteration: int | None = None, ties: int | None = None) -> Cell:
    """Return where the best site is: its layer, after @ the iteration where the stream has several.

    After + follows the number of other sites that are as good.
    """
    if layer is None:
        return Cell(None)
    more = f" +{ties}" if ties else ""
    return Cell(layer, after=more if iteration is None else f" @{iteration}{more}")


# -- rows ----------------------------------------------------------------------------------------------------


def model_name(row: RetentionRow) -> str:
    """Return the model, marked if its weights are random or it did not act, and its group if there is one."""
    return row.run.name if row.group is None else f"{row.group}: {row.run.name}"


def success_interval(row: RetentionRow) -> Cell:
    """Return the SR in percent with its interval; n/a for a model that did not act or lacks trajectories."""
    if row.success.sr is None:
        return absent(NOT_ACTED)
    return Cell(row.success.sr, percent, row.success.ci)


def regime_value(row: RetentionRow) -> str:
    """Return the regime in a word or two; in a mean the normalised score."""
    if row.success.sr is None:
        return "did not act" if row.run.capture_only else "n/a"
    if row.success.regime is None:
        return f"score {number(row.success.normalised_score, 1)}"
    return _REGIMES[row.success.regime]


def retention_value(row: RetentionRow) -> Cell:
    """Return the retention with its interval; n/a where the backbone's signal is not shown."""
    if not row.retention.defined:
        return absent("n/a")
    return Cell(row.retention.value, number, row.retention.ci)


def published_value(row: RetentionRow) -> Cell:
    """Return the published ratio; a dash where retention is not defined."""
    return Cell(row.retention.published if row.retention.defined else None, number)


def call_words(call: int) -> str:
    """Return a captured inference in words: 0 is the only one before the arm has moved."""
    return f"call {call}" + (", before anything moves" if call == 0 else ", counted from 0")


def verdict_text(part: StreamPart) -> str:
    """Return the verdict of a stream, and how much there could be where it is not shown."""
    if part.verdict is None or part.at_most is None:
        return "–"
    most = f"{100 * part.at_most:.0f} %"
    words = {
        "shown": "shown",
        "absent": f"absent (at most {most})",
        "not shown": f"not shown (could be up to {most})",
    }
    return words[part.verdict]


def above_chance(part: StreamPart) -> Cell:
    """Return the score of a label above chance with its interval; a dash where no chance is known."""
    return Cell(None if part.chance is None else part.above, number, part.above_ci)


def exceeds_text(part: StreamPart) -> str:
    """Return the controls that the best site is shown to exceed, and those that it is not shown to exceed."""
    outcomes = {name: better for name, better in part.exceeds.items() if better is not None}
    if set(outcomes) == {"chance"}:
        return "chance (no control was run)" if outcomes["chance"] else "not shown: chance"
    exceeded = [name for name, better in outcomes.items() if better]
    open_ = [name for name, better in outcomes.items() if not better]
    return "; ".join(filter(None, [", ".join(exceeded), f"not shown: {', '.join(open_)}" if open_ else ""])) or "–"


# -- differences ---------------------------------------------------------------------------------------------


def difference_name(row: Difference) -> str:
    """Return minuend and subtrahend, with a mark if they ran other items or have only some in common."""
    mark = "" if row.paired else " (other items)"
    if row.paired and row.n_items is not None and row.n_items != row.of_items:
        mark = f" ({row.n_items} of {row.of_items} items)"
    return f"{row.group} − {row.minus}{mark}"


def difference_test(row: Difference) -> Cell:
    """Return p of a difference of success rates, and its Holm-corrected value."""
    return absent("") if row.p is None else Cell(row.p, p_text, after=f" ({p_text(row.p_holm)})")


def models_test(test: ModelTest | None, write: Write) -> Cell:
    """Return p over models, the least possible p, and Welch's interval; a dash for none.

    Empty without groups of models.

    Args:
        test: The test of a difference over models; None without groups of models.
        write: Formats a limit of the interval.
    """
    if test is None:
        return absent("")
    p = models_p(test)
    if None in test.ci:
        return replace(p, after=f"{p.after} {NONE}")
    return Cell(test.p, FixedText(p.text), test.ci, write_ends=write)


def models_p(test: ModelTest) -> Cell:
    """Return p over models and the least possible p; a dash where spreads allow none."""
    return Cell(test.p, p_text, after="" if test.p is None else f" ({p_text(test.smallest_p)})")


# -- tables --------------------------------------------------------------------------------------------------


def title_of(category: str) -> str:
    """Return a category as it is spelt in a table or at the beginning of a sentence."""
    return category_of(category).title


def name_of(row: RetentionRow) -> str:
    """Return the name of a row: its category, or its target where that is no side."""
    return name_of_target(row.target, row.category)


def name_of_target(target: str, category: str) -> str:
    """Return the category of a side; of another target its name, with the category where there is one."""
    if target in SIDES:
        return title_of(category)
    return target if category == EVERYWHERE else f"{target}, {title_of(category)}"


def by_run(rows: Sequence[RetentionRow]) -> list[list[RetentionRow]]:
    """Return the rows of each run, and group, in the order of their first ones."""
    runs: dict[tuple[str | None, str], list[RetentionRow]] = {}
    for row in rows:
        runs.setdefault(row.key, []).append(row)
    return list(runs.values())


def is_vlm(row: RetentionRow) -> bool:
    """Whether a row is of a VLM run."""
    return row.run.mode == "answers"


TERMS = {
    "call": ("Which inference of an episode was probed, counted from 0: call 0 comes before anything has moved."),
    "probe": (
        "A logistic regression that is shown activations of one layer and must name the side of the correct "
        "picture, in episodes and questions it was not fitted on."
    ),
    "reach": (
        "The distance between the actions of a policy that go left and those that go right: the unit in which the "
        "image swap moves an action."
    ),
    "n/a": (
        "The backbone's signal is not shown: its best layer is not shown to exceed chance and every control that "
        "was run. So there may be nothing to retain."
    ),
    "B − A": (
        "Difference of a run and the first one, or that of --reference, on the same questions. They count as "
        "pairs, with a 95 % interval. Zero inside it: they may be equal."
    ),
    "against": ("Before a verdict: the same, away from the correct picture."),
    "random weights": ("The model is untrained. It shows the numbers of a model that knows nothing."),
}
"""Terms of the glossary that are no column."""

VIEWER_WORDS = {
    "success": "The cube ends on the correct picture. Guessing reaches 50 %.",
    "Δ": "How far from 50 % guessing alone may lead. Success is shown beyond it.",
    "shown": "A stream's best site exceeds chance, family-wise, and every control that was run: its signal.",
    "not shown": "Neither shown nor absent: the items are too few to tell.",
    "absent": "For a linear probe of so many items: the best site can be at most as accurate as a stated limit, "
    "65 % by default, and so many items would have shown a site of that accuracy.",
    "retention": "Share of the backbone's accuracy above chance that is left where the action is made.",
    "used": "Swapping the two pictures turns the action: only an intervention shows it.",
    "log-odds": "How sure the probe is of the correct side in one episode; below zero it reads the other side.",
    "probe": TERMS["probe"],
    "call": TERMS["call"],
}
"""The words that the viewer explains."""


# -- verdicts -------------------------------------------------------------------------------------------------


def label_finding(row: RetentionRow) -> str:
    """Return whether probes decode the label in the backbone and how much of that is left in the action."""
    if not row.retention.defined:
        is_open = row.backbone.p_fwe is None or row.action.peak is None
        return f"{'open' if is_open else 'not shown'}: {_missing(row)}."
    action = label_of(row.action.stream or "action")
    if row.action.missed:
        missed = list_names(row.action.missed)
        where = f"in the {action} not beyond {missed}"
        return f"encoded, not shown in the action: probes read it in the backbone; {where}."
    share_left = (
        ""
        if row.retention.value is None
        else f"; {whole_percent(row.retention.value)} % of its score above chance is left"
    )
    return f"encoded and passed on: probes read it in the backbone and the {action}{share_left}."


def _missing(row: RetentionRow) -> str:
    """Return the condition that is lacking for retention to be defined."""
    backbone = row.backbone
    if backbone.peak is None or row.action.peak is None:
        return f"no site of the {'backbone' if backbone.peak is None else 'action'} was probed"
    if backbone.p_fwe is None:
        return "no permuted labels say what chance is; train with permutations"
    if row.retention.note == NO_STEP:
        return "the control step was not run, and the step of the episode may say as much"
    if backbone.missed and backbone.remedy:
        return f"no p can fall below the level: {backbone.remedy}"
    if backbone.missed:
        return f"probes of the backbone do no better than {list_names(backbone.missed)}"
    return "the backbone holds too little of it above chance to divide by"


def label_details(row: RetentionRow) -> str:
    """Return the finding with its numbers, their uncertainty and sizes; to follow the name."""
    where = f"(view {row.view})"
    if not row.retention.defined:
        return f"{where}: retention is not defined: {row.retention.reason}."
    share_left = with_limits(row.retention.value, row.retention.ci, number)
    missed = row.action.missed
    reached = f"not shown to exceed {', '.join(missed)}" if missed else f"signal there (p < {SIGNIFICANCE})"
    action = label_of(row.action.stream or "action")
    return (
        f"{where}: {share_left} of the backbone's score above chance is left in the {action}; {reached}. "
        f"{plural(row.controls.n_groups or 0, 'group')}, {plural(row.controls.n_samples or 0, 'sample')}."
    )


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


Readable = Literal[
    "known",
    "shown",
    "absent",
    "not shown",
    "success",
    "failure",
    "success not shown",
    "shown, success",
    "shown, failure",
    "shown, success not shown",
    "absent, success",
    "absent, failure",
    "not shown, success",
    "not shown, failure",
]
"""The backbone's evidence, then success, where no image swap is stored: these never say *used*."""
_EVIDENCE = {
    "shown": "The probes read the answer in the backbone better than chance and every control that was run allow",
    "absent": "No linear probe of so many items reaches a stated accuracy in the backbone, 65 % by default, and "
    "so many items would have shown it",
    "not shown": "Neither shown nor absent: the items are too few to tell",
}
_SUCCESS = {
    "success": "the policy is right more often than guessing explains",
    "failure": "the policy is right less often than guessing",
    "success not shown": "the success rate is one that guessing can reach",
}
_READABLE_HELP = {
    "known": "The VLM answers right more often than guessing explains.",
    **{name: f"{meaning}." for name, meaning in _EVIDENCE.items()},
    **{name: f"{_capital(meaning)}. No probes are stored." for name, meaning in _SUCCESS.items()},
    **{
        f"{evidence}, {success}": f"{read}; {behaviour}. Only an intervention shows whether the answer is used."
        for evidence, read in _EVIDENCE.items()
        for success, behaviour in _SUCCESS.items()
        if evidence == "shown" or success != "success not shown"
    },
}
_BEHAVIOUR_HELP = {
    "used": "A swap turns the action to the other side in at least half of the episodes, by at least half of the "
    "reach: the distance between its own actions to the left and to the right.",
    "partly used, one-sided": "A swap turns the action where the answer lies on the named side only.",
    "partly used, graded": "A swap turns the action in fewer episodes, or by less, than where it is used.",
    "moves with it, does not decide": "A swap moves the action by a tenth of the reach, and does not turn it.",
    "not used": "A swap moves the action by less than a tenth of the reach; another category is used.",
    "undecided": "The numbers do not decide whether the answer is used; the sentence says what is missing.",
}
VERDICT_HELP = _READABLE_HELP | _BEHAVIOUR_HELP
"""The meaning of each verdict, as an entry of the glossary."""


def verdict(row: RetentionRow) -> str:
    """Return the verdict of a row: is the answer in the backbone, and does the policy act on it?

    With a stored image swap the verdict is that of `probe_kit.intervene.classify_use`. Where the answer is neither
    used nor read in the backbone, and without an image swap, it is `readable`.
    """
    use = row.image_swap.use
    return readable(row) if use is None or _is_neither_used_nor_found(row, use) else use.verdict


def _is_neither_used_nor_found(row: RetentionRow, use: UseVerdict) -> bool:
    """Whether the image swap bounds the use, and probes did not find the answer."""
    return use.is_bounded and is_probed(row) and not row.backbone.has_signal


def readable(row: RetentionRow) -> Readable:
    """Return the verdict of a row without an intervention: the backbone's evidence, and success.

    *Shown*: the backbone's best site exceeds chance, family-wise, and every control that was run. *Absent*: it is
    below a stated accuracy, else *not shown*. *Success*: SR in the regime of knowledge; *failure*: SR in that of
    failure. Success does not say that the answer in the backbone is what the action uses. A VLM knows a category
    in which it answers in the regime of knowledge, else that is *not shown*.
    """
    if is_vlm(row):
        return "known" if knows(row) else "not shown"
    nothing: Readable = "absent" if row.backbone.verdict == "absent" else "not shown"
    if row.image_swap.use is not None and _is_neither_used_nor_found(row, row.image_swap.use):
        return nothing
    evidence: Readable = "shown" if row.backbone.has_signal else nothing
    if row.success.sr is None:
        return evidence
    success = _success(row)
    if not is_probed(row):
        return success
    if success == "success not shown" and evidence != "shown":
        return evidence
    return cast("Readable", f"{evidence}, {success}")


def _success(row: RetentionRow) -> Literal["success", "failure", "success not shown"]:
    """Return the success of a policy against guessing."""
    if knows(row):
        return "success"
    return "failure" if row.success.regime == Regime.FAILURE else "success not shown"


def knows(row: RetentionRow) -> bool:
    """Whether its success rate is in the regime of knowledge."""
    return row.success.regime == Regime.KNOWLEDGE


# -- what follows --------------------------------------------------------------------------------------------

_UNTESTED = f"{UNTESTED}: run `probe-kit intervene`"
_LATER = "Yet the policy succeeds: actions after the first inference may follow."
"""A note on the image swap, which reads the actions of the first inference."""


def conclusion(row: RetentionRow) -> str:
    """Return the conclusion from a row, and what to do next; of a label with its numbers."""
    if row.label:
        return label_details(row)
    if is_vlm(row):
        return "The VLM knows the answer." if knows(row) else "Not shown that the VLM knows the answer."
    use = row.image_swap.use
    is_later = use is not None and use.is_bounded and use.is_of_first_chunk and knows(row)
    parts = [_finding(row) if use is None else _use_sentence(row, use), _LATER * is_later]
    if not is_probed(row):
        has_activations = row.run.action_stream is not None
        can_be_probed = has_activations and (row.success.n_groups or 0) >= GROUPS_FOR_PROBES
        parts.append(f"{_capital(why_unprobed(row))}{': run `probe-kit train`' * can_be_probed}.")
    return " ".join(filter(None, parts))


def _use_sentence(row: RetentionRow, use: UseVerdict) -> str:
    """Return the sentence of a row with a stored image swap: behaviour; place; tie."""
    if _is_neither_used_nor_found(row, use):
        return f"{_nothing_shown(row)} {use.sentence}"
    return use.sentence


def _finding(row: RetentionRow) -> str:
    """Return the sentence of a row without a stored image swap."""
    reading = readable(row)
    if not is_probed(row):
        return _behaviour_sentence(row)
    if reading == "shown":
        return "Shown in the backbone."
    if reading.startswith("shown, "):
        return f"Shown in the backbone; {_behaviour(row)}; {_UNTESTED}."
    if not knows(row):
        return _nothing_shown(row)
    return f"The policy succeeds; the answer is {_backbone(row)}; {_UNTESTED}."


def _behaviour_sentence(row: RetentionRow) -> str:
    """Return the sentence of behaviour alone; empty where the model did not act."""
    if row.success.sr is None:
        return ""
    return f"{_capital(_behaviour(row))}; {_UNTESTED}."


def _nothing_shown(row: RetentionRow) -> str:
    """Return the sentence of a backbone without signal: the decided part first, then the open part."""
    absent = row.backbone.verdict == "absent"
    behaviour = _behaviour(row)
    backbone = _backbone(row)
    parts = [backbone, behaviour] if absent or behaviour == _NOT_SHOWN else [behaviour, backbone]
    clauses = "; ".join(filter(None, parts))
    remedy = ""
    if not absent:
        remedy = f": {row.backbone.remedy or more_items(row) or _POWER}"
    elif behaviour == _NOT_SHOWN:
        remedy = _items_for_success(row.success)
    return f"{_capital(clauses)}{remedy}."


_NOT_SHOWN = "success is not shown"
_POWER = "`probe-kit power` simulates how many items would show it"


def more_items(row: RetentionRow) -> str:
    """Return how many items it takes at least to call a backbone without the answer absent; empty for so many."""
    success = row.success
    if not success.n_items or not success.n_groups or not success.n_episodes:
        return ""
    needed = items_for_absence(success.n_items, success.n_groups, success.n_episodes)
    return (
        f"with fewer than {needed} items, probes cannot show that the backbone lacks it"
        if needed > success.n_items
        else ""
    )


def _items_for_success(success: SuccessRate) -> str:
    """Return the number of items with which guessing would no longer explain the rate, if it stays.

    Empty for a rate of one half.
    """
    if success.sr is None or not success.chance_margin or not success.n_items or success.sr == 0.5:
        return ""
    # The margin shrinks with the root of the number of items.
    needed = ceil(success.n_items * (success.chance_margin / (success.sr - 0.5)) ** 2)
    return f": a rate of {whole_percent(success.sr)} % takes about {needed} items" * (needed > success.n_items)


def _backbone(row: RetentionRow) -> str:
    """Return the evidence of a backbone without signal, in words."""
    if row.backbone.verdict == "absent":
        return "absent from the backbone for a linear probe of so many items"
    return "not shown in the backbone"


def _behaviour(row: RetentionRow) -> str:
    """Return the success of the policy in words; empty if it did not act, or an image swap says more."""
    if row.image_swap.use is not None or row.success.sr is None:
        return ""
    words = {
        "success": "the policy succeeds",
        "failure": "the policy is right less often than guessing",
        "success not shown": _NOT_SHOWN,
    }
    return words[_success(row)]


def is_probed(row: RetentionRow) -> bool:
    """Whether probes of the backbone are stored."""
    return bool(row.backbone.exceeds)


def why_unprobed(row: RetentionRow) -> str:
    """Return the reason why the backbone has no numbers: no probes are stored, or only of other categories."""
    return "the backbone was not probed" if row.run.probes is None else "the probes are not of this category"


def chance_only(rows: Sequence[RetentionRow]) -> str:
    """Return a warning that names the runs whose probes were compared with no control; empty where all were."""
    probed = [row for row in rows if is_probed(row)]
    names = list(dict.fromkeys(model_name(row) for row in probed if not row.backbone.is_controlled))
    if not names:
        return ""
    several = len({model_name(row) for row in rows}) > 1
    of_runs = f" for {', '.join(names)}" if several else ""
    return (
        f"No control was run{of_runs}: a signal is judged against chance only, and pictures and words alone may "
        "give the answer away. Run `probe-kit train RUN`, with --suite FOLDER where it cannot find the suite"
    )


# -- warnings -------------------------------------------------------------------------------------------------

_MOSTLY = 0.5  # share of episodes above which something is said first


def warnings_of(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[str]:
    """Return warnings about numbers that are easily misread, of a run's categories and their mean, in a view."""
    sentences = []
    if mean.run.random_weights:
        sentences.append("The weights are random: the model is untrained. Read every number as “knows nothing”.")
    sentences += _vlm_warnings(mean) if is_vlm(mean) else _policy_warnings(mean)
    biased = [
        row
        for row in rows
        if row.success.side_preference is not None and abs(row.success.side_preference - 0.5) > 0.25
    ]
    if biased:
        habit = "The answers have a habit of naming" if is_vlm(mean) else "The policy has a habit of going to"
        sentences.append(f"{habit} one side in {_count_categories(biased, rows)}.")
    if uncontrolled := chance_only(rows):
        sentences.append(f"{uncontrolled}.")
    if mean.controls.leaks:
        sentences.append(
            f"The suite gives answers away without a model ({', '.join(mean.controls.leaks)}): see the "
            "controls before believing a probe."
        )
    return sentences


def _vlm_warnings(mean: RetentionRow) -> list[str]:
    """Return warnings about a model that was asked."""
    if (mean.success.share_outside or 0) <= _MOSTLY:
        return []
    unread = percent(mean.success.share_outside)
    return [f"No answer could be read in {unread} % of episodes: it may know more than it says."]


def _policy_warnings(mean: RetentionRow) -> list[str]:
    """Return warnings about a policy."""
    sentences = []
    if (mean.success.share_never_moved or 0) > _MOSTLY:
        sentences.append(
            f"The cube never moved in {percent(mean.success.share_never_moved)} % of episodes: "
            "the policy does not grasp, so its success rate is no measure of what it knows."
        )
    elif (mean.success.share_outside or 0) > _MOSTLY:
        sentences.append(
            f"The cube reached neither picture in {percent(mean.success.share_outside)} % of episodes."
        )
    if mean.success.share_invalid_action:
        sentences.append(
            f"In {percent(mean.success.share_invalid_action)} % of its steps the policy put out "
            "something that is no action."
        )
    return sentences


def _names(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """Return the shorter of two lists: the categories in `part`, or those that are not."""
    absent = [row for row in rows if row not in part]
    listed, prefix = (absent, "all but ") if len(absent) < len(part) else (part, "")
    return prefix + ", ".join(title_of(row.category) for row in listed)


def _count_categories(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """Return how many of the categories are in `part`, and their names if not all are."""
    noun = "category" if len(rows) == 1 else "categories"
    if len(part) == len(rows):
        return f"all {len(rows)} {noun}" if len(rows) > 1 else "the only category"
    names = f" ({_names(part, rows)})" if part else ""
    return f"{len(part) or 'none'} of {len(rows)} {noun}{names}"
