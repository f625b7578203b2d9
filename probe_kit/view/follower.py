"""Following of runs that grow: episodes that were committed since the page was made."""

from dataclasses import dataclass

from probe_kit.runs.layout import COMMITS, FAILED
from probe_kit.view.catalogue import Catalogue


@dataclass(frozen=True)
class Growth:
    """How far a run is. run: its key. failed: episodes that were given up."""

    run: str
    committed: int
    planned: int
    failed: int


class Follower:
    """The runs of a catalogue that were unfinished; `poll` puts their new episodes into the catalogue."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._keys = [key for key in catalogue.runs if not self._is_finished(key)]

    @property
    def is_growing(self) -> bool:
        """Whether any run was unfinished."""
        return bool(self._keys)

    def poll(self) -> list[Growth]:
        """List commits and failures of every unfinished run, and read new commits only."""
        return [self._poll(key) for key in self._keys]

    def _poll(self, key: str) -> Growth:
        run = self._catalogue.runs[key].run
        known = {COMMITS: len(run.commits()), FAILED: len(run.failed)}
        if not self._is_finished(key) and any(len(run.location.keys(where)) != n for where, n in known.items()):
            run = run.grown()
            self._catalogue.replace(key, run)
        return Growth(key, len(run.commits()), run.planned, len(run.failed))

    def _is_finished(self, key: str) -> bool:
        run = self._catalogue.runs[key].run
        return len(run.commits()) >= run.planned
