"""Tables of the report: cells with what they show, what they sort by, and their heat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.columns.glossary import GLOSSARY
from probe_kit.retention.columns.lines import (
    TableRow,
    behaviour_lines,
    cell_of,
    compared,
    difference_legend,
    difference_name,
    probe_lines,
)
from probe_kit.retention.columns.text import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    FOLLOWED_COLUMNS,
    action_place,
    action_value,
    area_value,
    backbone_place,
    backbone_value,
    beats,
    bounded_value,
    call_value,
    category_name,
    controlled,
    debiased_value,
    difference_test,
    model_name,
    number,
    once_per_category,
    percent,
    plain_value,
    probed,
    success_interval,
    view_name,
)
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.formats.heat import heat_colour
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.text import spell
from probe_kit.statistics.significance import SIGNIFICANCE

_REGIMES: dict[str | None, str] = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


@dataclass(frozen=True)
class HtmlCell:
    """sort: what the column sorts by, None for last. heat: background, `#RRGGBB`. strong: bold. alarm: red.

    note: shown on pointing at it. below: a second line, of smaller letters: whose row it is. difference: whether
    the row is that of a difference, which stays below those of runs when these are sorted.
    """

    text: str
    sort: float | str | None = None
    heat: str | None = None
    strong: bool = False
    alarm: bool = False
    note: str = ""
    below: str = ""
    difference: bool = False

    @property
    def value(self) -> str:
        """The text without an interval in square brackets at its end."""
        return self.text.removesuffix(self.limits).rstrip()

    @property
    def limits(self) -> str:
        """That interval with its brackets, empty without one: it may go to a line of its own."""
        start = self.text.find("[")
        return self.text[start:] if start > 0 and self.text.endswith("]") else ""


@dataclass(frozen=True)
class HtmlColumn:
    """explanation: shown on pointing at the heading."""

    name: str
    explanation: str
    numeric: bool


@dataclass(frozen=True)
class HtmlTable:
    """body is sorted by a click on a heading; foot, the means, stays. captions: sentences below it."""

    title: str
    columns: tuple[HtmlColumn, ...]
    body: tuple[tuple[HtmlCell, ...], ...]
    foot: tuple[tuple[HtmlCell, ...], ...] = ()
    captions: tuple[str, ...] = ()


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


_CATEGORY = _Column("category", category_name, category_name, "Kind of question, and of several runs which one.")
_VIEW = _Column("view", view_name, lambda row: row.view or "", "How the tokens of an episode became one vector.")

_CALL = _Column("call", call_value, lambda row: row.call, "call")

_BEHAVIOUR = [
    _CATEGORY,
    _Column(
        "SR % [95 %]", success_interval, lambda row: row.sr, "SR", lambda row: row.sr,
        lambda row: row.regime == Regime.KNOWLEDGE,
    ),
    _Column("p (Holm)", difference_test, lambda _: None, "p (difference)"),
    *(
        _Column(
            f"{name} %" if name != "used" else name, cell, lambda row: row.follows_net, name,
            strong=lambda row: row.used == "used", note=lambda row: row.used_note,
        )
        for name, cell in FOLLOWED_COLUMNS
    ),
    _share("± Δ", "chance_margin", "Δ"),
    _share("paper's Δ", "chance_margin_episodes", "paper's Δ"),
    _Column(
        "reading", _reading,
        lambda row: row.sr, "reading",
    ),
    _share("wrong %", "share_wrong", "wrong"),
    _share("outside %", "share_outside", "outside"),
    _share("never moved %", "share_never_moved", "never moved"),
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
    _CATEGORY,
    _share("original %", "sr_original", "original"),
    _share("swapped %", "sr_swapped", "swapped"),
    _share("goes left %", "side_preference", "goes left"),
    _share("flagged steps %", "share_invalid_action", "flagged"),
]

_RETENTION = [
    _CATEGORY,
    _VIEW,
    _CALL,
    _Column(
        "bounded [95 %]", bounded_value, _bounded, "bounded", _bounded, note=lambda row: row.retention_note,
    ),
    _Column("area [95 %]", area_value, _area, "area", _area),
    _Column("debiased [95 %]", debiased_value, _debiased, "debiased", _debiased),
    _Column("published", plain_value, _retention, "retention", _retention),
    _Column(
        "backbone % [95 %]", backbone_value,
        lambda row: row.backbone_accuracy, "backbone", strong=lambda row: row.backbone_signal,
    ),
    _Column("layer", backbone_place, lambda row: row.backbone_layer, "layer"),
    _Column("p", lambda row: _p(row.backbone_p_fwe), lambda row: row.backbone_p_fwe, "p"),
    _Column(
        "action % [95 %]", action_value,
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
    "binding": "beats", "selectivity: backbone": "selectivity", "action": "selectivity", "backbone − untrained": "untrained",
    "action − untrained": "untrained",
}  # fmt: skip


def behaviour_table(
    rows: Sequence[RetentionRow], differences: Sequence[Difference] = (), unpaired: Sequence[str] = ()
) -> HtmlTable:
    """Success rates and what they are made of, once per category. unpaired: why runs have no differences."""
    lines = behaviour_lines(once_per_category(rows), differences)
    return replace(_table("Success rate", lines, _BEHAVIOUR), captions=(*_captions(lines), *unpaired))


def more_behaviour_table(rows: Sequence[RetentionRow]) -> HtmlTable:
    """Success rates by layout and at other zone radii, and the habit of going to one side."""
    radii = dict.fromkeys(radius for row in rows for radius in row.sr_by_epsilon)
    columns = [*_MORE_BEHAVIOUR, *(_radius(radius) for radius in radii)]
    return _table("Success rate by layout and zone radius", compared(once_per_category(rows)), columns)


def probe_table(rows: Sequence[RetentionRow], differences: Sequence[Difference] = ()) -> HtmlTable | None:
    """Probes and retention; None if no run was probed."""
    if not probed(rows):
        return None
    lines = probe_lines(probed(rows), differences)
    return replace(_table("Probes and retention", lines, _RETENTION), captions=_captions(lines, behaviour=False))


def _captions(lines: Sequence[TableRow], behaviour: bool = True) -> tuple[str, ...]:
    legend = difference_legend([line for line in lines if isinstance(line, Difference)], behaviour)
    return (f"{legend[0].upper()}{legend[1:]}.",) if legend else ()


def control_table(rows: Sequence[RetentionRow]) -> HtmlTable | None:
    """Baselines, selectivity and untrained; None if nothing was controlled."""
    if not controlled(rows):
        return None
    columns = [
        _CATEGORY,
        _VIEW,
        _CALL,
        *(_Column(name, cell, cell, _CONTROL_MEANINGS.get(name)) for name, cell in CONTROL_COLUMNS[1:]),
    ]
    return _table("Controls", compared(probed(rows)), columns)


def plain_tables(tables: Sequence[TextTable]) -> list[HtmlTable]:
    """As they are; rows of means stay below when others are sorted."""
    return [
        HtmlTable(
            table.title,
            tuple(HtmlColumn(_unbroken(name), "", name not in _WORDS) for name in table.columns),
            tuple(tuple(HtmlCell(cell, cell) for cell in cells) for cells in table.cells if MEAN not in cells[:2]),
            tuple(tuple(HtmlCell(cell, cell) for cell in cells) for cells in table.cells if MEAN in cells[:2]),
            (f"{table.note[:1].upper()}{table.note[1:]}.",) if table.note else (),
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


def _table(title: str, lines: Sequence[TableRow], columns: Sequence[_Column]) -> HtmlTable:
    rows = [line for line in lines if isinstance(line, RetentionRow)]
    several = len({(row.group, row.run) for row in rows}) > 1
    shown = [column for column in columns if any(_text(column, line) not in ("–", "") for line in lines)]
    found = {
        is_mean: tuple(
            tuple(_cell(column, line, several) for column in shown)
            for line in lines
            if (line.category == MEAN) == is_mean
        )
        for is_mean in (False, True)
    }
    return HtmlTable(title, tuple(_heading(column, rows) for column in shown), found[False], found[True])


def _heading(column: _Column, rows: Sequence[RetentionRow]) -> HtmlColumn:
    meaning = column.meaning or ""
    numeric = column.text is difference_test or any(column.text(row)[:1].isdigit() for row in rows)
    return HtmlColumn(_unbroken(column.name), GLOSSARY.get(meaning, meaning), numeric)


def _unbroken(name: str) -> str:
    """A heading that does not break before a unit."""
    return name.replace(" %", "\u00a0%").replace("± ", "±\u00a0")


def _text(column: _Column, line: TableRow) -> str:
    return cell_of(column.text, line)


def _cell(column: _Column, line: TableRow, several: bool) -> HtmlCell:
    """several: whether the category says whose row it is."""
    text = _text(column, line)
    below = ""
    if column is _CATEGORY:
        text = spell(text)
        below = _name(line) if several else ""
    if isinstance(line, Difference):
        return HtmlCell(text, _sort_of(text, column), below=below, difference=True)
    heat = None if column.heat is None else column.heat(line)
    return HtmlCell(
        text=text,
        sort=column.sort(line),
        heat=heat_colour(heat) if isinstance(heat, float) else None,
        strong=column.strong is not None and column.strong(line),
        alarm=text.endswith(ABOVE_CHANCE),
        note=column.note(line) if column.note else "",
        below=below,
    )


def _name(line: TableRow) -> str:
    return difference_name(line) if isinstance(line, Difference) else model_name(line)


def _sort_of(text: str, column: _Column) -> float | str | None:
    """Differences are sorted among themselves, by the number that they begin with."""
    if column is _CATEGORY:
        return text
    number_, *_ = text.split() or [""]
    try:
        return float(number_)
    except ValueError:
        return None
