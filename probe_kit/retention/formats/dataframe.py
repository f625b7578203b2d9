"""Rows as a data frame whose types do not depend on the values."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import RetentionRow

if TYPE_CHECKING:
    import pandas as pd

_UNDEFINED = (
    "retention", "retention_debiased", "retention_ci", "retention_bounded", "retention_bounded_ci",
    "retention_area", "retention_area_ci",
)  # fmt: skip
"""Fields that mean nothing where `retention_defined` is False."""
_DTYPES = {float: "float64", int: "Int64", bool: "bool", str: "string"}


def frame_of(rows: Sequence[RetentionRow] | Sequence[Difference]) -> "pd.DataFrame":
    """One line per row. Floats stay floats, undefined ones are NaN; whole numbers and text are nullable."""
    import pandas as pd

    if not rows:
        return pd.DataFrame()
    flat = [_flat(_defined(asdict(row))) for row in rows]
    hints = get_type_hints(type(rows[0]))
    names = list(dict.fromkeys(name for line in flat for name in line))
    return pd.DataFrame(flat, columns=names).astype({name: _dtype(hints.get(name)) for name in names})


def _defined(row: dict[str, Any]) -> dict[str, Any]:
    undefined = row.get("retention_defined") is False
    return row | dict.fromkeys(_UNDEFINED) if undefined else row


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """One value per column: limits, names and lists spread or joined."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if name.endswith("_ci"):
            low, high = value if isinstance(value, tuple) else (None, None)
            flat |= {f"{name}_low": low, f"{name}_high": high}
        elif isinstance(value, dict):
            flat |= {f"{name}.{key}": part for key, part in value.items()}
        else:
            flat[name] = " ".join(value) if isinstance(value, tuple) else value
    return flat


def _dtype(hint: Any) -> str:
    """Of a field; columns that are no field are limits and what is kept by name, which are floats."""
    if hint is None:
        return "float64"
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind in _DTYPES]
    return _DTYPES[kinds[0]] if kinds else "string"
