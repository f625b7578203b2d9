"""Runs that lie elsewhere, such as those made by hand, and serve a study where they are equal."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit.errors import ProbeKitError
from probe_kit.extract.extraction import Extraction
from probe_kit.hashing import canonical_json
from probe_kit.runs import open_run
from probe_kit.runs.growth import further_rows
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.root import read_root
from probe_kit.runs.store import locate

if TYPE_CHECKING:
    from probe_kit.runs import Run

_DEPTHS = ("", "*/", "*/*/")
"""Below a folder, where runs are looked for: a study's own lie two folders down."""


def find_equal_run(extraction: Extraction, folders: Sequence[str], own: str) -> "Run | None":
    """The first run in `folders` of equal identity that holds every episode of the extraction, finished.

    own: where the extraction will be written; a run that lies there already goes before all others.
    """
    if not folders or locate(own).exists(RUN_FILE):
        return None
    asked: dict[str, Any] = json.loads(canonical_json(extraction.identity()))
    rows = extraction.plan.to_json()["episodes"]
    return next(_equal(folders, asked, rows), None)


def _equal(folders: Sequence[str], asked: dict[str, Any], rows: list[dict[str, Any]]) -> Iterator["Run"]:
    for place in _places(folders):
        try:
            root = read_root(locate(place))
            if root.own_settings != asked or further_rows(root.plan, rows, str(place)):
                continue
            run = open_run(place, allow_partial=True)
        except ProbeKitError:  # damaged, of another version, or of other items: it serves nothing
            continue
        if {row["episode_id"] for row in rows} <= set(run.episodes["episode_id"]):
            yield run


def _places(folders: Sequence[str]) -> list[Path]:
    found = (file.parent for one in folders for depth in _DEPTHS for file in Path(one).glob(f"{depth}{RUN_FILE}"))
    return sorted(set(found))
