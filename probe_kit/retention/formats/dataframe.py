"""Rows as data frames whose types do not depend on the values: the one place where parts become flat columns."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from probe_kit.retention.columns.text import model_name, once_per_category
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.parts import RetentionPart
from probe_kit.retention.rows.row import RetentionRow

if TYPE_CHECKING:
    import pandas as pd

_DTYPES = {float: "float64", int: "Int64", bool: "bool", str: "string"}


def frame_of(rows: Sequence[RetentionRow] | Sequence[Difference]) -> "pd.DataFrame":
    """One line per row, with `part.field` for the fields of its parts.

    Floats stay floats, undefined ones are NaN; whole numbers and text are nullable. Intervals become two columns,
    `ci_low` and `ci_high`; what is kept by name one column per name, such as `controls.baselines.pixels`.
    """
    return _frame([_flat(_defined(row)) for row in rows])


def part_frame(rows: Sequence[RetentionRow], part: str, by_view: bool = True) -> "pd.DataFrame":
    """One part of every row, keyed by `run`, `category` and, of what depends on probes, `view`.

    part: its name in `RetentionRow`. by_view: whether it depends on the view; else every category stands once.
    """
    of_views = [row for row in rows if row.view is not None] if by_view else once_per_category(rows)
    return _frame([_key(row, by_view) | _flat(getattr(_defined(row), part)) for row in of_views])


def peak_frame(rows: Sequence[RetentionRow]) -> "pd.DataFrame":
    """The best sites, one line per run, category, view and `stream`: `backbone` and `action`."""
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
"""By column its type in pandas and its value."""


def _frame(lines: Sequence[_Flat]) -> "pd.DataFrame":
    import pandas as pd

    dtypes = {name: dtype for line in lines for name, (dtype, _) in line.items()}
    values = [{name: value for name, (_, value) in line.items()} for line in lines]
    frame = pd.DataFrame(values, columns=list(dtypes))
    return frame.astype({name: _nullable(dtype, bool(frame[name].isna().any())) for name, dtype in dtypes.items()})


def _nullable(dtype: str, has_gaps: bool) -> str:
    return "boolean" if dtype == "bool" and has_gaps else dtype  # numpy's has no missing value


def _key(row: RetentionRow, by_view: bool) -> _Flat:
    key: _Flat = {"run": ("string", model_name(row)), "category": ("string", row.category)}
    return key | ({"view": ("string", row.view)} if by_view else {})


def _defined(row: Any) -> Any:
    """The row without numbers of retention where it is not defined."""
    if not isinstance(row, RetentionRow) or row.retention.defined:
        return row
    return replace(row, retention=RetentionPart(note=row.retention.note, reason=row.retention.reason))


def _flat(part: Any, before: str = "") -> _Flat:
    """The fields of a dataclass by their path; those of its own parts and names behind a dot."""
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
            flat |= {f"{name}.{key}": _heading_and_value(number) for key, number in value.items()}
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


def _heading_and_value(value: Any) -> tuple[str, Any]:
    return ("boolean" if isinstance(value, bool) or value is None else "float64"), value


def _dtype(hint: Any) -> str:
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind in _DTYPES]
    return _DTYPES[kinds[0]] if kinds else "string"
