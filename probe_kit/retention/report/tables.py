"""Tables of the report: cells with what they show, what they sort by, and their heat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_COLUMNS,
    FOLLOWED_COLUMNS,
    action_place,
    area_value,
    beats,
    bounded_value,
    call_value,
    controlled,
    debiased_value,
    difference_title,
    model_name,
    number,
    once_per_category,
    percent,
    plain_value,
    prefix_place,
    probed,
    success_interval,
    with_limits,
)
from probe_kit.retention.differences import Difference
from probe_kit.retention.displays.style import spell
from probe_kit.retention.heat import heat_colour
from probe_kit.retention.plain_tables import PlainTable
from probe_kit.retention.report.glossary import GLOSSARY
from probe_kit.retention.rows import MEAN, RetentionRow
from probe_kit.retention.success import Regime
from probe_kit.statistics.significance import SIGNIFICANCE

_REGIMES: dict[str | None, str] = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


@dataclass(frozen=True)
class HtmlCell:
    """sort: what the column sorts by, None for last. heat: background, `#RRGGBB`. strong: bold. alarm: red.

    note: shown on pointing at it.
    """

    text: str
    sort: float | str | None = None
    heat: str | None = None
    strong: bool = False
    alarm: bool = False
    note: str = ""


@dataclass(frozen=True)
class HtmlColumn:
    """explanation: shown on pointing at the heading."""

    name: str
    explanation: str
    numeric: bool


@dataclass(frozen=True)
class HtmlTable:
    """body is sorted by a click on a heading; foot, the means, stays."""

    title: str
    columns: tuple[HtmlColumn, ...]
    body: tuple[tuple[HtmlCell, ...], ...]
    foot: tuple[tuple[HtmlCell, ...], ...] = ()


_Value = Callable[[RetentionRow], float | int | str | None]


@dataclass(frozen=True)
class _Column:
    name: str
    text: Callable[[RetentionRow], str]
    sort: _Value
    meaning: str | None = None
    heat: _Value | None = None
    strong: Callable[[RetentionRow], bool] | None = None
    note: Callable[[RetentionRow], str] | None = None


def _share(name: str, attribute: str, meaning: str | None = None, heat: bool = False) -> _Column:
    """A column of percentages straight from a field of the row."""

    def value(row: RetentionRow) -> float | None:
        found: float | None = getattr(row, attribute)
        return found

    return _Column(name, lambda row: percent(value(row)), value, meaning, value if heat else None)


def _is_low(p: float | None) -> bool:
    return p is not None and p < SIGNIFICANCE


def _p(value: float | None) -> str:
    return "< 0.001" if value is not None and value < 0.001 else number(value, 3)


def _retention(row: RetentionRow) -> float | None:
    return row.retention if row.retention_defined else None


def _bounded(row: RetentionRow) -> float | None:
    return row.retention_bounded if row.retention_defined else None


def _area(row: RetentionRow) -> float | None:
    return row.retention_area if row.retention_defined else None


def _debiased(row: RetentionRow) -> float | None:
    return row.retention_debiased if row.retention_defined else None


def _twice(row: RetentionRow) -> str:
    if row.items_both_right is None:
        return "–"
    total = row.items_both_right + (row.items_one_right or 0) + (row.items_none_right or 0)
    return f"{row.items_both_right} of {total}"


def _reading(row: RetentionRow) -> str:
    if row.listened:
        return "did not act"
    return _REGIMES.get(row.regime) or f"score {number(row.normalised_score, 1)}"


_NAMES = [
    _Column("model", model_name, model_name, "The policy; marked if its weights are random."),
    _Column("category", lambda row: spell(row.category), lambda row: row.category, "Kind of question."),
]
_VIEW = _Column(
    "view",
    lambda row: row.view or "–",
    lambda row: row.view or "",
    "How the tokens of an episode became one vector.",
)

_CALL = _Column("call", call_value, lambda row: row.call, "call")

_BEHAVIOUR = [
    *_NAMES,
    _Column(
        "SR % [95 %]", success_interval, lambda row: row.sr, "SR", lambda row: row.sr,
        lambda row: row.regime == Regime.KNOWLEDGE,
    ),
    *(
        _Column(
            f"{name} %" if name != "used" else name, cell, lambda row: row.follows_net, name,
            strong=lambda row: row.used == "used", note=lambda row: row.used_note,
        )
        for name, cell in FOLLOWED_COLUMNS
    ),
    _share("± Δ", "delta_regime", "Δ"),
    _share("paper's Δ", "delta", "paper's Δ"),
    _Column(
        "reading", _reading,
        lambda row: row.sr, "reading",
    ),
    _share("wrong %", "p_wrong", "wrong"),
    _share("outside %", "p_oob", "outside"),
    _share("never moved %", "p_never_moved", "never moved"),
    _share("left %", "sr_left", "left", heat=True),
    _share("right %", "sr_right", "right", heat=True),
    _Column("right twice", _twice, lambda row: row.items_both_right, "right twice"),
    _Column(
        "p", lambda row: _p(row.paired_p), lambda row: row.paired_p, "p (twice)",
        strong=lambda row: _is_low(row.paired_p),
    ),
    _Column("n (items)", lambda row: f"{row.n_episodes} ({row.n_items})", lambda row: row.n_episodes, "n"),
]  # fmt: skip

_MORE_BEHAVIOUR = [
    *_NAMES,
    _share("original %", "sr_original", "original"),
    _share("swapped %", "sr_swapped", "swapped"),
    _share("goes left %", "side_preference", "goes left"),
    _share("flagged steps %", "p_flagged", "flagged"),
]

_RETENTION = [
    *_NAMES,
    _VIEW,
    _CALL,
    _Column(
        "bounded [95 %]", bounded_value, _bounded, "bounded", _bounded, note=lambda row: row.retention_note,
    ),
    _Column("area [95 %]", area_value, _area, "area", _area),
    _Column("debiased [95 %]", debiased_value, _debiased, "debiased", _debiased),
    _Column("published", plain_value, _retention, "retention", _retention),
    _Column(
        "backbone % [95 %]", lambda row: with_limits(percent(row.prefix_accuracy), row.prefix_ci, percent),
        lambda row: row.prefix_accuracy, "backbone", strong=lambda row: row.prefix_signal,
    ),
    _Column("layer", prefix_place, lambda row: row.prefix_layer, "layer"),
    _Column("p", lambda row: _p(row.prefix_p_fwe), lambda row: row.prefix_p_fwe, "p"),
    _Column(
        "action % [95 %]", lambda row: with_limits(percent(row.action_accuracy), row.action_ci, percent),
        lambda row: row.action_accuracy, "action", strong=lambda row: row.action_signal,
    ),
    _Column("layer @iteration", action_place, lambda row: row.action_layer, "layer"),
    _Column("p", lambda row: _p(row.action_p_fwe), lambda row: row.action_p_fwe, "p"),
    _share("first iteration %", "action_first_accuracy", "first iteration"),
    _Column("gap", lambda row: percent(row.gap), lambda row: row.gap, "gap"),
    _Column("backbone beats", beats, beats, "beats"),
    _share("chance %", "chance", "chance"),
    _Column(
        "groups", lambda row: "–" if row.n_groups is None else str(row.n_groups), lambda row: row.n_groups,
        "groups",
    ),
]  # fmt: skip

_CONTROL_MEANINGS = {
    **dict.fromkeys(("position", "instruction", "pixels"), "position, instruction, pixels"),
    "binding": "beats", "selectivity: backbone": "selectivity", "action": "selectivity", "backbone − twin": "twin",
    "action − twin": "twin",
}  # fmt: skip


def behaviour_table(rows: Sequence[RetentionRow]) -> HtmlTable:
    """Success rates and what they are made of, once per category."""
    return _table("Success rate", once_per_category(rows), _BEHAVIOUR)


def more_behaviour_table(rows: Sequence[RetentionRow]) -> HtmlTable:
    """Success rates by layout and at other zone radii, and the habit of going to one side."""
    radii = dict.fromkeys(radius for row in rows for radius in row.sr_by_epsilon)
    columns = [*_MORE_BEHAVIOUR, *(_radius(radius) for radius in radii)]
    return _table("Success rate by layout and zone radius", once_per_category(rows), columns)


def retention_table(rows: Sequence[RetentionRow]) -> HtmlTable | None:
    """Probes and retention; None if no run was probed."""
    return _table("Probes and retention", probed(rows), _RETENTION) if probed(rows) else None


def control_table(rows: Sequence[RetentionRow]) -> HtmlTable | None:
    """Baselines, selectivity and twin; None if nothing was controlled."""
    if not controlled(rows):
        return None
    columns = [
        _NAMES[0],
        _VIEW,
        _CALL,
        *(_Column(name, cell, cell, _CONTROL_MEANINGS.get(name)) for name, cell in CONTROL_COLUMNS),
    ]
    return _table("Controls", probed(rows), columns)


def difference_tables(differences: Sequence[Difference]) -> list[HtmlTable]:
    """One table per pair of groups."""
    columns = (
        HtmlColumn("category", "", numeric=False),
        *(HtmlColumn(name, "", name != "view") for name, _ in DIFFERENCE_COLUMNS),
    )
    titles = dict.fromkeys(difference_title(row) for row in differences)
    return [
        HtmlTable(
            title,
            columns,
            tuple(
                (
                    HtmlCell(spell(row.category), row.category),
                    *(HtmlCell(cell(row), cell(row)) for _, cell in DIFFERENCE_COLUMNS),
                )
                for row in differences
                if difference_title(row) == title
            ),
        )
        for title in titles
    ]


def plain_tables(tables: Sequence[PlainTable]) -> list[HtmlTable]:
    """As they are; rows of means stay below when others are sorted."""
    return [
        HtmlTable(
            f"{table.title} ({table.note})",
            tuple(HtmlColumn(_unbroken(name), "", name not in _WORDS) for name in table.columns),
            tuple(tuple(HtmlCell(cell, cell) for cell in cells) for cells in table.cells if MEAN not in cells[:2]),
            tuple(tuple(HtmlCell(cell, cell) for cell in cells) for cells in table.cells if MEAN in cells[:2]),
        )
        for table in tables
    ]


_WORDS = ("model", "category", "prompt")
"""Columns of plain tables that hold no numbers."""


def _radius(radius: str) -> _Column:
    def value(row: RetentionRow) -> float | None:
        return row.sr_by_epsilon.get(radius)

    meaning = "Success rate if the cube had to end this close to the middle of the correct picture."
    return _Column(f"SR % at {1000 * float(radius):g} mm", lambda row: percent(value(row)), value, meaning, value)


def _table(title: str, rows: Sequence[RetentionRow], columns: Sequence[_Column]) -> HtmlTable:
    one_model = len({(row.group, row.run) for row in rows}) == 1
    dull = ("–", model_name(rows[0])) if one_model else ("–",)
    shown = [column for column in columns if any(column.text(row) not in dull for row in rows)]
    return HtmlTable(
        title,
        tuple(_heading(column, rows) for column in shown),
        tuple(tuple(_cell(column, row) for column in shown) for row in rows if row.category != MEAN),
        tuple(tuple(_cell(column, row) for column in shown) for row in rows if row.category == MEAN),
    )


def _heading(column: _Column, rows: Sequence[RetentionRow]) -> HtmlColumn:
    meaning = column.meaning or ""
    return HtmlColumn(
        _unbroken(column.name),
        GLOSSARY.get(meaning, meaning),
        any(column.text(row)[:1].isdigit() for row in rows),
    )


def _unbroken(name: str) -> str:
    """A heading that does not break before a unit."""
    return name.replace(" %", "\u00a0%").replace("± ", "±\u00a0")


def _cell(column: _Column, row: RetentionRow) -> HtmlCell:
    heat = None if column.heat is None else column.heat(row)
    text = column.text(row)
    return HtmlCell(
        text=text,
        sort=column.sort(row),
        heat=heat_colour(heat) if isinstance(heat, float) else None,
        strong=column.strong is not None and column.strong(row),
        alarm=text.endswith(ABOVE_CHANCE),
        note=column.note(row) if column.note else "",
    )
