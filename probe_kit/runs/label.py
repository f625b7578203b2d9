"""The label of a run: what tables call it. It may be changed at any time, and is no part of the run's identity.

label.json    a record of its own: the label, and the identity of the run that it belongs to
"""

from pathlib import Path

from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.runs.layout import LABEL_FILE
from probe_kit.runs.records import as_record, expect, read_record
from probe_kit.runs.root import Root, read_root
from probe_kit.runs.store import Location, locate

LONGEST_LABEL = 200


def label_run(path: Path | str | Location, label: str) -> None:
    """Give the run at `path` another label; nothing else of it changes.

    label: 1 to 200 printable characters. Raises UsageError for another label, RunNotFoundError if there is no run,
    RunDamagedError if `run.json` was changed.
    """
    root = read_root(locate(path))
    check_label(label)
    root.location.write(LABEL_FILE, label_record(root.identity, label))


def check_label(label: str) -> None:
    """Raise UsageError unless tables can call a run so."""
    if not (label.isprintable() and 0 < len(label) <= LONGEST_LABEL):
        raise UsageError(f"label is {label[:LONGEST_LABEL]!r}; expected 1 to {LONGEST_LABEL} printable characters")


def label_record(identity: str, label: str) -> bytes:
    """`label.json` of the run with this identity."""
    return as_record({"run": identity, "label": label})


def read_label(root: Root) -> str:
    """The label of a run. Raises RunDamagedError if its record is missing, was changed, or is of another run."""
    name = f"{root.location}/{LABEL_FILE}"
    advice = f"Write it anew: `probe-kit run show {root.location} --label LABEL`"
    try:
        record = read_record(root.location.read(LABEL_FILE), name, advice)
    except FileNotFoundError:
        raise RunDamagedError(f"{name} is missing. {advice}") from None
    expect(record, {"run": str, "label": str}, name, advice)
    if record["run"] != root.identity:
        raise RunDamagedError(f"{name} is the label of another run. {advice}")
    return str(record["label"])
