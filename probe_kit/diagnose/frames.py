"""The frames of a run that are diagnosed: first inferences, of as many groups as there are."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import zip_longest
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from probe_kit.errors import UsageError
from probe_kit.extract.sources.donors import Frame
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.sessions.observed import ObservedSession

if TYPE_CHECKING:
    from probe_kit.intervene.sessions.session import ReplaySession

LEAST_GROUPS = 6
"""Fewer groups cannot show at p < 0.05 that anything matters, by sign flips of whole groups: 2⁻⁵ is 0.03."""


def frames_of(
    session: "ReplaySession", count: int, paraphrases: Mapping[str, str] = MappingProxyType({})
) -> list[Frame]:
    """The first frames of `count` episodes, from as many groups as possible; all where the run has fewer.

    paraphrases: by instruction, other words of the same meaning. Raises UsageError for a run with too few groups.
    """
    listed = _observed(session, count) if isinstance(session, ObservedSession) else _drawn(session, count)
    frames = [replace(frame, other_words=paraphrases.get(frame.observation.instruction, "")) for frame in listed]
    groups = len({frame.group for frame in frames})
    if groups < LEAST_GROUPS:
        raise UsageError(
            f"{session.run.location} has frames of {groups} groups; a diagnosis needs at least {LEAST_GROUPS}. "
            "Extract more episodes or items"
        )
    return frames


def _observed(session: ObservedSession, count: int) -> Iterator[Frame]:
    """Frames of recordings or of an environment: one of every group in turn, spread over its frames."""
    groups: dict[str, list[Frame]] = {}
    for frame in session.frames.index:
        groups.setdefault(frame.group, []).append(frame)
    turns = -(-count // len(groups))
    spread = [
        [frames[int(at)] for at in np.unique(np.linspace(0, len(frames) - 1, min(turns, len(frames))).round())]
        for frames in groups.values()
    ]
    in_turn = [frame for turn in zip_longest(*spread) for frame in turn if frame is not None]
    yield from in_turn[:count]


def _drawn(session: "ReplaySession", count: int) -> Iterator[Frame]:
    """First frames of the scene: one episode of one item of every group, then of another item."""
    episodes = session.run.episodes
    turn = episodes.groupby("group_id", sort=False).cumcount()
    # Of every group another episode in its turn, so that not all are the first layout of their item.
    order = pd.DataFrame({"turn": turn, "group": pd.factorize(episodes["group_id"])[0]})
    order["mixed"] = (order["turn"] + order["group"]) % order.groupby("group")["turn"].transform("size")
    rows = order.sort_values(["mixed", "group"], kind="stable").index[:count]
    for row in rows:
        for pair in session.pairs(str(episodes.loc[row, "item_id"])):
            if pair.row == episodes.index.get_loc(row):
                assert isinstance(pair.clean, Observation), "runs of policies hold observations"
                yield Frame.of(pair.episode, pair.clean, pair.group or pair.episode, pair.seed)
