"""The label of a run: its name in tables. It may be changed at any time, and is no part of the run's identity."""

from pathlib import Path
from typing import ClassVar

from probe_kit.errors import UsageError
from probe_kit.runs.layout import LABEL_FILE
from probe_kit.runs.records import Record
from probe_kit.runs.root import Root, read_root
from probe_kit.runs.store import Location, locate

LONGEST_LABEL = 200


class Label(Record):
    """`label.json`: the label, and the identity of the run that it belongs to."""

    kind: ClassVar[str] = "label"
    run: str
    label: str


def label_run(path: Path | str | Location, label: str) -> None:
    """Give the run at `path` another label; nothing else of it changes.

    label: 1 to 200 printable characters. Raises UsageError for another label, RunNotFoundError if there is no run,
    RunDamagedError if `run.json` was changed.
    """
    root = read_root(locate(path))
    check_label(label)
    root.location.write(LABEL_FILE, Label(run=root.identity, label=label).to_bytes())


def check_label(label: str) -> None:
    """Raise UsageError unless tables can call a run so."""
    if not (label.isprintable() and 0 < len(label) <= LONGEST_LABEL):
        raise UsageError(f"label is {label[:LONGEST_LABEL]!r}; expected 1 to {LONGEST_LABEL} printable characters")


def read_label(root: Root) -> str:
    """The label of a run. Raises RunDamagedError if its record is missing, was changed, or is of another run."""
    advice = f"Write it anew: `probe-kit run show {root.location} --label LABEL`"
    return Label.read(root.location, LABEL_FILE, advice, run=root.identity).label
