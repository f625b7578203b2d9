"""Tables with a row per system and a column per category: success rates, sides, scores and probes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from statistics import fmean

from probe_kit._system.counting import describe_range
from probe_kit._tables.content import Heading, Legend, Number
from probe_kit._tables.numbers import NONE, number, percent, plain
from probe_kit._tables.table import Cell, Cells, Table
from probe_kit.retention.behaviour import Regime, normalised_score
from probe_kit.retention.columns.tables import once_per_category
from probe_kit.retention.columns.text import published_value, retention_value
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.table import RetentionTable
from probe_kit.suite.categories import OWN_DOMAIN, category_of, in_order

MARKS = {Regime.KNOWLEDGE: " ↑", Regime.FAILURE: " ↓"}
DISAGREES = "*"
"""Mark of a rate whose 95 % interval and whose regime disagree about guessing."""
_MARKED = "↑ above what guessing reaches, ↓ below it, at 95 % with items as the unit"
_MEAN = "the mean is over the categories that a system has"
OfSystem = Mapping[str, RetentionRow]
"""Rows of one system by category, its mean among them."""


@dataclass(frozen=True)
class _Column:
    """A column of a table with a row per system.

    Attributes:
        heading: Heading of the column.
        domain: The heading over it, empty for none.
        cell: Makes the cell of a system.
    """

    heading: str
    domain: str
    cell: Callable[[OfSystem], Cell]


def success_table(table: RetentionTable) -> Table:
    """Return success rates of policies, and shares right of VLMs, by system and category; means and score last.

    A domain of several categories has a mean of its own, of the category means.
    """
    columns = [*_by_category(table, success_cell, domain_means=True), _SCORE]
    printed = _pivot(table, "Success rate %", [_MARKED, *_disagreement(table), _MEAN], columns)
    return replace(printed, numbers=(*printed.numbers, *_domain_numbers(table)))


def vlm_table(table: RetentionTable) -> Table:
    """Return shares right of VLMs by prompt, size of the picture and category."""
    of_prompt = [
        _Column("prompt", "", lambda rows: Cell(rows[MEAN].answers.prompt or None)),
        _Column("picture", "", lambda rows: Cell(rows[MEAN].answers.picture_size or None)),
    ]
    columns = [*of_prompt, *_by_category(table, success_cell)]
    return _pivot(table, "Share right %", [_MARKED, *_disagreement(table), _MEAN], columns)


def success_cell(row: RetentionRow) -> Cell:
    """Return the rate in percent with the mark of its regime; a mean has none."""
    success = row.success
    mark = "" if success.regime is None else MARKS.get(success.regime, "")
    return Cell(success.sr, percent, after=mark + (f" {DISAGREES}" if _disagrees(row) else ""))


def _disagrees(row: RetentionRow) -> bool:
    """Whether the interval excludes one half and the regime does not, or the other way round."""
    low, high = row.success.ci or (None, None)
    if row.success.regime is None or low is None or high is None:
        return False
    return (low > 0.5 or high < 0.5) != (row.success.regime != Regime.NO_RELIABLE_KNOWLEDGE)


def _disagreement(table: RetentionTable) -> list[str]:
    notes = []
    if any(_disagrees(row) for row in table.rows):
        notes.append("* the 95 % interval and the range of guessing disagree about 50 %")
    no_regime = [row.success for row in table.rows if row.success.regime == Regime.NO_RELIABLE_KNOWLEDGE]
    if any(
        success.sr is not None
        and success.chance_margin is not None
        and abs(success.sr - 0.5) > success.chance_margin
        for success in no_regime
    ):
        notes.append("rates beyond it whose 95 % interval includes 50 % have no mark: too few items")
    return notes


def sides_table(table: RetentionTable) -> Table:
    """Return success rates by side of the correct picture, left and right, then by layout of the pictures."""
    by_side = _Column("half", "", lambda _: Cell("left / right"))
    by_layout = _Column("half", "", lambda _: Cell("original / swapped"))
    note = ["left, right: side of the correct picture", _MEAN]
    title = "Success rate % by side and layout"

    def sides_cell(row: RetentionRow) -> Cell:
        return _two(row.success.sr_left, row.success.sr_right)

    def layouts_cell(row: RetentionRow) -> Cell:
        return _two(row.success.sr_original, row.success.sr_swapped)

    sides = _pivot(table, title, note, [by_side, *_by_category(table, sides_cell)])
    layouts = _pivot(table, title, note, [by_layout, *_by_category(table, layouts_cell)])
    rows = tuple(row for both in zip(sides.rows, layouts.rows, strict=True) for row in both)
    return replace(sides, rows=rows, names=2)


def _two(first: float | None, second: float | None) -> Cell:
    return Cell(first, percent, after="" if first is None and second is None else f" / {percent(second)}")


_SCORE = _Column("score", "", lambda rows: Cell(rows[MEAN].success.normalised_score, number))


def score_table(
    table: RetentionTable, title: str = "", source: str = "", elsewhere: Mapping[str, float] | None = None
) -> Table:
    """Return the normalised score of every system with its interval: 0 for guessing, 100 for perfection.

    Args:
        table: The retention table of the systems.
        title: Heading of a further column of numbers that were not measured here; empty for none.
        source: Source of those numbers, named in the caption.
        elsewhere: Those numbers by location of the run; None for no such column.
    """
    means = [row for row in once_per_category(table.means) if row.success.sr is not None]
    other_scores = {} if elsewhere is None else elsewhere
    cells: tuple[Cells, ...] = tuple(
        (
            row.run.label,
            Cell(row.success.normalised_score, number, _score_limits(row)),
            Cell(row.success.sr, percent),
            Cell(len(row.categories)),
            *([] if elsewhere is None else [Cell(other_scores.get(row.run.location), _as_given)]),
        )
        for row in means
    )
    numbers = [
        {
            "system": row.run.label,
            "score": row.success.normalised_score,
            "score_ci": _score_limits(row),
            "sr": row.success.sr,
            "ci": row.success.ci,
            "elsewhere": other_scores.get(row.run.location),
            "elsewhere_source": source or None,
        }
        for row in means
    ]
    note = ["score = (mean % − 50) / 50 × 100 over the categories of a system, 95 % interval"]
    note += [f"{title}: not measured here, from {source}"] if elsewhere is not None else []
    columns = ("system", "score [95 %]", "mean %", "categories", *([] if elsewhere is None else [title]))
    notes = [caption(table, note)]
    return Table.of("Normalised score", columns, cells, notes=notes, numbers=tuple(numbers))


def _as_given(value: float | None) -> str:
    """Return a number of another source with the digits that it has there."""
    return plain(value) if value is None else f"{value:g}"


def _score_limits(row: RetentionRow) -> tuple[float | None, float | None] | None:
    """Return the interval of the mean on the scale of the score, which is linear in it."""
    if row.success.ci is None:
        return None
    low, high = (None if end is None else (end - 0.5) * 200 for end in row.success.ci)
    return low, high


def probing_table(table: RetentionTable) -> Table:
    """Return best accuracies in the backbone and the action, and retention, by category and as a mean."""
    rows = [row for row in table.all_rows if row.view is not None]
    cells = tuple(
        (
            row.run.label,
            row.view or "–",
            row.category if row.category == MEAN else category_of(row.category).title,
            Cell(row.backbone.score, percent),
            Cell(row.action.score, percent),
            Cell(None) if row.action.score is None else retention_value(row),
            published_value(row),
        )
        for row in rows
    )
    numbers = [
        {
            "system": row.run.label,
            "category": row.category,
            "view": row.view,
            "backbone": row.backbone.score,
            "backbone_ci": row.backbone.ci,
            "action": row.action.score,
            "action_ci": row.action.ci,
            "retention": row.retention.value,
            "retention_ci": row.retention.ci,
            "retention_defined": row.retention.defined,
            "published": row.retention.published,
        }
        for row in table.all_rows
    ]
    legend = Legend(
        before=(
            "cross-fitted scores of the best sites",
            "n/a: the backbone's signal is not shown; such categories are not in the mean of retention",
        ),
        marks={NONE: "no site where the action is made has the view"},
        after=(caption(table, []),),
    )
    published = Heading(
        "published", term="published: the paper's ratio of best accuracies, in the mean its mean over categories"
    )
    columns = ("system", "view", "category", "backbone %", "action %", "retention [95 %]", published)
    return Table.of("Probes", columns, cells, names=3, mean=MEAN, legend=legend, numbers=tuple(numbers))


def domain_scores(table: RetentionTable) -> dict[str, dict[str, float]]:
    """Return by domain and system the normalised score of the mean over the domain's categories."""
    scores: dict[str, dict[str, float]] = {}
    for domain, members in _domains(table):
        for name, rows in _systems(table).items():
            mean = _mean_of(rows, members)
            if mean is not None:
                scores.setdefault(domain or OWN_DOMAIN, {})[name] = normalised_score([mean])
    return scores


def caption(table: RetentionTable, sentences: Sequence[str]) -> str:
    """Return a caption: sentences, the outcome rule, the captured inference, and episodes per category."""
    acted = any(row.run.mode == "acts" and row.success.sr is not None for row in table.rows)
    calls = sorted({row.run.call for row in table.rows if row.run.call is not None})
    parts = [*sentences]
    parts += [f"outcome rule {table.rule}"] if acted else []
    parts += [f"captured inference {', '.join(map(str, calls))}"] if calls and calls != [0] else []
    parts += [episodes_per_category(table)] if table.rows else []
    return "; ".join(parts)


def episodes_per_category(table: RetentionTable) -> str:
    """Return how many episodes a category of a table with rows has, in words."""
    return f"{describe_range([row.success.n_episodes for row in table.rows])} episodes per category"


# -- columns by category -----------------------------------------------------------------------------------------


def _by_category(
    table: RetentionTable, cell: Callable[[RetentionRow], Cell], domain_means: bool = False
) -> Iterator[_Column]:
    """Yield a column per category under its domain, then the mean."""

    def category_cell(category: str) -> Callable[[OfSystem], Cell]:
        return lambda rows: cell(rows[category]) if category in rows else Cell(None)

    for domain, members in _domains(table):
        for name in members:
            yield _Column(category_of(name).title, domain, category_cell(name))
        if domain_means and domain and len(members) > 1:
            yield _Column(domain, domain, partial(_mean_cell, tuple(members)))
    yield _Column(MEAN, "", category_cell(MEAN))


def _mean_cell(categories: Sequence[str], rows: OfSystem) -> Cell:
    return Cell(_mean_of(rows, categories), percent)


def _domains(table: RetentionTable) -> list[tuple[str, list[str]]]:
    """Return the categories of a table in the order of the paper, by domain; those of a suite's own have none."""
    categories = in_order([row.category for row in table.rows])
    by_domain = groupby(categories, key=lambda name: category_of(name).domain)
    return [("" if domain == OWN_DOMAIN else domain, list(members)) for domain, members in by_domain]


def _mean_of(rows: OfSystem, categories: Sequence[str]) -> float | None:
    """Return the mean of the rates of categories, which count alike whatever their episodes."""
    rates = [rows[name].success.sr for name in categories if name in rows]
    defined = [rate for rate in rates if rate is not None]
    return fmean(defined) if defined else None


def _systems(table: RetentionTable) -> dict[str, OfSystem]:
    """Return rows by label, in order. Labels distinguish runs."""
    systems: dict[str, dict[str, RetentionRow]] = {}
    for row in once_per_category([*table.rows, *table.means]):
        systems.setdefault(row.run.label, {})[row.category] = row
    return dict(systems)


def _pivot(table: RetentionTable, title: str, note: Sequence[str], columns: Sequence[_Column]) -> Table:
    cells: tuple[Cells, ...] = tuple(
        (name, *(column.cell(of_system) for column in columns)) for name, of_system in _systems(table).items()
    )
    headings = [Heading("system"), *(Heading(column.heading, group=column.domain) for column in columns)]
    rows = once_per_category([*table.rows, *table.means])
    return Table.of(
        title, headings, cells, notes=[caption(table, note)], numbers=tuple(_number(row) for row in rows)
    )


def _number(row: RetentionRow) -> Number:
    success = row.success
    return {
        "system": row.run.label,
        "run": row.run.location,
        "category": row.category,
        "domain": None if row.category == MEAN else category_of(row.category).domain,
        "sr": success.sr,
        "ci": success.ci,
        "left": success.sr_left,
        "right": success.sr_right,
        "original": success.sr_original,
        "swapped": success.sr_swapped,
        "episodes": success.n_episodes,
        "items": success.n_items,
        "margin": success.chance_margin,
        "regime": None if success.regime is None else str(success.regime),
        "normalised_score": success.normalised_score,
        "prompt": row.answers.prompt,
        "picture_size": row.answers.picture_size,
    }


def _domain_numbers(table: RetentionTable) -> Iterator[Number]:
    """Yield the means of domains of several categories."""
    for name, rows in _systems(table).items():
        for domain, members in _domains(table):
            if domain and len(members) > 1:
                yield {
                    "system": name,
                    "run": rows[MEAN].run.location,
                    "category": MEAN,
                    "domain": domain,
                    "sr": _mean_of(rows, members),
                    "categories": [member for member in members if member in rows],
                }
