"""Tables of what was compared: wordings, sizes of the picture, VLM − VLA, and answers with probes and success."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain, count, groupby

from probe_kit._tables.numbers import number, percent, points, with_limits
from probe_kit._tables.table import Heading, Table
from probe_kit.retention.columns.text import (
    P_DECIDES,
    difference_test,
    is_vlm,
    model_name,
    once_per_category,
    success_interval,
)
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.compare.known_used import OVERALL, PAIRS, CategoryCounts, KnownUsedTable
from probe_kit.retention.compare.models import Relation
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.runs.reader import full_name

_LADDER = (
    "same items, same seeds; only one: episodes right in the first wording alone, and in the second alone; p: "
    "exact, signs of whole groups of items flipped; (Holm): over all categories, pairs and runs shown, means apart"
)


def wording_tables(wordings: Sequence[Difference], names: Mapping[str, str]) -> list[Table]:
    """The wordings of each run against each other. names: of runs, by location."""
    return [
        Table.of(
            f"Wordings, {names[str(run)]}",
            ("category", "wordings", "items", "SR %", "difference, points [95 %]", "only one", "p (Holm)"),
            [
                (
                    row.category,
                    f"{row.group} / {row.minus}",
                    _items(row),
                    f"{percent(row.sr_group)} / {percent(row.sr_minus)}",
                    with_limits(row.sr, row.sr_ci, points),
                    "–" if row.only is None else f"{row.only} / {row.only_minus}",
                    difference_test(row),
                )
                for row in rows
            ],
            mean=MEAN,
            notes=[_LADDER],
        )
        for run, rows in groupby(wordings, key=lambda row: row.run)
    ]


def _items(row: Difference) -> str:
    """Return how many are compared, and of how many where some are left out."""
    if row.n_items is None:
        return "other items"
    return str(row.n_items) if row.of_items in (None, row.n_items) else f"{row.n_items} of {row.of_items}"


def size_table(means: Sequence[RetentionRow]) -> list[Table]:
    """Mean accuracy by model and prompt, a column per size of the picture; none for fewer than two VLM runs."""
    of_vlms = [row for row in once_per_category(means) if is_vlm(row) and row.category == MEAN]
    if len(of_vlms) < 2:
        return []
    sizes = sorted(
        {str(row.answers.picture_size) for row in of_vlms}, key=lambda size: [int(n) for n in size.split("x")]
    )
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in of_vlms:
        name = full_name(row.run.model, row.run.random_weights)
        extras = [
            str(part) for part in (row.answers.picture, row.answers.asked_for) if part not in ("frame", "target")
        ]
        prompt = " · ".join([str(row.answers.prompt), *extras])
        size = str(row.answers.picture_size)
        # Runs of one model, prompt and size, such as two checkpoints, stand in lines of their own.
        names = chain([name], (model_name(row) + " '" * primes for primes in count()))
        free = next(name for name in names if size not in lines.get((name, prompt), {}))
        lines.setdefault((free, prompt), {})[size] = success_interval(row)
    cells = [(*name, *(rates.get(size, "–") for size in sizes)) for name, rates in lines.items()]
    title, note = "Accuracy by prompt and size of the picture", "mean over categories in %, with its 95 % interval"
    return [Table.of(title, ("model", "prompt", *sizes), cells, names=2, notes=[note])]


# -- VLM − VLA ---------------------------------------------------------------------------------------------------

_SOURCES: Mapping[Relation, str] = {
    "yes": "the policy grew from these weights",
    "no": "the policy did NOT grow from these weights",
    "unknown": "unknown whether the policy grew from these weights",
}


def vlm_vla_tables(gaps: Sequence[Difference]) -> list[Table]:
    """One table per pair of a VLM run and a policy run."""
    return [
        _gap_table(vlm, policy, list(rows))
        for (vlm, policy), rows in groupby(gaps, key=lambda gap: (gap.group, gap.minus))
    ]


def _gap_table(vlm: str, policy: str, rows: Sequence[Difference]) -> Table:
    frames = {row.same_frames for row in rows}
    first = (
        "the same first frames" if frames == {True} else "OTHER first frames" if False in frames else "no hashes"
    )
    items = "the same items" if all(row.paired for row in rows) else "OTHER items: not paired, no p"
    tests = (
        "p: exact, whole groups of items flipped; (Holm): over the categories of all pairs shown, means by "
        f"themselves; {P_DECIDES}"
    )
    cells = [
        (
            row.category,
            percent(row.sr_group),
            percent(row.sr_minus),
            with_limits(row.sr, row.sr_ci, percent),
            number(row.p, 4),
            number(row.p_holm, 4),
            _items(row),
        )
        for row in rows
    ]
    columns = ("category", "VLM %", "VLA %", "VLM − VLA [95 %]", "p", "p (Holm)", "items")
    notes = [items, first, _SOURCES[rows[0].source or "unknown"], tests]
    return Table.of(f"VLM − VLA: {vlm} − {policy}", columns, cells, mean=MEAN, notes=["; ".join(notes)])


# -- answer, probe, success --------------------------------------------------------------------------------------

Columns = Sequence[tuple[str, Callable[[CategoryCounts], str]]]
_LEGEND = (
    "answer: the VLM answers right; probe: its held-out decision is right; success: the cube ends right; each in "
    "both layouts of an item, which a coin manages in 25 %"
)
_NAMES = {"answered": "answer", "encoded": "probe", "acted": "success"}
_CODES = "a capital letter for what is right, a small one for what is not"
_TESTS = "p: exact McNemar over items or over whole groups, the larger; (Holm) over all categories and pairs shown"


def known_used_tables(joined: KnownUsedTable) -> list[Table]:
    """Counts of items, which of them, tests, and counts of single episodes."""
    probes = f"probes in view {joined.view}" if joined.view else "no probes: answer and success only"
    title = f"Answer, probe, success: {joined.vlm} (by {joined.score}) · {joined.policy}"
    rows = joined.rows
    which = "Which of them: VLM · probe · success (expected of coins)"
    return [
        _counts(title, f"{_LEGEND}; {probes}", rows, ("Items", _SHARES), ("Answer right, without success", _LOST)),
        _counts(which, _CODES, rows, ("", _codes(rows))),
        _counts("Equally many?", _TESTS, rows, ("", _TESTED)),
        _counts("Single episodes (nothing is tested)", "", rows, ("", _episodes(rows))),
    ]


def _counts(title: str, note: str, rows: Sequence[CategoryCounts], *groups: tuple[str, Columns]) -> Table:
    headings = [Heading(name, group=group) for group, columns in groups for name, _ in columns]
    cells = [(row.category, *(cell(row) for _, columns in groups for _, cell in columns)) for row in rows]
    return Table.of(title, ("category", *headings), cells, mean=OVERALL, notes=[note]).filled()


def _share(count: int | None, row: CategoryCounts) -> str:
    return "–" if count is None else f"{count} ({percent(count / row.n_items, 0)} %)"


_SHARES: Columns = [
    ("items (groups)", lambda row: f"{row.n_items} ({row.n_groups})"),
    ("answer right", lambda row: _share(row.answered_correctly, row)),
    ("probe right", lambda row: _share(row.encoded, row)),
    ("success", lambda row: _share(row.acted_correctly, row)),
    ("shown", lambda row: {True: "yes", False: "no", None: "–"}[row.has_signal]),
]
_LOST: Columns = [
    (
        "answer and probe right",
        lambda row: "–" if row.answered_and_encoded is None else str(row.answered_and_encoded),
    ),
    (
        "of these without success % [95 %]",
        lambda row: with_limits(row.share_not_acted_on, row.share_not_acted_on_ci, percent),
    ),
    ("answer with success, p", lambda row: number(row.p_linked, 4)),
]


def _codes(rows: Sequence[CategoryCounts]) -> Columns:
    def cell(code: str, row: CategoryCounts) -> str:
        return f"{row.counts[code]} ({row.guessed[code]:.1f})" if code in row.counts else "–"

    codes = dict.fromkeys(code for row in rows for code in row.counts)
    return [(_spelt(code), partial(cell, code)) for code in codes]


def _episodes(rows: Sequence[CategoryCounts]) -> Columns:
    def cell(code: str, row: CategoryCounts) -> str:
        return str(row.episodes.get(code, "–"))

    codes = dict.fromkeys(code for row in rows for code in row.episodes)
    return [(_spelt(code), partial(cell, code)) for code in codes]


def _spelt(code: str) -> str:
    """`101` as V p S: a capital for what is right, a small letter for what is not."""
    letters = zip("VPS", code, strict=True)
    return " ".join(letter if mark == "1" else letter.lower() for letter, mark in letters if mark != "-")


def _test(first: str, second: str, row: CategoryCounts) -> str:
    for test in row.comparisons:
        if (test.first, test.second) == (first, second):
            corrected = "" if test.p_holm is None else f" ({number(test.p_holm, 4)})"
            return f"{test.only_first} against {test.only_second}, {number(test.p, 4)}{corrected}"
    return "–"


_TESTED: Columns = [
    (f"{_NAMES[first]} − {_NAMES[second]}: only one of them, p (Holm)", partial(_test, first, second))
    for first, second in PAIRS
]
