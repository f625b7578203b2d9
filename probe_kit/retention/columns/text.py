"""The words of a retention table: texts of single values, of modes, and terms that are no column."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

from probe_kit._tables.numbers import NONE, Write, number, p_text, percent, with_limits
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.compare.models import ModelTest
from probe_kit.retention.rows.row import RetentionRow, StreamPart
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
    """Return what all rows did, `both` for a mixture."""
    modes = {row.run.mode for row in rows}
    return "both" if len(modes) > 1 else "answers" if modes == {"answers"} else "acts"


NOT_ACTED = "n/a"
"""In place of a success rate, for a model that did not act."""
ABOVE_CHANCE = "above chance"
"""How a cell ends that tables colour red: the suite gives the answer away without a model."""
P_DECIDES = "intervals are of another method than p: where one of the two excludes zero alone, p decides"
"""The exact test under no difference has no inversion: it would be of zero width where all groups agree."""
_REGIMES = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


def site_text(layer: int | None, iteration: int | None = None, ties: int | None = None) -> str:
    """Return where the best site is: its layer, after @ the iteration where the stream has several.

    After + stands how many other sites are as good.
    """
    if layer is None:
        return "–"
    more = f" +{ties}" if ties else ""
    return f"{layer}{more}" if iteration is None else f"{layer} @{iteration}{more}"


# -- rows ----------------------------------------------------------------------------------------------------


def model_name(row: RetentionRow) -> str:
    """The model, marked if its weights are random or it did not act, and its group if there is one."""
    return row.run.name if row.group is None else f"{row.group}: {row.run.name}"


def success_interval(row: RetentionRow) -> str:
    """SR in percent with its interval; n/a for a model that did not act, or for a rule that needs trajectories."""
    if row.success.sr is None:
        return NOT_ACTED
    return with_limits(row.success.sr, row.success.ci, percent)


def regime_value(row: RetentionRow) -> str:
    """The regime in a word or two; in a mean the normalised score."""
    if row.success.sr is None:
        return "did not act" if row.run.capture_only else "n/a"
    if row.success.regime is None:
        return f"score {number(row.success.normalised_score, 1)}"
    return _REGIMES[row.success.regime]


def retention_value(row: RetentionRow) -> str:
    """Retention with its interval; n/a where the backbone's signal is not shown."""
    if not row.retention.defined:
        return "n/a"
    return with_limits(row.retention.value, row.retention.ci, number)


def published_value(row: RetentionRow) -> str:
    """The published ratio; a dash where retention is not defined."""
    return number(row.retention.published) if row.retention.defined else "–"


def call_words(call: int) -> str:
    """A captured inference in words: 0 is the only one before the arm has moved."""
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


def above_chance(part: StreamPart) -> str:
    """Return the score of a label above chance with its interval; a dash where no chance is known."""
    return NONE if part.chance is None else with_limits(part.above, part.above_ci, number)


def exceeds_text(part: StreamPart) -> str:
    """The controls that the best site is shown to exceed, and those that it is not shown to exceed."""
    outcomes = {name: better for name, better in part.exceeds.items() if better is not None}
    if set(outcomes) == {"chance"}:
        return "chance (no control was run)" if outcomes["chance"] else "not shown: chance"
    exceeded = [name for name, better in outcomes.items() if better]
    open_ = [name for name, better in outcomes.items() if not better]
    return "; ".join(filter(None, [", ".join(exceeded), f"not shown: {', '.join(open_)}" if open_ else ""])) or "–"


# -- differences ---------------------------------------------------------------------------------------------


def difference_name(row: Difference) -> str:
    """Minuend and subtrahend, and that they ran other items, or how many they have in common if not all."""
    mark = "" if row.paired else " (other items)"
    if row.paired and row.n_items is not None and row.n_items != row.of_items:
        mark = f" ({row.n_items} of {row.of_items} items)"
    return f"{row.group} − {row.minus}{mark}"


def difference_test(row: Difference) -> str:
    """p of a difference of success rates, and corrected by Holm."""
    return "" if row.p is None else f"{p_text(row.p)} ({p_text(row.p_holm)})"


def models_test(test: ModelTest | None, write: Write) -> str:
    """p over models, the least possible one, and Welch's interval in the format `write`; a dash for none.

    Empty without groups of models.
    """
    if test is None:
        return ""
    low, high = test.ci
    limits = NONE if low is None or high is None else f"[{write(low)}, {write(high)}]"
    return f"{models_p(test)} {limits}"


def models_p(test: ModelTest) -> str:
    """p over models and the least possible one; a dash where spreads allow none."""
    return p_text(None) if test.p is None else f"{p_text(test.p)} ({p_text(test.smallest_p)})"


# -- tables --------------------------------------------------------------------------------------------------


def title_of(category: str) -> str:
    """Return a category as it is spelt in a table or at the beginning of a sentence."""
    return category_of(category).title


def name_of(row: RetentionRow) -> str:
    """Return what a row is about: its category, or its target where that is no side."""
    return name_of_target(row.target, row.category)


def name_of_target(target: str, category: str) -> str:
    """Return the category of a side; of another target its name, with the category where there is one."""
    if target in SIDES:
        return title_of(category)
    return target if category == EVERYWHERE else f"{target}, {title_of(category)}"


def once_per_category(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """Success rates do not depend on the view: the first row of each run and category."""
    # Twice reversed: of a key named twice a dict keeps the first place and the last value.
    return list({(row.run.location, row.category): row for row in reversed(rows)}.values())[::-1]


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
        "Difference of a run and the first one, or that of --compare, on the same questions. They count as pairs, "
        "with a 95 % interval. Zero inside it: they may be equal."
    ),
    "against": ("Before a verdict: the same, away from the correct picture."),
    "random weights": ("The model is untrained. It shows the numbers of a model that knows nothing."),
}
"""Terms that are no column."""

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
