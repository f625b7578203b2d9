"""The retention table as JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from probe_kit.retention.columns.findings import finding
from probe_kit.retention.columns.label_sentences import label_details
from probe_kit.retention.columns.sentences import conclusion, verdict
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow


def table_json(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference],
    wordings: Sequence[Difference],
    vlm_vla: Sequence[Difference],
) -> str:
    """See `RetentionTable.to_json`."""
    between_runs = [difference for difference in differences if difference.run is not None]
    between_groups = [difference for difference in differences if difference.run is None]
    several = len({row.run.location for row in rows}) > 1 and not any(row.group for row in rows)
    lines = [asdict(row) | _in_words(row) | (_json_of_row(row, between_runs) if several else {}) for row in rows]
    records = {
        "differences": [asdict(row) for row in between_groups],
        "wordings": list(map(_of_wordings, wordings)),
        "vlm_vla": list(map(_of_vlm_and_policy, vlm_vla)),
    }
    filled = {name: lines_of for name, lines_of in records.items() if lines_of}
    content = {"rows": lines, **filled} if filled else lines
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)


def _in_words(row: RetentionRow) -> dict[str, Any]:
    """The verdict and what follows from it, as tables and sentences have them; None of a mean."""
    if row.category == MEAN:
        return {"verdict": None, "finding": None, "conclusion": None}
    if not row.is_side:
        words = {"metric": row.metric, "verdict": None}
        return words | {"finding": finding(row), "conclusion": label_details(row)}
    return {"verdict": verdict(row), "finding": finding(row), "conclusion": conclusion(row)}


def _json_of_row(row: RetentionRow, differences: Sequence[Difference]) -> dict[str, Any]:
    """Return the differences of a row's run from the others; a difference of behaviour stands in every view."""
    differences_of = [
        asdict(difference)
        for difference in differences
        if (difference.run, difference.category) == (row.run.location, row.category)
        and difference.view in (row.view, None)
    ]
    return {"differences": differences_of}


def _of_wordings(row: Difference) -> dict[str, Any]:
    """Two wordings of a run by the words of their table."""
    names = {"run": row.run, "category": row.category, "wording": row.group, "other": row.minus}
    rates = {"sr": row.sr_group, "other_sr": row.sr_minus, "difference": row.sr, "difference_ci": row.sr_ci}
    return names | rates | {"only": row.only, "only_other": row.only_minus} | _test(row)


def _of_vlm_and_policy(row: Difference) -> dict[str, Any]:
    """A VLM minus a policy by the words of their table."""
    names = {"asked": row.group, "acted": row.minus, "category": row.category, "paired": row.paired}
    rates = {"accuracy": row.sr_group, "sr": row.sr_minus, "difference": row.sr, "difference_ci": row.sr_ci}
    return names | rates | {"same_frames": row.same_frames, "source": row.source} | _test(row)


def _test(row: Difference) -> dict[str, Any]:
    return {name: getattr(row, name) for name in ("p", "p_holm", "n_items", "of_items", "n_groups")}
