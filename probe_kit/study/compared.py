"""Tables of differences: conditions, steps of a chain, groups of models, and VLMs against policies."""

from collections.abc import Sequence
from dataclasses import replace

from probe_kit._tables.content import Number
from probe_kit._tables.numbers import p_text, percent, points, with_limits
from probe_kit._tables.table import Table
from probe_kit.retention.columns.text import P_DECIDES, difference_test, models_test
from probe_kit.retention.compare.compare import MANY, Difference, behaviour_once, with_holm
from probe_kit.retention.compare.known_used import OVERALL, CategoryCounts, KnownUsedTable, without_signal
from probe_kit.retention.rows.row import MEAN
from probe_kit.retention.table import RetentionTable
from probe_kit.study.rates import caption
from probe_kit.suite.categories import category_of

_TEST = (
    "p: exact, signs of whole groups of items flipped; (Holm) over all categories and pairs of this comparison; "
    f"{P_DECIDES}"
)
FEWEST_GROUPS = 10
"""Of items, with which a difference is tested, and counts for Holm's correction of the others."""
_FEW = "!"


def difference_table(table: RetentionTable, title: str) -> Table:
    """Differences of success rates, a row per pair and category; the whole comparison is one family of tests."""
    rows = _tested(behaviour_once(table.differences))
    cells = [
        (
            f"{row.group} − {row.minus}",
            _category(row.category),
            with_limits(row.sr, row.sr_ci, points),
            difference_test(row),
            _items(row.n_items, row.of_items),
        )
        for row in rows
    ]
    columns = ("systems", "category", "difference, points [95 %]", "p (Holm)", "items")
    numbers = tuple(map(_number, rows))
    printed = _of_pairs(title, columns, cells, caption(table, [_TEST]), numbers)
    return printed.with_notes([*_remarks(rows), *(sentence.removesuffix(".") for sentence in table.unpaired)])


def _of_pairs(
    title: str,
    columns: Sequence[str],
    cells: Sequence[Sequence[str]],
    note: str,
    numbers: tuple[Number, ...],
    mean: str = MEAN,
) -> Table:
    return Table.of(title, columns, cells, names=2, mean=mean, notes=[note], numbers=numbers)


def _tested(rows: Sequence[Difference]) -> list[Difference]:
    """The same without tests of fewer than FEWEST_GROUPS groups, and Holm's p over those that are left."""
    return with_holm([row if (row.n_groups or 0) >= FEWEST_GROUPS else replace(row, p=None) for row in rows])


def _items(count: int | None, of_count: int | None) -> str:
    """Items in common, of how many where some are left out, and a mark where that is more than a fifth."""
    if count is None or of_count is None:
        return "other items" if count is None else str(count)
    if count == of_count:
        return str(count)
    return f"{count} of {of_count}" + (f" {_FEW}" if count < MANY * of_count else "")


def _remarks(rows: Sequence[Difference]) -> list[str]:
    """Return the meaning of marks and missing p-values of these rows."""
    left_out = any(row.n_items is not None and (row.n_items < MANY * (row.of_items or 0)) for row in rows)
    few = any(row.n_groups is not None and row.n_groups < FEWEST_GROUPS for row in rows)
    remarks = [f"{_FEW} fewer than {100 * MANY:.0f} % of the items in common"] if left_out else []
    return remarks + ([f"no p with fewer than {FEWEST_GROUPS} independent groups of items"] if few else [])


def group_table(table: RetentionTable, title: str) -> Table:
    """Groups of models: the exact p over models first, the interval of these models apart."""
    rows = behaviour_once(table.differences)
    cells = [
        (
            f"{row.group} − {row.minus}",
            _category(row.category),
            models_test(row.sr_models, points),
            with_limits(row.sr, row.sr_ci, points),
        )
        for row in rows
    ]
    note = (
        "p over models: exact, labels of models exchanged, in brackets the least that so few models allow and "
        "Welch's interval; runs of one model are averaged; the last column is of these models on other items"
    )
    columns = ("groups", "category", "p over models (least)", "these models, points [95 %]")
    # The p over items is about these models alone, and the table about others like them.
    numbers = tuple({**_number(row), "p": None, "p_holm": None} for row in rows)
    return _of_pairs(title, columns, cells, caption(table, [note]), numbers)


def vlm_vla_table(differences: Sequence[Difference]) -> Table:
    """Share right of VLMs minus success rate of policies, where the file names the VLM of a policy."""
    rows = _tested(differences)
    cells = [
        (
            f"{row.group} − {row.minus}",
            _category(row.category),
            percent(row.sr_group),
            percent(row.sr_minus),
            with_limits(row.sr, row.sr_ci, percent),
            p_text(row.p_holm),
            _items(row.n_items, row.of_items),
        )
        for row in rows
    ]
    numbers = [
        {
            "vlm": row.group,
            "policy": row.minus,
            "category": row.category,
            "accuracy": row.sr_group,
            "sr": row.sr_minus,
            "difference": row.sr,
            "ci": row.sr_ci,
            "p": row.p,
            "p_holm": row.p_holm,
            "items": row.n_items,
            "of_items": row.of_items,
            "groups": row.n_groups,
            "same_frames": row.same_frames,
            "source": row.source,
        }
        for row in rows
    ]
    other = "; some pairs began with OTHER first frames" if any(row.same_frames is False for row in rows) else ""
    note = f"{_TEST.replace('this comparison', 'the table')}{other}"
    columns = ("systems", "category", "VLM %", "VLA %", "VLM − VLA [95 %]", "p (Holm)", "items")
    return _of_pairs("VLM − VLA", columns, cells, note, tuple(numbers)).with_notes(_remarks(rows))


def stages_table(joins: Sequence[KnownUsedTable]) -> Table:
    """Return items with the VLM's answer, the probe and success right, each in both layouts.

    Items with the probe right are counted where the answer is shown.
    """
    pairs = [(join, row) for join in joins for row in join.rows]
    cells = [
        (
            f"{join.asked} · {join.acted}",
            row.category if row.category == OVERALL else category_of(row.category).title,
            str(row.n_items),
            _count(row.answered_correctly),
            "not shown" if row.has_signal is False else _count(_encoded(join, row)),
            _count(row.acted_correctly),
            _count(row.answered_and_encoded),
            with_limits(row.share_not_acted_on, row.share_not_acted_on_ci or (None, None), percent),
        )
        for join, row in pairs
    ]
    numbers = [
        {
            "vlm": join.asked,
            "policy": join.acted,
            "view": join.view,
            "category": row.category,
            "items": row.n_items,
            "answered": row.answered_correctly,
            "encoded": _encoded(join, row),
            "acted_on": row.acted_correctly,
            "answered_and_encoded": row.answered_and_encoded,
            "share_not_acted_on": row.share_not_acted_on,
            "ci": row.share_not_acted_on_ci,
            "signal": row.has_signal,
        }
        for join, row in pairs
    ]
    note = "items right in both layouts, which guessing manages in 25 %; lost: share of answered and encoded ones"
    columns = (
        "systems",
        "category",
        "items",
        "answer right",
        "probe right",
        "success",
        "answer and probe right",
        "of these without success %",
    )
    printed = _of_pairs("Stages", columns, cells, note, tuple(numbers), mean=OVERALL)
    notes = [text for join in joins for text in join.notes if text not in without_signal(join.rows)]
    dull = any(row.has_signal is False for _, row in pairs)
    remark = ["not shown: probes are not shown to exceed chance and every control"] if dull else []
    return printed.with_notes([*remark, *dict.fromkeys(text.removesuffix(".") for text in notes)])


def _encoded(join: KnownUsedTable, row: CategoryCounts) -> int | None:
    """Encoded items of categories whose probes have signal, which the overall row is summed of anew."""
    if row.encoded is None or row.has_signal is False:
        return None
    inside = join.rows if row.category == OVERALL else (row,)
    return sum(part.encoded or 0 for part in inside if part.has_signal and part.category != OVERALL)


def _count(number: int | None) -> str:
    return "–" if number is None else str(number)


def _category(name: str) -> str:
    return name if name == MEAN else category_of(name).title


def _number(row: Difference) -> Number:
    models = row.sr_models
    return {
        "system": row.group,
        "minus": row.minus,
        "category": row.category,
        "difference": row.sr,
        "ci": row.sr_ci,
        "p": row.p,
        "p_holm": row.p_holm,
        "items": row.n_items,
        "of_items": row.of_items,
        "groups": row.n_groups,
        "p_over_models": None if models is None else models.p,
        "least_p_over_models": None if models is None else models.smallest_p,
        "models_ci": None if models is None else models.ci,
    }
