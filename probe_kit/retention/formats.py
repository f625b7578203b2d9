"""The retention table as data frames, as JSON, and by the paper's own formulas."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from probe_kit._tables.numbers import number, percent
from probe_kit._tables.table import Cell, Table, absent
from probe_kit.retention.behaviour import Regime, normalised_score, regime
from probe_kit.retention.columns.summary import finding
from probe_kit.retention.columns.tables import once_per_category
from probe_kit.retention.columns.text import NOT_ACTED, conclusion, model_name, verdict
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.row import MEAN, RetentionPart, RetentionRow
from probe_kit.statistics.crossfit import CHANCE

if TYPE_CHECKING:
    import pandas as pd


_DTYPES = {float: "float64", int: "Int64", bool: "bool", str: "string"}


def frame_of(rows: Sequence[RetentionRow] | Sequence[Difference]) -> "pd.DataFrame":
    """Return one line per row, with `part.field` for the fields of its parts.

    Floats stay floats, undefined ones are NaN; whole numbers and text are nullable. Intervals become two columns,
    `ci_low` and `ci_high`. A mapping becomes one column per name, such as `controls.baselines.pixels`.
    """
    return _frame([_flat(_defined_numbers(row)) for row in rows])


def part_frame(rows: Sequence[RetentionRow], part: str, by_view: bool = True) -> "pd.DataFrame":
    """Return one part of every row, keyed by `run`, `category` and, for parts that depend on probes, `view`.

    Args:
        rows: Rows of a retention table.
        part: Name of the part in `RetentionRow`.
        by_view: Whether the part depends on the view; else every category is listed once.
    """
    of_views = [row for row in rows if row.view is not None] if by_view else once_per_category(rows)
    return _frame([_key(row, by_view) | _flat(getattr(_defined_numbers(row), part)) for row in of_views])


def peak_frame(rows: Sequence[RetentionRow]) -> "pd.DataFrame":
    """Return the best sites, one line per run, category, view and `stream`: `backbone` and `action`."""
    return _frame(
        [
            _key(row, True) | _flat(getattr(row, stream)) | {"stream": ("string", stream)}
            for row in rows
            if row.view is not None
            for stream in ("backbone", "action")
            if getattr(row, stream).peak is not None
        ]
    )


_Flat = dict[str, tuple[str, Any]]
"""By column, its type in pandas and its value."""


def _frame(lines: Sequence[_Flat]) -> "pd.DataFrame":
    import pandas as pd

    dtypes = {name: dtype for line in lines for name, (dtype, _) in line.items()}
    values = [{name: value for name, (_, value) in line.items()} for line in lines]
    frame = pd.DataFrame(values, columns=list(dtypes))
    # numpy's bool has no missing value
    gaps = {name for name, dtype in dtypes.items() if dtype == "bool" and frame[name].isna().any()}
    return frame.astype({name: "boolean" if name in gaps else dtype for name, dtype in dtypes.items()})


def _key(row: RetentionRow, by_view: bool) -> _Flat:
    key: _Flat = {"run": ("string", model_name(row)), "category": ("string", row.category)}
    return key | ({"view": ("string", row.view)} if by_view else {})


def _defined_numbers(row: Any) -> Any:
    """Return the row without numbers of retention where it is not defined."""
    if not isinstance(row, RetentionRow) or row.retention.defined:
        return row
    return replace(row, retention=RetentionPart(note=row.retention.note, reason=row.retention.reason))


def _flat(part: Any, before: str = "") -> _Flat:
    """Return the fields of a dataclass by their path; those of its own parts and names follow a dot."""
    hints = get_type_hints(type(part))
    flat: _Flat = {}
    for declared in fields(part):
        name, value, hint = f"{before}{declared.name}", getattr(part, declared.name), hints[declared.name]
        inner = next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind)), None)
        if inner is not None:
            flat |= _flat(value, f"{name}.") if value is not None else _empty(inner, f"{name}.")
        elif _is_interval(declared.name):
            flat |= _limits(name, value)
        elif isinstance(value, dict):
            for key, number in value.items():
                is_flag = isinstance(number, bool) or number is None
                flat[f"{name}.{key}"] = ("boolean" if is_flag else "float64", number)
        elif isinstance(value, tuple):
            flat[name] = ("string", " ".join(value))
        else:
            flat[name] = (_dtype(hint), value)
    return flat


def _empty(kind: Any, before: str) -> _Flat:
    hints, flat = get_type_hints(kind), _Flat()
    for declared in fields(kind):
        name = f"{before}{declared.name}"
        flat |= (
            _limits(name, None) if _is_interval(declared.name) else {name: (_dtype(hints[declared.name]), None)}
        )
    return flat


def _is_interval(name: str) -> bool:
    return name == "ci" or name.endswith("_ci")


def _limits(name: str, value: Any) -> _Flat:
    low, high = value or (None, None)
    return {f"{name}_low": ("float64", low), f"{name}_high": ("float64", high)}


def _dtype(hint: Any) -> str:
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind in _DTYPES]
    return _DTYPES[kinds[0]] if kinds else "string"


# -- JSON ----------------------------------------------------------------------------------------------------


def table_json(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference],
    wordings: Sequence[Difference],
    vlm_vla: Sequence[Difference],
) -> str:
    """Return the JSON of a table, see `RetentionTable.to_json`."""
    between_runs = [difference for difference in differences if difference.run is not None]
    between_groups = [difference for difference in differences if difference.run is None]
    several = len({row.run.location for row in rows}) > 1 and not any(row.group for row in rows)
    lines = [asdict(row) | _in_words(row) | (_json_of_row(row, between_runs) if several else {}) for row in rows]
    records = {
        "differences": [asdict(row) for row in between_groups],
        "wordings": list(map(_name_wordings, wordings)),
        "vlm_vla": list(map(_name_vlm_and_policy, vlm_vla)),
    }
    filled = {name: lines_of for name, lines_of in records.items() if lines_of}
    content = {"rows": lines, **filled} if filled else lines
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)


def _in_words(row: RetentionRow) -> dict[str, Any]:
    """Return the verdict and its conclusion, as tables and sentences have them; None of a mean."""
    if row.category == MEAN:
        return {"verdict": None, "finding": None, "conclusion": None}
    words = {"metric": row.metric, "verdict": None} if row.label else {"verdict": verdict(row)}
    return words | {"finding": finding(row), "conclusion": conclusion(row)}


def _json_of_row(row: RetentionRow, differences: Sequence[Difference]) -> dict[str, Any]:
    """Return the differences of a row's run from the others; a difference of behaviour is listed in every view."""
    differences_of = [
        asdict(difference)
        for difference in differences
        if (difference.run, difference.category) == (row.run.location, row.category)
        and difference.view in (row.view, None)
    ]
    return {"differences": differences_of}


def _name_wordings(row: Difference) -> dict[str, Any]:
    """Return two wordings of a run by the words of their table."""
    names = {"run": row.run, "category": row.category, "wording": row.group, "other": row.minus}
    rates = {"sr": row.sr_group, "other_sr": row.sr_minus, "difference": row.sr, "difference_ci": row.sr_ci}
    return names | rates | {"only": row.only, "only_other": row.only_minus} | _test(row)


def _name_vlm_and_policy(row: Difference) -> dict[str, Any]:
    """Return a VLM minus a policy by the words of their table."""
    names = {"asked": row.group, "acted": row.minus, "category": row.category, "paired": row.paired}
    rates = {"accuracy": row.sr_group, "sr": row.sr_minus, "difference": row.sr, "difference_ci": row.sr_ci}
    return names | rates | {"same_frames": row.same_frames, "source": row.source} | _test(row)


def _test(row: Difference) -> dict[str, Any]:
    return {name: getattr(row, name) for name in ("p", "p_holm", "n_items", "of_items", "n_groups")}


# -- the paper's own numbers ---------------------------------------------------------------------------------

EPSILON = 1e-6
"""The ε of the paper's denominator. The paper prints no value: this one only keeps the ratio finite."""
_NOTE = (
    "by the paper's formulas, without correction: Δ over episodes alone; accuracies are maxima over layers and "
    f"iterations; retention = (action − 50 %) / (backbone − 50 % + ε), ε = {EPSILON:g}, its mean over all "
    "categories; VLMs answer in one order of the options"
)


def paper_regime(success: float, margin: float) -> Regime:
    """Return the regime of a success rate in [0, 1] by the band 0.5 ± `margin` alone (paper, section 4.4)."""
    return regime(success, margin, share_wrong=0.0, share_outside=0.0)[0]


def paper_retention(action: float, backbone: float) -> float:
    """Return the retention of two best accuracies in [0, 1] (paper, section 4.5).

    The ratio of both above chance, with ε in the denominator. It is large of either sign where the backbone is at
    chance.
    """
    return (action - CHANCE) / (backbone - CHANCE + EPSILON)


def paper_table(rows: Sequence[RetentionRow], means: Sequence[RetentionRow], outcome_rule: str) -> Table:
    """Return the paper's numbers, category by category and as a mean.

    Keys are `run`, `model`, `view`, `category` (`mean` for the category mean), `episodes`, `sr`, `margin` (Δ over
    episodes), `regime`, `normalised_score` (of means), `backbone`, `action` (maxima over sites) and `retention`.

    Args:
        rows: Rows of a retention table.
        means: One mean per run and view of the same table.
        outcome_rule: The rule by which episodes were judged, in words.
    """
    numbers = []
    for mean in means:
        of_run = [row for row in rows if (*row.key, row.view) == (*mean.key, mean.view)]
        of_categories = [_category_numbers(row) for row in of_run]
        numbers += [*of_categories, _mean_numbers(mean, of_categories)]
    return _table(numbers, outcome_rule)


def _category_numbers(row: RetentionRow) -> dict[str, Any]:
    success, margin = row.success.sr, row.success.chance_margin_episodes
    backbone, action = row.backbone.peak, row.action.peak
    of_band = None if success is None or margin is None else paper_regime(success, margin)
    return {
        **_identity(row),
        "episodes": row.success.n_episodes,
        "sr": success,
        "margin": margin,
        "regime": None if of_band is None else str(of_band),
        "normalised_score": None,
        "backbone": backbone,
        "action": action,
        "retention": None if backbone is None or action is None else paper_retention(action, backbone),
    }


def _mean_numbers(mean: RetentionRow, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the means over categories, each over all that have the number: none is left out for a weak signal."""
    rates = [row["sr"] for row in rows]
    return {
        **_identity(mean),
        "episodes": sum(row["episodes"] for row in rows),
        "sr": _mean(rates),
        "margin": None,
        "regime": None,
        "normalised_score": None if None in rates else normalised_score(rates),
        **{name: _mean([row[name] for row in rows]) for name in ("backbone", "action", "retention")},
    }


def _identity(row: RetentionRow) -> dict[str, Any]:
    return {"run": row.run.location, "model": model_name(row), "view": row.view, "category": row.category}


def _mean(values: Sequence[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return fmean(defined) if defined else None


def _table(numbers: Sequence[dict[str, Any]], outcome_rule: str) -> Table:
    columns = ("model", "category", "SR %", "Δ", "regime", "backbone %", "action %", "retention")
    cells = [
        (
            row["model"] if row["view"] is None else f"{row['model']} · {row['view']}",
            row["category"],
            absent(NOT_ACTED) if row["sr"] is None else Cell(row["sr"], percent),
            Cell(row["margin"], percent),
            f"score {number(row['normalised_score'], 1)}" if row["category"] == MEAN else row["regime"] or "–",
            Cell(row["backbone"], percent),
            Cell(row["action"], percent),
            Cell(row["retention"], number),
        )
        for row in numbers
    ]
    notes = [f"{_NOTE}; {outcome_rule}"]
    return Table.of("As the paper has it", columns, cells, names=2, mean=MEAN, notes=notes, numbers=tuple(numbers))
