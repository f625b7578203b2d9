"""Readers of all interventions of a run, for its verification."""

from collections.abc import Callable, Iterator
from functools import partial

from probe_kit.intervene.results.results import effects_of
from probe_kit.intervene.store.answers import StoredIntervention, read_interventions, stored_interventions
from probe_kit.runs.run import Run


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """A function per stored intervention, which reads all of it. Raises RunDamagedError where one is none.

    Those of episodes that the run has no more are listed alone, as reading does.
    """
    read_interventions(run.location)
    for wording in run.wordings or (None,):
        shown = run if wording is None else run.in_wording(wording)
        for stored in stored_interventions(shown):
            yield partial(_read, shown, stored)


def _read(run: Run, stored: StoredIntervention) -> object:
    return effects_of(run, stored).to_json()
