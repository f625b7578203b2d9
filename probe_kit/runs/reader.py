"""`RunReader`, a run, stored or in memory, as probes, tables and interventions read it; and its checks."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit.errors import UsageError
from probe_kit.runs.run_source import Origin

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.array_run import ArrayRun
    from probe_kit.runs.run import Run


SIDE = "side_correct"
"""The column of episodes whose question has a correct picture on one side."""


type RunReader = Run | ArrayRun
"""A finished or growing run from `open_run`, or one of arrays in memory: what probes and tables read."""


# -- checks ------------------------------------------------------------------------------------------------------


def full_name(label: str, random_weights: bool, captured_only: bool = False) -> str:
    """Return the label of a run, marked if the weights are random or the model only captured."""
    return label + (" (random weights)" if random_weights else "") + (" (capture only)" if captured_only else "")


def origin_of(run: RunReader) -> Origin:
    """Return files and choices that the run was made of; an empty origin where none is recorded."""
    return run.origins[0] if run.origins else Origin()


def check_sides(run: RunReader, purpose: str) -> None:
    """Raise UsageError for a run without sides; the message says that `purpose` is not possible without them."""
    if SIDE not in run.episodes:
        location = as_argument(run.location)
        raise UsageError(
            f"{run.location} has no column {SIDE}: {run.source.words}. There are no sides, so {purpose} is not "
            f"possible. `probe-kit targets {location}` lists what can be decoded, `probe-kit labels {location}` "
            "writes a table for labels of your own"
        )


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        wordings = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({wordings}); probes and success rates take one. Choose "
            "it with --wording NAME, or `run.in_wording(NAME)` in Python"
        )


def check_call(run: RunReader, call: int) -> None:
    """Raise UsageError if no such inference was captured."""
    captured = run.captured_calls
    if call and not 0 < call < captured:
        raise UsageError(
            f"{run.location} has {plural(captured, 'captured inference')} per episode, counted from 0; "
            f"there is no {call}. Extract with --captured-calls {call + 1} or more"
        )


def reached_calls(run: RunReader) -> NDArray[np.bool_]:
    """Return whether each episode has each captured inference, as a mask (E, C)."""
    return np.stack([run.reached(call) for call in range(run.captured_calls)], axis=1)
