"""The frames that are diagnosed: of the scene both items of a group, of other sources from all of their groups."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd

from probe_kit.diagnose.inputs import LEAST_GROUPS, frames_of, order_of_first_frames
from probe_kit.extract.sources.inputs import Frame
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.frame_session import FrameSession


def played(groups: int, items: int, layouts: int) -> pd.DataFrame:
    names = [(f"g{g}", f"g{g} i{i}", n) for g in range(groups) for i in range(items) for n in range(layouts)]
    return pd.DataFrame(names, columns=["group_id", "item_id", "layout"])


def test_both_items_of_a_group_are_taken_in_one_layout_before_further_groups_are() -> None:
    episodes = played(5, 2, 2)
    ordered = episodes.loc[order_of_first_frames(episodes, 2)]
    first = ordered[:4]
    assert set(first["group_id"]) == {"g0", "g1"}
    assert (first.groupby("group_id")["item_id"].nunique() == 2).all()
    assert (first.groupby("group_id")["layout"].nunique() == 1).all()
    assert list(ordered["group_id"][4:6]) == ["g2", "g3"]
    assert list(ordered.index.sort_values()) == list(episodes.index), "every episode once"


def test_items_and_layouts_begin_in_turn() -> None:
    episodes = played(4, 2, 2)
    first = episodes.loc[order_of_first_frames(episodes, 4)][:4]
    assert [item[-1] for item in first["item_id"]] == ["0", "1", "0", "1"]
    assert set(first["layout"]) == {0, 1}


def test_groups_of_one_episode_give_as_many_frames_as_there_are_groups() -> None:
    episodes = played(6, 1, 1)
    assert list(order_of_first_frames(episodes, 3)) == list(range(6))


def recorded(groups: int, length: int) -> Any:
    """A session of recordings whose task changes in the middle of the data set."""
    blank = np.zeros((2, 2, 3), np.uint8)
    frames = [
        Frame.of(
            f"{group}:{number}",
            Observation(blank, np.array([number], np.float32), "lift" if 2 * group < groups else "push"),
            f"episode {group}",
            0,
        )
        for group in range(groups)
        for number in range(length)
    ]
    session = cast("Any", object.__new__(FrameSession))
    session.frames = SimpleNamespace(index=frames)
    return session


def test_frames_of_a_data_set_come_from_all_of_its_episodes_and_from_every_phase() -> None:
    frames = frames_of(recorded(100, 10), 24)
    assert len({frame.group for frame in frames}) == 24
    assert {frame.instruction for frame in frames} == {"lift", "push"}
    assert len({float(frame.state[0]) for frame in frames}) > 6


def test_few_episodes_give_several_frames_each_and_none_twice() -> None:
    frames = frames_of(recorded(LEAST_GROUPS, 10), 24)
    assert (len(frames), len({frame.name for frame in frames})) == (24, 24)
    assert {sum(frame.group == group for frame in frames) for group in {f.group for f in frames}} == {4}
