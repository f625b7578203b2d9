"""The retention table as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from probe_kit.retention.columns.findings import finding
from probe_kit.retention.columns.sentences import conclusion, verdict
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow


def table_json(
    rows: Sequence[RetentionRow], differences: Sequence[Difference], beside: Mapping[str, Sequence[Any]]
) -> str:
    """See `RetentionTable.to_json`. beside: further lists of dataclasses by their name, shown if not empty."""
    between_runs = [one for one in differences if one.run is not None]
    between_groups = [one for one in differences if one.run is None]
    several = len({row.run.location for row in rows}) > 1 and not any(row.group for row in rows)
    lines = [asdict(row) | _in_words(row) | (_own(row, between_runs) if several else {}) for row in rows]
    lists = {"differences": between_groups, **beside}
    shown = {name: [asdict(one) for one in found] for name, found in lists.items() if found}
    content = {"rows": lines, **shown} if shown else lines
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)


def _in_words(row: RetentionRow) -> dict[str, Any]:
    """The verdict and what follows from it, as tables and sentences have them; None of a mean."""
    if row.category == MEAN:
        return {"verdict": None, "finding": None, "conclusion": None}
    return {"verdict": verdict(row), "finding": finding(row), "conclusion": conclusion(row)}


def _own(row: RetentionRow, differences: Sequence[Difference]) -> dict[str, Any]:
    """What a row of one of several runs says of the others; a difference of behaviour stands in every view."""
    found = [
        asdict(one)
        for one in differences
        if (one.run, one.category) == (row.run.location, row.category) and one.view in (row.view, None)
    ]
    return {"differences": found}
