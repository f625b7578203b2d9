"""The frames of a run that are diagnosed: first inferences, of as many groups as there are."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pandas as pd

from probe_kit.diagnose.inputs import Frame
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.observation import Observation

if TYPE_CHECKING:
    from probe_kit.intervene.pairs import Pair
    from probe_kit.intervene.sessions.session import ReplaySession

LEAST_GROUPS = 6
"""Fewer groups cannot show at p < 0.05 that anything matters, by sign flips of whole groups: 2⁻⁵ is 0.03."""


def frames_of(session: "ReplaySession", count: int, paraphrases: dict[str, str] | None = None) -> list[Frame]:
    """The first frames of `count` episodes, from as many groups as possible; all where the run has fewer.

    paraphrases: by instruction, other words of the same meaning. Raises UsageError for a run with too few groups.
    """
    words = paraphrases or {}
    frames = []
    for pair in _pairs(session, count):
        observation = pair.clean
        assert isinstance(observation, Observation), "runs of policies hold observations"
        other = words.get(observation.instruction, "")
        frames.append(Frame(pair.episode, observation, pair.group or pair.episode, pair.seed, other))
    groups = len({frame.group for frame in frames})
    if groups < LEAST_GROUPS:
        raise UsageError(
            f"{session.run.location} has frames of {groups} groups; a diagnosis needs at least {LEAST_GROUPS}. "
            "Extract more episodes or items"
        )
    return frames


def _pairs(session: "ReplaySession", count: int) -> "Iterator[Pair]":
    """One episode of one item of every group, then of another item, until there are `count`."""
    episodes = session.run.episodes
    turn = episodes.groupby("group_id", sort=False).cumcount()
    # Of every group another episode in its turn, so that not all are the first layout of their item.
    order = pd.DataFrame({"turn": turn, "group": pd.factorize(episodes["group_id"])[0]})
    order["mixed"] = (order["turn"] + order["group"]) % order.groupby("group")["turn"].transform("size")
    rows = order.sort_values(["mixed", "group"], kind="stable").index[:count]
    for row in rows:
        item = str(episodes.loc[row, "item_id"])
        yield from (pair for pair in session.pairs(item) if pair.row == episodes.index.get_loc(row))
