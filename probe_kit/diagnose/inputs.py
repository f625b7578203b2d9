"""The inputs of a frame (words, pictures, state), and the frames of a run between which they are exchanged."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit._system.text_tables import open_table
from probe_kit.diagnose.results import LEAST_GROUPS, count_groups
from probe_kit.errors import UsageError
from probe_kit.extract.sources.inputs import (
    INSTRUCTION,
    PICTURE,
    STATE,
    Frame,
    hardly_changed,
    with_other_stop,
)
from probe_kit.hooks.contract.card import shown_cameras
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.frame_session import FrameSession

if TYPE_CHECKING:
    from probe_kit.intervene.pairs import PairRow
    from probe_kit.intervene.sessions import ReplaySession
    from probe_kit.runs import Run


def inputs_of(frames: Sequence[Frame], camera: str = "") -> tuple[str, ...]:
    """Return the inputs that every frame holds: words, pictures and state.

    Args:
        frames: Frames of one source; the first names the further cameras.
        camera: The name of the first camera, needed where there are several.

    Raises:
        UsageError: Without frames.
    """
    if not frames:
        raise UsageError("the source has no frame; diagnose needs at least two that differ")
    return names_of([camera or "first", *frames[0].observation.cameras])


def cameras_of(run: "Run") -> tuple[str, ...]:
    """Return the cameras of a run's model that got a picture."""
    policy = run.certificate["policy"]
    return shown_cameras(policy["cameras"], policy["needs"])


def names_of(cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the inputs of a model that is shown these cameras."""
    pictures = [f"{PICTURE}.{name}" for name in cameras] if len(cameras) > 1 else [PICTURE]
    return (INSTRUCTION, *pictures, STATE)


def controls_of(frame: Frame, name: str, spread: NDArray[np.float64]) -> list[Observation]:
    """Return the frame's observation after changes of one input that mean nothing, the best first.

    See `hardly_changed`. Without other words of the frame, the first letter's case and the full stop change, or
    one of them. A tokenizer of words may know only one spelling.

    Args:
        frame: Its other words are the only control of its instruction, if it has some.
        name: The input that changes, such as `instruction`.
        spread: (D,) standard deviations of the state.
    """
    clean = frame.observation
    if name != INSTRUCTION:
        return [hardly_changed(clean, name, spread)]
    texts = [frame.other_words] if frame.other_words else _retype(clean.instruction)
    return [replace(clean, instruction=text) for text in texts]


def spread_of_states(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Return the standard deviation of every number of the state over frames."""
    states = np.stack([frame.observation.state for frame in frames]).astype(np.float64)
    return np.asarray(states.std(axis=0), np.float64)


def _retype(words: str) -> list[str]:
    """Return the words with the full stop and the first letter's case both changed, then with one of them."""
    stopped = with_other_stop(words)
    return [text[:1].swapcase() + text[1:] for text in (stopped, words)] + [stopped]


# -- words of the same meaning -------------------------------------------------------------------------------

COLUMNS = ("instruction", "other")


def read_paraphrases(file: Path) -> dict[str, str]:
    """Return the other words of every instruction in a table.

    Args:
        file: A table with the columns `instruction` and `other`.

    Raises:
        UsageError: For a file without the columns, a blank cell, and an instruction with two other texts.
    """
    table = open_table(file, COLUMNS)
    if missing := [name for name in COLUMNS if name not in table.names]:
        raise UsageError(f"{file} has no column {missing[0]}; expected columns instruction and other")
    words: dict[str, str] = {}
    for line, cells in table.rows(COLUMNS):
        instruction, other = (cells[name] or "" for name in COLUMNS)
        where = table.where(line)
        if not instruction or not other or instruction == other:
            raise UsageError(f"{where}: expected two different texts, found {instruction!r}, {other!r}")
        if words.setdefault(instruction, other) != other:
            raise UsageError(
                f"{where} has {other!r} for {instruction!r}, and a line above has {words[instruction]!r}; "
                "expected one. Leave one out"
            )
    return words


# -- the frames of a run -------------------------------------------------------------------------------------

GOLDEN = (5**0.5 - 1) / 2
"""The golden ratio: its multiples, without their whole part, cover 0 to 1 evenly for any number of them.

Thus episodes are looked at in different phases.
"""


def frames_of(
    session: "ReplaySession", count: int, paraphrases: Mapping[str, str] = MappingProxyType({})
) -> list[Frame]:
    """Return up to `count` frames of a run's episodes; all where it has fewer.

    Of the scene they are two first frames of each group; of other sources, frames of as many groups as possible.

    Args:
        session: The run's policy and its observations.
        count: Largest number of frames.
        paraphrases: Other words of the same meaning, by instruction.

    Raises:
        UsageError: For a run with too few groups.
    """
    listed = (
        _observed_frames(session, count) if isinstance(session, FrameSession) else _draw_frames(session, count)
    )
    frames = [_read(frame, paraphrases) for frame in listed]
    _check_groups(frames, lambda: f"{session.run.location} has", REMEDY)
    return frames


def tabled_frames(
    session: "ReplaySession", table: Sequence["PairRow"], paraphrases: Mapping[str, str] = MappingProxyType({})
) -> tuple[list[Frame], list[tuple[int, int]]]:
    """Return the frames that a table of pairs names, each once, and its rows as (frame, donor) among them.

    Args:
        session: The run's policy and its observations.
        table: Rows of frames that the run has, which `open_session` checks. Of the scene they are first frames.
        paraphrases: Other words of the same meaning, by instruction.

    Raises:
        UsageError: For clean frames of too few groups.
    """
    if isinstance(session, FrameSession):
        by_name = session.frames.by_name
    else:
        names = {name for row in table for name in (row[0], row[2])}
        rows = np.flatnonzero(session.run.episodes["episode_id"].isin(names))
        by_name = {(frame.name, 0): frame for frame in _first_frames(session, rows)}
    pairs = [(by_name[row[:2]], by_name[row[2:]]) for row in table]
    # One frame may be named by its episode and by its item.
    frames = list({frame.name: frame for pair in pairs for frame in pair}.values())
    at = {frame.name: number for number, frame in enumerate(frames)}
    _check_groups([clean for clean, _ in pairs], lambda: "the table of pairs has", "Add pairs of other groups")
    numbered = dict.fromkeys((at[clean.name], at[donor.name]) for clean, donor in pairs)
    return [_read(frame, paraphrases) for frame in frames], sorted(numbered)


REMEDY = "Extract more episodes or items"
"""The remedy for too few groups of a run."""


def check_groups(
    episodes: pd.DataFrame, count: int, in_scene: bool, subject: Callable[[], str], remedy: str = REMEDY
) -> None:
    """Raise UsageError if the frames that would be drawn from some episodes are of too few groups.

    Args:
        episodes: The episodes of a run, or the rows of a planned one.
        count: Largest number of frames.
        in_scene: Whether first frames of the scene are drawn, see `frames_of`.
        subject: A function that returns what has these episodes, with its verb.
        remedy: What to do about it.
    """
    if in_scene:
        drawn = episodes.loc[order_of_first_frames(episodes, count_groups(count))[:count], "group_id"]
        groups = drawn.nunique()
    else:
        groups = min(count, episodes["group_id"].nunique())
    _check_number(groups, subject, remedy)


def _check_number(groups: int, subject: Callable[[], str], remedy: str) -> None:
    if groups < LEAST_GROUPS:
        has = f"{subject()} frames of {plural(groups, 'group')}"
        raise UsageError(f"{has}; a diagnosis needs at least {LEAST_GROUPS}. {remedy}")


def _check_groups(frames: Sequence[Frame], subject: Callable[[], str], remedy: str) -> None:
    _check_number(len({frame.group for frame in frames}), subject, remedy)


def _read(frame: Frame, paraphrases: Mapping[str, str]) -> Frame:
    """Return the frame with its observation in memory: every input of it is compared and exchanged many times."""
    observation = frame.observation
    other_words = paraphrases.get(observation.instruction, "")
    return replace(frame, observe=lambda _: observation, other_words=other_words)


def _observed_frames(session: FrameSession, count: int) -> Iterator[Frame]:
    """Yield frames of recordings or of an environment, see `spread_over_groups`."""
    index = session.frames.index
    yield from (index[at] for at in spread_over_groups([frame.group for frame in index], count))


def spread_over_groups(groups_of_frames: Sequence[str], count: int) -> list[int]:
    """Return the positions of up to `count` frames, spread over groups and episodes.

    One frame of every group comes in turn. Frames that are drawn from those alone that were drawn before are the
    same, in the same order.

    Args:
        groups_of_frames: The group of every frame.
        count: Largest number of frames.
    """
    by_group: dict[str, list[int]] = {}
    for at, group in enumerate(groups_of_frames):
        by_group.setdefault(group, []).append(at)
    groups = list(by_group.values())
    # Data sets are often sorted by task: the first episodes alone would hold one instruction.
    drawn = np.linspace(0, len(groups) - 1, min(count, len(groups))).round().astype(int)
    turns = -(-count // len(drawn))
    spread = [_spread(groups[group], turns, number * GOLDEN % 1) for number, group in enumerate(drawn)]
    in_turn = [frame for turn in zip_longest(*spread) for frame in turn if frame is not None]
    return in_turn[:count]


def _spread(frames: list[int], turns: int, phase: float) -> list[int]:
    """Return up to `turns` frames of a group at equal distances.

    Args:
        frames: All frames of the group.
        turns: Largest number of frames.
        phase: Position of the first one in distances, from 0 up to 1.
    """
    turns = min(turns, len(frames))
    return [frames[int(len(frames) * (turn + phase) / turns)] for turn in range(turns)]


def _draw_frames(session: "ReplaySession", count: int) -> Iterator[Frame]:
    """Yield first frames of the scene: of every group one of each item, in the same layout; see `count_groups`."""
    episodes = session.run.episodes
    ordered = order_of_first_frames(episodes, count_groups(count))[:count]
    yield from _first_frames(session, episodes.index.get_indexer(ordered).tolist())


def _first_frames(session: "ReplaySession", rows: Iterable[int]) -> Iterator[Frame]:
    """Yield the first frames of some of the scene's episodes.

    Args:
        session: The run's policy and its observations.
        rows: Positions of the episodes in the run's table.
    """
    episodes = session.run.episodes
    for row in rows:
        for pair in session.pairs(str(episodes["item_id"].iloc[row])):
            if pair.row == row:
                assert isinstance(pair.clean, Observation), "runs of policies hold observations"
                yield Frame.of(pair.episode, pair.clean, pair.group or pair.episode, pair.seed)


def order_of_first_frames(episodes: pd.DataFrame, groups: int) -> pd.Index:
    """Return the rows of the scene's episodes in the order in which their first frames are taken.

    Args:
        episodes: The run's table of episodes.
        groups: Number of groups that come first, with two frames each; then come further groups, then further
            frames.
    """
    by_item = episodes.groupby("item_id", sort=False)
    order = pd.DataFrame({"group": pd.factorize(episodes["group_id"])[0], "layout": by_item.cumcount()})
    order["item"] = order.assign(item=by_item.ngroup()).groupby("group")["item"].rank("dense").astype(int) - 1
    of_group = order.groupby("group")
    items, layouts = (of_group[name].transform("max") + 1 for name in ("item", "layout"))
    # Another item and another layout begin in every group: else all would ask for the same side of one layout.
    order["item"] = (order["item"] + order["group"]) % items
    order["layout"] = (order["layout"] + order["group"] // items) % layouts
    order = order.sort_values(["group", "layout", "item"], kind="stable")
    turn = order.groupby("group").cumcount()
    order = order.assign(turn=turn, couple=turn // 2, block=order["group"] // groups)
    return order.sort_values(["couple", "block", "turn", "group"], kind="stable").index
