"""The protocol of a run, and what probes ask of its episodes."""

from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.runs.reader import RunReader, Tokens

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RunReader", "Tokens", "check_several_wordings"]


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        wordings = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({wordings}); probes and success rates take one. Choose "
            "it with --wording NAME, or `run.in_wording(NAME)` in Python"
        )
