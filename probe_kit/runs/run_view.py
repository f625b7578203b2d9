"""A view of a run: the same run with other episodes or outcomes, for answers by a score, wordings and rules.

A view has the class of the run and shares what was read of it. The index of its episodes is their position in the
run.
"""

from copy import copy
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd


class Viewable(Protocol):
    """A run, stored or in memory, that a view can be made of."""

    @property
    def viewed(self) -> Any:
        """The run that this is a view of; None for a run itself."""


def view_run[R: Viewable](run: R, episodes: "pd.DataFrame", **reading: Any) -> R:
    """Return a run with other episodes or outcomes; rows of arrays and trajectories stay those of the whole run.

    Args:
        run: A run, or a view of one.
        episodes: The episodes that the view shows, or their outcomes by another reading; the index of a row is its
            position in the run.
        **reading: Attributes of the run that say how it is read, such as `score`, or `rule` and `last_steps`.
    """
    view = copy(run)
    # `episodes` is a cached property of stored runs: what the instance holds takes its place.
    vars(view).update(episodes=episodes, viewed=run if run.viewed is None else run.viewed, **reading)
    return view
