"""Answer, probe, success: a VLM's answers, a probe's decisions and a policy's actions, question by question.

Answered: the VLM answers right. Encoded: the probe's held-out decision is right, where probes beat chance,
random-features and untrained. Acted on: the cube ends right. The unit is the item, right in both layouts. A fixed
side is right in exactly one layout, so a bias never counts. Guessing is right in both for 25 % of items.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.retention.behaviour import TableRun, units_of
from probe_kit.retention.estimators import best_site
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader, check_sides
from probe_kit.statistics.paired_tests import (
    clopper_pearson,
    fisher_p,
    flip_p,
    holm_corrected,
    mcnemar_p,
    overlap_p,
)
from probe_kit.train.results.control_scores import has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd

Bools = NDArray[np.bool_]
COIN = 0.25
"""Share of items that a coin gets right in both layouts."""
PAIRS = (("answered", "acted"), ("encoded", "acted"), ("answered", "encoded"))
OVERALL = "all"
_MOST_NAMED = 3


@dataclass(frozen=True)
class StageTest:
    """A test whether two of the three are right of equally many items.

    Attributes:
        only_first: Items that the first alone gets right.
        only_second: Items that the second alone gets right.
        p_mcnemar: Exact over items.
        p_groups: The same, whole groups of items turned together.
        p: The larger of the two.
        p_holm: Corrected over all categories and pairs, of all joins that are shown together.
    """

    first: str
    second: str
    only_first: int
    only_second: int
    p_mcnemar: float
    p_groups: float
    p: float
    p_holm: float | None = None


@dataclass(frozen=True)
class CategoryCounts:
    """One category, or all of them (`all`).

    Attributes:
        answered_correctly: Items whose answer is right in both layouts.
        encoded: Items whose probe is right in both layouts; None without probes.
        acted_correctly: Items with success in both layouts.
        counts: Items by these three, such as `101` for answered, not encoded, acted on; without probes `1-1`.
        guessed: The counts that coins would give.
        episodes: The same counts of single episodes; nothing is tested there.
        has_signal: Whether the probes beat chance and every control that was run, without which encoded means
            nothing. None without probes, or over categories that differ in it.
        not_acted_on: Of the items answered right and encoded, those that the action does not follow. None without
            signal, and over all categories only of those with signal.
        share_not_acted_on_ci: Exact 95 % interval of their share.
        p_linked: Test whether answered and acted on go together among encoded items: Fisher's exact test, over
            categories a permutation within them.
    """

    category: str
    n_items: int
    n_groups: int
    answered_correctly: int
    encoded: int | None
    acted_correctly: int
    counts: Mapping[str, int]
    guessed: Mapping[str, float]
    episodes: Mapping[str, int]
    has_signal: bool | None
    comparisons: tuple[StageTest, ...]
    answered_and_encoded: int | None = None
    not_acted_on: int | None = None
    share_not_acted_on: float | None = None
    share_not_acted_on_ci: tuple[float, float] | None = None
    p_linked: float | None = None


@dataclass(frozen=True)
class KnownUsedTable:
    """A VLM run and a policy run joined, item by item.

    Attributes:
        vlm: Label of the VLM run.
        policy: Label of the policy run.
        score: The score by which the answers are read.
        view: View of the probes; None without any.
        notes: Remarks on the join, a sentence each.
    """

    vlm: str
    policy: str
    score: str
    view: str | None
    rows: tuple[CategoryCounts, ...]
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain values; the runs are called `asked` and `acted`, as in the JSON of VLM − VLA."""
        plain = asdict(self)
        return {"asked": plain.pop("vlm"), "acted": plain.pop("policy"), **plain}

    def to_frame(self) -> "pd.DataFrame":
        """Return a row per category and code of the three: counts of items and episodes, and coins' share."""
        import pandas as pd

        return pd.DataFrame(
            {
                "category": row.category,
                "answered_correctly": code[0] == "1",
                "encoded": None if code[1] == "-" else code[1] == "1",
                "acted_correctly": code[2] == "1",
                "items": row.counts[code],
                "guessed": row.guessed[code],
                "episodes": row.episodes[code],
            }
            for row in self.rows
            for code in row.counts
        )


def match_runs(
    vlm: RunReader,
    policy: RunReader,
    results: ProbeResults | None = None,
    view: str | None = None,
    seed: int = 0,
) -> KnownUsedTable:
    """Join a VLM run with a policy run and its probes.

    Args:
        vlm: The VLM run, as `scored` reads it.
        policy: The policy run.
        results: Probes of the policy run; None joins known and used only.
        view: A view that was probed, by default the first.
        seed: Seed of permutations.

    Raises:
        UsageError: For runs of the wrong kinds or without a question in common.
        OtherFramesError: If their first frames differ or carry no hash.
    """
    check_sides(policy, "a comparison with answers")
    if vlm.ask is None or policy.ask is not None:
        raise UsageError(
            f"{vlm.location} and {policy.location} are not a VLM run and a policy run, in this order; make them "
            "with `probe-kit ask` and `probe-kit extract`"
        )
    pairs = _same_questions(vlm, policy)
    probed_view = None if results is None else view or results.settings.views[0]
    if results is not None and probed_view not in results.settings.views:
        raise UsageError(f"view {probed_view!r} was not probed; probed were {', '.join(results.settings.views)}")
    answered, acted_on = ((pairs[column] == "correct").to_numpy(bool) for column in ("outcome_asked", "outcome"))
    encoded, signals = None, dict[str, bool]()
    if results is not None and probed_view is not None:
        encoded, signals = _right_decisions(pairs, results, probed_view), _signals(results, probed_view)
    items, unprobed = _only_probed(_items(pairs, answered, acted_on, encoded))
    rows = [
        _count_items(str(name), of_category, signals.get(str(name)))
        for name, of_category in items.groupby("category", sort=False)
    ]
    if len(rows) > 1:
        rows.append(_over_all(items, rows, seed))
    notes = [*unprobed, *_missing(pairs, vlm, policy), *_describe_picture(vlm), *without_signal(rows)]
    score = str(getattr(vlm, "score", "text"))
    joined = KnownUsedTable(vlm.label, policy.label, score, probed_view, tuple(rows), tuple(notes))
    return correct_joins([joined])[0]


@dataclass(frozen=True)
class Joins:
    """Every VLM run of a table joined with every policy run.

    Attributes:
        refused: Reasons why other pairs are not joined, a sentence each.
    """

    tables: tuple[KnownUsedTable, ...]
    refused: tuple[str, ...]


def join_runs(runs: Sequence[TableRun], results: Mapping[tuple[str, str], ProbeResults]) -> Joins:
    """Return answer, probe and success of every pair of a VLM run and a policy run.

    Tests are corrected over all pairs.

    Args:
        runs: Runs of the table.
        results: Probe results of these runs, by location and target.
    """
    probes_of = {location: probes for (location, _), probes in results.items()}
    policies = [run for run in runs if not run.answers and run.is_judged]
    joined, refused = [], []
    for vlm, policy in product([run for run in runs if run.answers], policies):
        try:
            pair = match_runs(vlm.run, policy.judged, probes_of.get(policy.location))
        except (UsageError, OtherFramesError) as error:
            refused.append(f"Not joined: {error}.")
            continue
        joined.append(replace(pair, vlm=vlm.label, policy=policy.label))
    return Joins(tuple(correct_joins(joined)), tuple(refused))


def correct_joins(joins: Sequence[KnownUsedTable]) -> list[KnownUsedTable]:
    """Return the same joins, which are shown together, with `p_holm` over all of them.

    The tests of all categories are one family; those over all categories are a summary and no part of it.
    """
    tests = [test for join in joins for row in join.rows if row.category != OVERALL for test in row.comparisons]
    p_holm = iter(holm_corrected(tests, lambda test: test.p))

    def row_counts(row: CategoryCounts) -> CategoryCounts:
        if row.category == OVERALL:
            return row
        return replace(row, comparisons=tuple(replace(test, p_holm=next(p_holm)) for test in row.comparisons))

    return [replace(join, rows=tuple(row_counts(row) for row in join.rows)) for join in joins]


# -- the same questions ----------------------------------------------------------------------------------


def _same_questions(vlm: RunReader, policy: RunReader) -> "pd.DataFrame":
    """Return the episodes of both: columns of the policy run, and `outcome_asked`."""
    for run in (vlm, policy):
        if FIRST_FRAME not in run.episodes or run.episodes[FIRST_FRAME].isna().any():
            raise OtherFramesError(
                f"{run.location} does not say what its first frames were; it was made before runs kept their "
                "hash. Make it again with this version"
            )
    keys = ["item_id", "layout"]
    for run in (vlm, policy):
        if run.episodes.duplicated(keys).any():
            raise UsageError(
                f"{run.location} holds an item more than once in a layout, such as in several wordings; join runs "
                "that ask every item once"
            )
    answers = vlm.episodes[[*keys, "outcome", FIRST_FRAME]]
    pairs = policy.episodes.merge(answers, on=keys, suffixes=("", "_asked"))
    if pairs.empty:
        raise UsageError(
            f"{vlm.location} and {policy.location} have no question in common; ask about the same suite"
        )
    other = pairs.loc[pairs[FIRST_FRAME] != pairs[f"{FIRST_FRAME}_asked"], "episode_id"]
    if len(other):
        raise OtherFramesError(
            f"{len(other)} of {len(pairs)} episodes begin with another frame in {vlm.location} than in "
            f"{policy.location} ({', '.join(other[:_MOST_NAMED])} …): a VLM and a policy that saw different "
            "pictures cannot be joined. Repeat one of them with the --seed, --scene and suite of the other"
        )
    both: pd.DataFrame = pairs[pairs.groupby("item_id")["layout"].transform("nunique") == 2]
    if both.empty:
        raise UsageError(f"{vlm.location} and {policy.location} share no item in both layouts; finish both runs")
    return both.reset_index(drop=True)


# -- encoded ---------------------------------------------------------------------------------------------


def _right_decisions(pairs: "pd.DataFrame", results: ProbeResults, view: str) -> NDArray[np.float64]:
    """Return whether the probe's decision is right (E,), NaN where nothing was probed."""
    is_right: dict[str, bool] = {}
    for (_, name), curve in results.curves.items():
        if name == view:
            is_right |= dict(zip(curve.episodes.tolist(), encoded_decisions(curve).tolist(), strict=True))
    return np.array([is_right.get(episode, np.nan) for episode in pairs["episode_id"]], np.float64)


def encoded_decisions(curve: ProbeCurve) -> Bools:
    """Return whether held-out decisions of the backbone's probe are right (E,), at sites that inner folds choose.

    Of each outer fold it is the site that is best in its inner folds, the first one on ties. The best site of all
    would be chosen by the luck that it is scored by.

    Args:
        curve: Probes of one category in one view.

    Raises:
        UsageError: If no stream of the vision-language model was probed.
    """
    stream = curve.backbone_stream
    if stream is None:
        raise UsageError("no stream of the vision-language model was probed: there is nothing encoded to join")
    return curve.nested_correct(curve.stream(stream))


def _signals(results: ProbeResults, view: str) -> dict[str, bool]:
    """Return by category whether the best site of the backbone beats chance and every control that was run."""
    signals = {}
    for (category, name), curve in results.curves.items():
        stream = curve.backbone_stream
        peak = None if stream is None or name != view else best_site(curve, stream)
        if peak is not None:
            signals[category] = has_signal(results.controls.exceeds(category, view, str(peak.site), peak.p_fwe))
    return signals


# -- counting --------------------------------------------------------------------------------------------


def _items(
    pairs: "pd.DataFrame", answered: Bools, used: Bools, encoded: NDArray[np.float64] | None
) -> "pd.DataFrame":
    """Return a row per item: right in both layouts or not, and its episodes' own marks as text."""
    import pandas as pd

    episodes = pd.DataFrame(
        {
            "item_id": pairs["item_id"],
            "category": pairs["category"],
            "group": units_of(pairs),
            "answered": answered,
            "used": used,
            "encoded": np.nan if encoded is None else encoded,
        }
    )
    episodes["marks"] = [_mark(*row) for row in episodes[["answered", "encoded", "used"]].itertuples(index=False)]
    by_item = episodes.groupby("item_id", sort=False)
    items = by_item.agg({"category": "first", "group": "first", "answered": "all", "used": "all", "marks": list})
    items["encoded"] = by_item["encoded"].min().where(by_item["encoded"].count() == 2)
    return items.reset_index()


def _only_probed(items: "pd.DataFrame") -> "tuple[pd.DataFrame, list[str]]":
    """Return the items without those that were left out when others of their category were probed.

    A sentence about the dropped items goes with them, if there are some.
    """
    probed = items["encoded"].notna()
    dropped = ~probed & probed.groupby(items["category"]).transform("any")
    if not dropped.any():
        return items, []
    return items[~dropped], [f"{int(dropped.sum())} items are left out: they were not probed in both layouts."]


def _mark(answered: bool, encoded: float, used: bool) -> str:
    middle = "-" if np.isnan(encoded) else str(int(encoded))
    return f"{int(answered)}{middle}{int(used)}"


def _count_items(category: str, items: "pd.DataFrame", clear: bool | None) -> CategoryCounts:
    answered, used = items["answered"].to_numpy(bool), items["used"].to_numpy(bool)
    values = items["encoded"].to_numpy(float)
    probed = bool(len(values)) and not np.isnan(values).any()
    encoded = values == 1 if probed else None
    middle = values if probed else np.full(len(answered), np.nan)
    codes = [_mark(*row) for row in zip(answered, middle, used, strict=True)]
    every = ["".join(parts) for parts in product("10", "10" if probed else "-", "10")]
    singles = [mark if probed else f"{mark[0]}-{mark[2]}" for of_item in items["marks"] for mark in of_item]
    return CategoryCounts(
        category=category,
        n_items=len(items),
        n_groups=int(items["group"].nunique()),
        answered_correctly=int(answered.sum()),
        encoded=None if encoded is None else int(encoded.sum()),
        acted_correctly=int(used.sum()),
        counts={code: codes.count(code) for code in every},
        guessed={
            # A coin per mark, right in both layouts of an item in 25 %.
            code: len(items) * float(np.prod([COIN if mark == "1" else 1 - COIN for mark in code if mark != "-"]))
            for code in every
        },
        episodes={code: singles.count(code) for code in every},
        has_signal=clear if probed else None,
        comparisons=tuple(_comparisons(answered, encoded, used, items["group"].to_numpy(str))),
        **({} if clear is False else _readable_sites(answered, encoded, used)),
    )


def _comparisons(answered: Bools, encoded: Bools | None, used: Bools, groups: NDArray[np.str_]) -> list[StageTest]:
    values = {"answered": answered, "acted": used} | ({} if encoded is None else {"encoded": encoded})
    comparisons = []
    for first, second in PAIRS:
        if first in values and second in values:
            mine, theirs = values[first], values[second]
            ps = mcnemar_p(mine, theirs), flip_p(mine, theirs, groups)
            comparisons.append(
                StageTest(first, second, int((mine & ~theirs).sum()), int((~mine & theirs).sum()), *ps, max(ps))
            )
    return comparisons


def _readable_sites(answered: Bools, encoded: Bools | None, used: Bools) -> dict[str, Any]:
    """Return counts of items that are answered right and encoded, by whether the action follows."""
    if encoded is None:
        return {}
    both = answered & encoded
    lost, count = int((both & ~used).sum()), int(both.sum())
    return {
        "answered_and_encoded": count,
        "not_acted_on": lost,
        "share_not_acted_on": lost / count if count else None,
        "share_not_acted_on_ci": clopper_pearson(lost, count),
        "p_linked": fisher_p(answered[encoded], used[encoded]) if encoded.any() else None,
    }


def _over_all(items: "pd.DataFrame", rows: Sequence[CategoryCounts], seed: int) -> CategoryCounts:
    signals = {row.has_signal for row in rows}
    overall = _count_items(OVERALL, items, signals.pop() if len(signals) == 1 else None)
    if overall.encoded is None or overall.has_signal is False:
        return overall
    items = items[items["category"].isin([row.category for row in rows if row.has_signal])]
    answered, encoded, used = (items[name].to_numpy(bool) for name in ("answered", "encoded", "used"))
    p = None
    if encoded.any():
        strata = items["category"].to_numpy(str)[encoded]
        p = overlap_p(answered[encoded], used[encoded], strata, derive_seed("overlap", seed))
    return replace(overall, **{**_readable_sites(answered, encoded, used), "p_linked": p})


# -- what a reader must know -----------------------------------------------------------------------------


def _missing(pairs: "pd.DataFrame", vlm: RunReader, policy: RunReader) -> list[str]:
    return [
        f"{len(run.episodes) - len(pairs)} episodes of {run.location} have no counterpart and are left out."
        for run in (vlm, policy)
        if len(run.episodes) > len(pairs)
    ]


def _describe_picture(vlm: RunReader) -> list[str]:
    ask = vlm.ask or {}
    notes = []
    if ask.get("picture") != "frame":
        notes.append(f"The VLM was not shown the first frame (--picture {ask.get('picture')}).")
    if ask.get("object") != "target":
        notes.append(f"The VLM was asked for the {ask.get('object')}, not for what the instruction names.")
    return notes


def without_signal(rows: Sequence[CategoryCounts]) -> list[str]:
    """Return a sentence about the categories whose probes have no signal; none if there is no such category."""
    dull = [row.category for row in rows if row.has_signal is False and row.category != OVERALL]
    if not dull:
        return []
    return [
        f"In {', '.join(dull)} probes are not shown to exceed chance and every control: the answer is not shown "
        "there, and counts of items with the probe right can be those of a probe that guesses."
    ]
