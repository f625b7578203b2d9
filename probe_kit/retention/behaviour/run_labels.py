"""The names of runs in tables, figures and titles, no two of them equal."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.success_rate import capture_only
from probe_kit.runs.reader import RunReader, full_name

_MARKS: Sequence[Callable[[RunReader, int], str]] = (
    lambda run, _: run.settings_sha256[:6],
    lambda run, _: run.location.name,
    lambda _, number: str(number),
)
"""What is added to a name that comes twice, one after the other, until none does: settings, folder, number."""


def distinct_labels(runs: Sequence[RunReader], names: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the label of each run by its location, so that no two full names are equal.

    names: labels by location instead of the runs' own. Runs of one name get the hash of their settings, where that
    is the same their folders, and else a number. Raises UsageError for a label of a run that is none of these.
    """
    labels = {str(run.location): run.label for run in runs}
    if unknown := sorted((names or {}).keys() - labels.keys()):
        raise UsageError(f"labels are given for {', '.join(unknown)}; the runs are {', '.join(labels)}")
    labels |= names or {}
    for mark in _MARKS:
        doubles = _doubles(runs, labels)
        for number, run in enumerate(runs, 1):
            if str(run.location) in doubles:
                labels[str(run.location)] += f" · {mark(run, number)}"
    return labels


def full_names(runs: Sequence[RunReader], labels: Mapping[str, str] | None = None) -> list[str]:
    """The full names of runs, in order; labels: by location, distinct ones by default."""
    called = distinct_labels(runs) if labels is None else labels
    return [full_name(called[str(run.location)], run.random_weights, capture_only(run.episodes)) for run in runs]


def _doubles(runs: Sequence[RunReader], labels: Mapping[str, str]) -> set[str]:
    names = full_names(runs, labels)
    often = Counter(names)
    return {str(run.location) for run, name in zip(runs, names, strict=True) if often[name] > 1}
