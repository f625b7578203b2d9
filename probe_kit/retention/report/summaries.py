"""Sentences that say what the tables hold."""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import p_text, percent
from probe_kit.retention.columns.sentences import chance_only
from probe_kit.retention.columns.text import RATE, is_vlm, model_name, modes_of, title_of
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.results.control_scores import Exceeds

_MOSTLY = 0.5  # share of episodes above which something is said first


@dataclass(frozen=True)
class RunInWords:
    """A run and view in sentences, beside the summary. warnings: what would be misread without them."""

    name: str
    view: str | None
    random_weights: bool
    warnings: tuple[str, ...]
    by_category: tuple[tuple[str, str], ...]


def read_run(rows: Sequence[RetentionRow]) -> RunInWords:
    """One run and view in sentences. rows: its categories, and their mean."""
    mean = next(row for row in rows if row.category == MEAN)
    single = [row for row in rows if row.category != MEAN]
    return RunInWords(
        name=model_name(mean).replace(" (random weights)", ""),
        view=mean.view,
        random_weights=mean.run.random_weights,
        warnings=tuple(_warnings(mean, single)),
        by_category=tuple((title_of(row.category), " ".join(read_row(row))) for row in single),
    )


def _interval_words(row: RetentionRow) -> str:
    if row.retention.ci is None:
        return "no interval"
    low, high = row.retention.ci
    return "no limits" if low is None or high is None else f"95 % interval {low:.2f} to {high:.2f}"


def _warnings(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[str]:
    sentences = []
    if mean.run.random_weights:
        sentences.append("The weights are random: the model is untrained. Read every number as “knows nothing”.")
    sentences += _unread(mean) if is_vlm(mean) else _unmoved(mean)
    biased = [
        row
        for row in rows
        if row.success.side_preference is not None and abs(row.success.side_preference - 0.5) > 0.25
    ]
    if biased:
        habit = "The answers have a habit of naming" if is_vlm(mean) else "The policy has a habit of going to"
        sentences.append(f"{habit} one side in {_of(biased, rows)}.")
    if uncontrolled := chance_only(rows):
        sentences.append(f"{uncontrolled}.")
    if mean.controls.leaks:
        sentences.append(
            f"The suite gives answers away without a model ({', '.join(mean.controls.leaks)}): see the "
            "controls before believing a probe."
        )
    return sentences


def _unread(mean: RetentionRow) -> list[str]:
    """Return warnings about a model that was asked."""
    if (mean.success.share_outside or 0) <= _MOSTLY:
        return []
    unread = percent(mean.success.share_outside)
    return [f"No answer could be read in {unread} % of episodes: it may know more than it says."]


def _unmoved(mean: RetentionRow) -> list[str]:
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


def read_row(row: RetentionRow) -> list[str]:
    """One category in sentences."""
    if row.success.sr is None:
        sentences = [
            f"Captured in {row.success.n_episodes} episodes; it did not act."
            if row.run.capture_only
            else f"{RATE[modes_of([row])]} {row.success.reason}."
        ]
    else:
        right = round(row.success.sr * row.success.n_episodes)
        sentences = [
            f"Right in {right} of {row.success.n_episodes} episodes ({row.success.regime}: {row.success.reason})."
        ]
    if (paired := row.success.paired) is not None:
        items = paired.both + paired.one + paired.none
        sentences.append(f"{paired.both} of {items} questions right in both layouts.")
    if row.backbone.score is not None:
        sentences.append(
            f"In the backbone a probe is right in {percent(row.backbone.score)} %, best at depth "
            f"{row.backbone.depth:.2f}{_ties_words(row.backbone.ties)}: "
            f"{_clear_words(row.backbone.p_fwe, row.backbone.exceeds)}."
        )
    if row.action.score is not None:
        step = "" if row.action.iteration is None else f", iteration {row.action.iteration}"
        sentences.append(
            f"In the {row.run.action_name} {percent(row.action.score)} %, best at depth {row.action.depth:.2f}"
            f"{step}{_ties_words(row.action.ties)}: {_clear_words(row.action.p_fwe, row.action.exceeds)}."
        )
    if row.retention.defined and row.retention.value is not None:
        sentences.append(f"Retention {row.retention.value:.2f} ({_interval_words(row)}).")
    elif row.retention.note:
        sentences.append(f"Retention {row.retention.note}.")
    return sentences


def _ties_words(ties: int | None) -> str:
    return f" and at {counted(ties, 'other site')} as well" if ties else ""


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
    equals = "" if p < 0.001 else "= "
    return f"{' but '.join(words)}, p {equals}{p_text(p)}"


def _names(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """The shorter of the two lists: those that are in, or those that are not."""
    absent = [row for row in rows if row not in part]
    listed, prefix = (absent, "all but ") if len(absent) < len(part) else (part, "")
    return prefix + ", ".join(title_of(row.category) for row in listed)


def _of(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """Return how many of the categories, and which if not all."""
    noun = "category" if len(rows) == 1 else "categories"
    if len(part) == len(rows):
        return f"all {len(rows)} {noun}" if len(rows) > 1 else "the only category"
    names = f" ({_names(part, rows)})" if part else ""
    return f"{len(part) or 'none'} of {len(rows)} {noun}{names}"
