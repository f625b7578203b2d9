"""Sentences about settings that rows of one table should share and do not."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import CORRECT, SIDES
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.settings import ProbeSettings

_COMPARED: Mapping[str, Callable[[ProbeSettings], str]] = {
    "targets": lambda settings: settings.target,
    "views": lambda settings: ", ".join(settings.views),
    "label permutations": lambda settings: str(settings.permutations),
    "label permutations of token views": lambda settings: str(settings.token_permutations),
    "captured inferences": lambda settings: str(settings.call),
    "seeds": lambda settings: str(settings.seed),
    "categories": lambda settings: ", ".join(settings.categories),
}


def mixed_episodes(runs: Sequence[RunReader]) -> list[str]:
    """A sentence for every run whose episodes were not all made by the same device kind and versions."""
    return [
        f"{run.location} is mixed: its episodes were made with other {', '.join(mixed)}, which changes numbers "
        "(--allow-mixed)."
        for run in runs
        if (mixed := run.mixed)
    ]


def chosen_wordings(runs: Sequence[RunReader]) -> list[str]:
    """A sentence for every run that was asked in several wordings: which one its rows are of."""
    return [
        f"Rows of {run.location} are of the wording {run.episodes['wording'].iloc[0]!r}; it was asked in "
        f"{', '.join(names)} (--wording)."
        for run in runs
        if (names := run.wordings)
    ]


def mixed_settings(results: Mapping[str, ProbeResults], views: Sequence[str] | None = None) -> list[str]:
    """A sentence if the probes of several runs were not fitted alike, and one for labels that are not the answer.

    views: those that are shown, if not all are; then it does not matter which others there are.
    """
    differences = []
    for name, value in _COMPARED.items():
        if name == "views" and views is not None:
            continue
        runs: dict[str, list[str]] = {}
        for run, probes in results.items():
            runs.setdefault(value(probes.settings), []).append(Path(run).name)
        if len(runs) > 1:
            parts = (f"{setting} ({', '.join(names)})" for setting, names in runs.items())
            differences.append(f"{name} {' against '.join(parts)}")
    labels = {probes.settings.target for probes in results.values()} - {CORRECT}
    notes = [f"Probes were asked for the target {label!r}: {SIDES[label]}." for label in sorted(labels)]
    calls = {probes.settings.call for probes in results.values()} - {0}
    notes += [f"Probes are of captured inference {call}, counted from 0." for call in sorted(calls)]
    if not differences:
        return notes
    return [
        *notes,
        f"The rows mix probe settings: {'; '.join(differences)}. Compare them with care, or fit all runs alike; "
        "`probe-kit run show RUN` lists what a run has, --probes RUN=KEY chooses.",
    ]
