"""The choice among action statistics of several data sets: a checkpoint's own, by name. Imports no torch."""

from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError, UsageError

STATISTICS_FILE = "dataset_statistics.json"
_SHOWN = 40


def read_statistics(file: Path) -> dict[str, Any]:
    """Per data set `{"action": {"q01": …, "q99": …, "mask": …}}`; in the file `action` may be left out.

    Raises CheckpointError for a file that is missing or holds something else.
    """
    values = read_json_object(file, CheckpointError, "Take the file that fine-tuning wrote")
    entries = values.get("norm_stats", values)
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise CheckpointError(f"{file} holds no statistics per data set. Take the file that fine-tuning wrote")
    return {key: entry if "action" in entry else {"action": entry} for key, entry in entries.items()}


def stored_statistics(
    folders: Sequence[Path], otherwise: Mapping[str, Any], source: str
) -> tuple[Mapping[str, Any], str]:
    """The statistics that count for a checkpoint, and the name of their source, for messages.

    `dataset_statistics.json` of the first folder that has one stands alone: fine-tuning wrote it, and a
    configuration still lists the data sets of the base. otherwise: those that count without the file, and `source`
    where they stand. Raises CheckpointError for a file that cannot be read.
    """
    for folder in folders:
        if (file := folder / STATISTICS_FILE).is_file():
            return read_statistics(file), str(file)
    return otherwise, source


def chosen_name(available: Collection[str], requested: str | None, option: str, source: str) -> str:
    """The data set, or robot, whose statistics are used: as chosen, or the only one.

    option: of `-M`, for messages. source: the file that holds them. Raises UsageError for a name that is not
    there, and for several without a choice: no file says whose units the actions get.
    """
    names = sorted(available)
    listed = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
    if requested is None:
        if len(names) == 1:
            return names[0]
        raise UsageError(
            f"{source} has several action statistics, and nothing says whose units the actions get. Choose one "
            f"with -M {option}=NAME: {listed}"
        )
    if requested not in available:
        near = get_close_matches(requested, names, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise UsageError(
            f"{source} has no action statistics of {requested!r}. Choose one with "
            f"-M {option}=NAME: {listed}.{hint}"
        )
    return requested
