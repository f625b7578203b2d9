"""The protocol of a run, and checks of its episodes and captured inferences."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import counted
from probe_kit.errors import UsageError
from probe_kit.runs.reader import RunReader, Tokens

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RunReader", "Tokens", "check_call", "check_several_wordings", "reached_calls"]


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        wordings = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({wordings}); probes and success rates take one. Choose "
            "it with --wording NAME, or `run.in_wording(NAME)` in Python"
        )


def check_call(run: RunReader, call: int) -> None:
    """Raise UsageError if no such inference was captured, and for a run that does not keep them apart."""
    captured = run.captured_calls
    if call and not 0 < call < captured:
        raise UsageError(
            f"{run.location} has {counted(captured, 'captured inference')} per episode, counted from 0; "
            f"there is no {call}. Extract with --captured-calls {call + 1} or more"
        )


def reached_calls(run: RunReader) -> NDArray[np.bool_]:
    """(E, C) whether an episode has a captured inference; all have the only one of a run not made by probe_kit."""
    if not hasattr(run, "reached"):
        return np.ones((len(run.episodes), 1), bool)
    return np.stack([run.reached(call) for call in range(run.captured_calls)], axis=1)
