"""Compare the numbers of `scripts/fence.py` with stored ones."""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

INTERVAL = re.compile(r"(^|[._])ci([._]|$)|_(low|high)$|at_most|upper|lower")
"""Names of columns that hold the ends of intervals."""
INTERVAL_TOLERANCE = 1e-9
RELATIVE, ABSOLUTE = 1e-3, 2e-3
"""How far numbers of another platform may lie apart."""
RESAMPLED = re.compile(INTERVAL.pattern + r"|(^|[._])(p|p_fwe|p_holm|t)$|_p$")
RESAMPLED_RELATIVE, RESAMPLED_ABSOLUTE = 0.1, 0.1
"""The same for numbers that count draws. A run of the fence has 32: one tie that is rounded otherwise moves p by
0.03, and an end of an interval to the next draw. An AMD processor changed 7 such numbers of a file
that an Intel made."""


NUMBER = re.compile(r"(?<![\w.-])-?\d+\.\d+(?![\w.])")
"""A number with decimals in a sentence, which may be any of these quantities."""


def read(file: Path) -> dict[str, Any]:
    """Return the content of a file of the fence."""
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def differences(old: dict[str, Any], new: dict[str, Any], run: str) -> list[str]:
    """Return a line `run / table / row / column: old → new` per difference of one run.

    Numbers must be equal bit for bit, ends of intervals to 1e-9. On another numeric platform they must be close,
    those that count draws less so, and hashes of arrays are not compared. Columns and tables that only the new
    content has are no difference.
    """
    exact = old["platform"] == new["platform"]
    return list(_run_differences(old["runs"][run], new["runs"].get(run, {}), run, exact))


def platform_differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return a line per part of the numeric platform that differs."""
    names = sorted({*old["platform"], *new["platform"]})
    pairs = [(name, old["platform"].get(name), new["platform"].get(name)) for name in names]
    return [f"{name}: {before} → {after}" for name, before, after in pairs if before != after]


def _run_differences(old: dict[str, Any], new: dict[str, Any], run: str, exact: bool) -> Iterator[str]:
    for table, rows in old.items():
        if table not in new:
            yield f"{run} / {table}: {len(rows)} rows → none"
            continue
        for key in new[table].keys() - rows.keys():
            yield f"{run} / {table} / {key}: none → a new row"
        for key, row in rows.items():
            if key not in new[table]:
                yield f"{run} / {table} / {key}: a row → none"
                continue
            for column, value in row.items():
                path = f"{run} / {table} / {key} / {column}"
                if column not in new[table][key]:
                    yield f"{path}: {value} → no such column"
                elif not _same(value, new[table][key][column], column, exact):
                    yield f"{path}: {value} → {new[table][key][column]}"


def _same(old: Any, new: Any, column: str, exact: bool) -> bool:
    if not exact and isinstance(old, str) and isinstance(new, str) and old.endswith("."):
        # A rounded zero has the sign of its last bit: "-0.00" of an Intel is "0.00" of an AMD processor.
        texts, others = NUMBER.split(old), NUMBER.split(new)
        numbers = zip(NUMBER.findall(old), NUMBER.findall(new), strict=False)
        return texts == others and all(
            math.isclose(float(a), float(b), rel_tol=RESAMPLED_RELATIVE, abs_tol=RESAMPLED_ABSOLUTE)
            for a, b in numbers
        )
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(_same(a, b, column, exact) for a, b in zip(old, new, strict=True))
    if isinstance(old, dict) and isinstance(new, dict):
        return all(name in new and _same(old[name], new[name], f"{column}.{name}", exact) for name in old)
    if not exact and "sha256" in column:
        return True
    if _is_number(old) and _is_number(new):
        if not exact:
            relative, absolute = (
                (RESAMPLED_RELATIVE, RESAMPLED_ABSOLUTE) if RESAMPLED.search(column) else (RELATIVE, ABSOLUTE)
            )
            return math.isclose(old, new, rel_tol=relative, abs_tol=absolute)
        if INTERVAL.search(column):
            return math.isclose(old, new, rel_tol=0, abs_tol=INTERVAL_TOLERANCE)
    return bool(old == new)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
