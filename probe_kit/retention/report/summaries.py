"""What the tables say, in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.modes import RATE, modes_of
from probe_kit.retention.columns.text import NOT_ACTED, is_vlm, model_name, percent
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.text import spell
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.results.control_scores import Exceeds

_MOSTLY = 0.5  # share of episodes above which something is said first


@dataclass(frozen=True)
class Headline:
    """One number of a run's summary, and what it is."""

    value: str
    name: str
    gloss: str


@dataclass(frozen=True)
class Summary:
    """A run and view in a few numbers and sentences. warnings: what would be misread without them."""

    name: str
    view: str | None
    random_weights: bool
    headlines: tuple[Headline, ...]
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    by_category: tuple[tuple[str, str], ...]


def summarise(rows: Sequence[RetentionRow]) -> Summary:
    """The summary of one run and view. rows: its categories, and their mean."""
    mean = next(row for row in rows if row.category == MEAN)
    single = [row for row in rows if row.category != MEAN]
    return Summary(
        name=model_name(mean).replace(" (random weights)", ""),
        view=mean.view,
        random_weights=mean.run.random_weights,
        headlines=tuple(_headlines(mean, single)),
        sentences=tuple(_sentences(mean, single)),
        warnings=tuple(_warnings(mean, single)),
        by_category=tuple((spell(row.category), " ".join(read_row(row))) for row in single),
    )


def _headlines(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[Headline]:
    rate = Headline(f"{percent(mean.success.sr)} %", RATE[modes_of([mean])].lower(), "guessing: 50 %")
    found = [
        Headline(NOT_ACTED, "success rate", "it captured activations only and did not act")
        if mean.run.capture_only
        else rate
    ]
    if mean.backbone.score is not None:
        found.append(Headline(f"{percent(mean.backbone.score)} %", "backbone", "mean of categories"))
    if mean.action.score is not None:
        found.append(Headline(f"{percent(mean.action.score)} %", mean.run.action_name, "mean of categories"))
    if mean.backbone.score is not None and mean.action.score is not None:
        found.append(_retention_headline(mean, rows))
    return found


def _retention_headline(mean: RetentionRow, rows: Sequence[RetentionRow]) -> Headline:
    if not mean.retention.defined or mean.retention.value is None:
        return Headline("n/a", "retention", _why_not(rows))
    return Headline(f"{mean.retention.value:.2f}", "retention", _interval_words(mean))


def _interval_words(row: RetentionRow) -> str:
    if row.retention.ci is None:
        return "no interval"
    low, high = row.retention.ci
    return "no limits" if low is None or high is None else f"95 % interval {low:.2f} to {high:.2f}"


def _sentences(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[str]:
    found = [_behaviour(mean, rows)]
    if any(row.backbone.score is not None for row in rows):
        found.append(_knowledge(rows))
    if any(row.retention.published is not None for row in rows):
        found.append(_retention(mean, rows))
    if mean.controls.probe_minus_sr is not None and any(row.backbone.has_signal for row in rows):
        found.append(
            f"On average the backbone's best probe is right {abs(100 * mean.controls.probe_minus_sr):.0f} points "
            f"{'more' if mean.controls.probe_minus_sr >= 0 else 'less'} often than {_what_is_judged(mean)}."
        )
    return found


def _behaviour(mean: RetentionRow, rows: Sequence[RetentionRow]) -> str:
    if mean.run.capture_only:
        return "The model was captured at the first picture of every episode and did not act: no success rate."
    knows = [row for row in rows if row.success.regime == Regime.KNOWLEDGE]
    fails = [row for row in rows if row.success.regime == Regime.FAILURE]
    right = "It answers right in" if is_vlm(mean) else "The cube ended on the correct picture in"
    text = f"{right} {percent(mean.success.sr)} % of episodes, averaged over categories. "
    text += f"In {_of(knows, rows)} that is more than guessing explains"
    return text + (f"; in {_of(fails, rows)} it is less." if fails else ".")


def _what_is_judged(mean: RetentionRow) -> str:
    return "its answers" if is_vlm(mean) else "the policy"


def _knowledge(rows: Sequence[RetentionRow]) -> str:
    backbone = [row for row in rows if row.backbone.has_signal]
    expert = [row for row in rows if row.action.has_signal]
    text = f"A linear probe reads the answer above {_judge(rows)} in the backbone in {_of(backbone, rows)}"
    if any(row.action.score is not None for row in rows):
        text += f", and in the {rows[0].run.action_name} in {_of(expert, rows)}"
    return f"{text}."


def _judge(rows: Sequence[RetentionRow]) -> str:
    """What had to be beaten."""
    names = [
        name
        for name in ("random-features", "untrained")
        if any(row.backbone.exceeds.get(name) is not None for row in rows)
    ]
    *first, last = ["chance", *names]
    return f"{', '.join(first)} and {last}" if names else "chance (no control was run)"


def _retention(mean: RetentionRow, rows: Sequence[RetentionRow]) -> str:
    counted = [row for row in rows if row.retention.defined]
    if not counted or mean.retention.value is None:
        return f"Retention is not defined: {_why_not(rows)}."
    left = f" ({len(mean.left_out)} left out: {_why_not(rows)})" if mean.left_out else ""
    return (
        f"Of what can be read in the backbone above chance, a share of {mean.retention.value:.2f} can still be "
        f"read in the {mean.run.action_name} ({_interval_words(mean)}), "
        f"over {_of(counted, rows, names=False)}{left}."
    )


def _why_not(rows: Sequence[RetentionRow]) -> str:
    """What keeps categories from having a retention, each reason once."""
    notes = [row.retention.note for row in rows if not row.retention.defined]
    return "; ".join(dict.fromkeys(note.removeprefix("n/a (").removesuffix(")") for note in notes))


def _warnings(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[str]:
    found = []
    if mean.run.random_weights:
        found.append("The weights are random: the model is untrained. Read every number as “knows nothing”.")
    found += _unread(mean) if is_vlm(mean) else _unmoved(mean)
    biased = [
        row
        for row in rows
        if row.success.side_preference is not None and abs(row.success.side_preference - 0.5) > 0.25
    ]
    if biased:
        habit = "The answers have a habit of naming" if is_vlm(mean) else "The policy has a habit of going to"
        found.append(f"{habit} one side in {_of(biased, rows)}.")
    if mean.controls.leaks:
        found.append(
            f"The suite gives answers away without a model ({', '.join(mean.controls.leaks)}): see the "
            "controls before believing a probe."
        )
    return found


def _unread(mean: RetentionRow) -> list[str]:
    """What would be misread of a model that was asked."""
    if (mean.success.share_outside or 0) <= _MOSTLY:
        return []
    unread = percent(mean.success.share_outside)
    return [f"No answer could be read in {unread} % of episodes: it may know more than it says."]


def _unmoved(mean: RetentionRow) -> list[str]:
    """What would be misread of a policy."""
    found = []
    if (mean.success.share_never_moved or 0) > _MOSTLY:
        found.append(
            f"The cube never moved in {percent(mean.success.share_never_moved)} % of episodes: "
            "the policy does not grasp, so its success rate is no measure of what it knows."
        )
    elif (mean.success.share_outside or 0) > _MOSTLY:
        found.append(f"The cube reached neither picture in {percent(mean.success.share_outside)} % of episodes.")
    if mean.success.share_invalid_action:
        found.append(
            f"In {percent(mean.success.share_invalid_action)} % of its steps the policy put out "
            "something that is no action."
        )
    return found


def read_row(row: RetentionRow) -> list[str]:
    """One category in sentences."""
    if row.success.sr is None:
        found = [
            f"Captured in {row.success.n_episodes} episodes; it did not act."
            if row.run.capture_only
            else f"{RATE[modes_of([row])]} {row.success.reason}."
        ]
    else:
        right = round(row.success.sr * row.success.n_episodes)
        found = [
            f"Right in {right} of {row.success.n_episodes} episodes ({row.success.regime}: {row.success.reason})."
        ]
    if (paired := row.success.paired) is not None:
        items = paired.both + paired.one + paired.none
        found.append(f"{paired.both} of {items} questions right in both layouts.")
    if row.backbone.score is not None:
        found.append(
            f"In the backbone a probe is right in {percent(row.backbone.score)} %, best at depth "
            f"{row.backbone.depth:.2f}{_ties_words(row.backbone.ties)}: "
            f"{_clear_words(row.backbone.p_fwe, row.backbone.exceeds)}."
        )
    if row.action.score is not None:
        step = "" if row.action.iteration is None else f", iteration {row.action.iteration}"
        found.append(
            f"In the {row.run.action_name} {percent(row.action.score)} %, best at depth {row.action.depth:.2f}"
            f"{step}{_ties_words(row.action.ties)}: {_clear_words(row.action.p_fwe, row.action.exceeds)}."
        )
    if row.retention.defined and row.retention.value is not None:
        found.append(f"Retention {row.retention.value:.2f} ({_interval_words(row)}).")
    return found


def _ties_words(ties: int | None) -> str:
    return f" and at {ties} other site{'s' * (ties > 1)} as well" if ties else ""


def _clear_words(p: float | None, exceeds: Exceeds) -> str:
    if p is None:
        return "not tested, for lack of label permutations"
    controls = {
        "random-features": "an untrained conjunction of pictures and words",
        "untrained": "the untrained network",
    }
    missed = [words for name, words in controls.items() if exceeds.get(name) is False]
    clear = p < SIGNIFICANCE
    unshown = " or ".join(missed if clear else ["chance", *missed])
    words = ["above chance"] if clear else []
    words += [f"not shown to beat {unshown}"] if unshown else []
    return f"{' but '.join(words)}, p = {p:.3f}"


def _names(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """The shorter of the two lists: those that are in, or those that are not."""
    rest = [row for row in rows if row not in part]
    shown, prefix = (rest, "all but ") if len(rest) < len(part) else (part, "")
    return prefix + ", ".join(spell(row.category) for row in shown)


def _of(part: Sequence[RetentionRow], rows: Sequence[RetentionRow], names: bool = True) -> str:
    """How many of the categories, and which if not all."""
    noun = "category" if len(rows) == 1 else "categories"
    if len(part) == len(rows):
        return f"all {len(rows)} {noun}" if len(rows) > 1 else "the only category"
    named = f" ({_names(part, rows)})" if part and names else ""
    return f"{len(part) or 'none'} of {len(rows)} {noun}{named}"
