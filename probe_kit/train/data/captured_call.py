"""A run restricted to one captured inference, with the episodes that reached it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import counted
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.rows import TokenBlock
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    import pandas as pd


def restrict_to_call(run: RunReader, call: int) -> RunReader:
    """`run` at captured inference `call`, counted from 0; episodes that ended before it are left out.

    Raises UsageError if no such inference was captured, and for a run that does not keep them apart.
    """
    if call == 0:
        return run
    captured = captured_calls(run)
    if not 0 < call < captured:
        raise UsageError(
            f"{run.location} has {counted(captured, 'captured inference')} per episode, counted from 0; "
            f"there is no {call}. Extract with --captured-calls {call + 1} or more"
        )
    return _AtCall(run, call)


def captured_calls(run: RunReader) -> int:
    """Inferences captured per episode, at most; 1 for a run that was not made by probe_kit."""
    return int(getattr(run, "captured_calls", 1))


@dataclass(frozen=True)
class _AtCall:
    """A `RunReader` that reads another one at one captured inference."""

    run: Any
    call: int

    def __getattr__(self, name: str) -> Any:
        return getattr(self.run, name)

    @cached_property
    def _rows(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.run.reached(self.call))

    @cached_property
    def episodes(self) -> "pd.DataFrame":
        """Those that got as far as this inference."""
        episodes: pd.DataFrame = self.run.episodes.iloc[self._rows]
        return episodes.reset_index(drop=True)

    def column(self, site: Site, view: str) -> NDArray[np.float32]:
        """(E, D) features of one site."""
        column: NDArray[np.float32] = self.run.column(site, view, self.call)
        return column[self._rows]

    def token_mask(self, site: Site, role: str | None = None) -> NDArray[np.bool_]:
        """(E, T) positions of `role` at one site."""
        mask: NDArray[np.bool_] = self.run.token_mask(site, role, self.call)
        return mask[self._rows]

    def iter_token_blocks(self, site: Site, role: str | None = None) -> Iterator[TokenBlock]:
        """Those tokens, some positions of all episodes at a time."""
        for block in self.run.iter_token_blocks(site, role, self.call):
            yield TokenBlock(block.start, block.values[self._rows], block.mask[self._rows])

    def views(self, stream: str) -> Sequence[str]:
        """Pooled views stored for `stream`."""
        views: Sequence[str] = self.run.views(stream, self.call)
        return views
