"""Pairs of inferences, one patched into and one patched from; also those of a table of the user's own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.table_cells import is_count
from probe_kit._system.text_tables import open_table
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.items import Side

if TYPE_CHECKING:
    from probe_kit.hooks import Prompt


Given = Union[Observation, "Prompt"]
"""An observation of a policy, or a question to a model that answers."""
Chunk = NDArray[np.float32]


@dataclass(frozen=True)
class Pair:
    """Two inferences with the same seed.

    Attributes:
        clean: Input of the inference that is patched into.
        source: Input of the inference that activations are patched from; it must have as many tokens.
        seed: Seed of both inferences.
        toward: +1 or −1, the direction in which the source should move the number that is measured, such as +1 for
            a displacement to the left.
        group: Name of the unit that is resampled and flipped, such as an item with its counterpart; empty for a
            pair that is independent of all others.
        item: Name of the unit whose pairs are averaged before groups are; empty for one pair alone.
        row: Row of the episode in the run.
        episode: Id of the episode.
        category: Category of the episode.
        side: Side of the correct picture; None without sides.
        donor: In runs without sides, another frame: `source` is `clean` with one input of it. None in the scene.
        donor_name: Name of that frame.
        control: The clean input after a meaningless change of the varied input; None in the scene.
        tiles: (H, W) mask of each tile in the clean picture, by side.
        stored: (n, D) actions of the clean inference in the run; None where it has none.
        step: Number of the inference in the episode, or of the recorded frame.
    """

    clean: Given
    source: Given
    seed: int = 0
    toward: int = 1
    group: str = ""
    item: str = ""
    row: int = -1
    episode: str = ""
    category: str = ""
    side: Side | None = None
    donor: Given | None = None
    donor_name: str = ""
    control: Given | None = None
    tiles: Mapping[Side, NDArray[np.bool_]] = field(default=MappingProxyType({}), repr=False)
    stored: Chunk | None = field(default=None, repr=False)
    step: int = 0


def groups_and_items(pairs: Sequence[Pair]) -> tuple[list[str], list[str]]:
    """Return the group and the item of every pair; a pair without one is alone in its own."""
    groups = [pair.group or f"pair {at}" for at, pair in enumerate(pairs)]
    return groups, [pair.item or f"{groups[at]}, pair {at}" for at, pair in enumerate(pairs)]


# -- tables of the user's own --------------------------------------------------------------------------------

PairRow = tuple[str, int, str, int]
"""Episode and frame of the clean inference, and of its donor."""
PAIR_COLUMNS = ("episode", "frame", "donor_episode", "donor_frame")


def read_pairs(path: Path) -> tuple[PairRow, ...]:
    """Return the rows of a table with the columns episode, frame, donor_episode, donor_frame.

    Names of episodes are texts as they are written. A recorded episode may be called by its number; only
    the run can tell that from a name such as `007`.

    Raises:
        UsageError: For a table without one of the columns, without a row, or with a frame that is no number.
    """
    table = open_table(path, PAIR_COLUMNS)
    if missing := [name for name in PAIR_COLUMNS if name not in table.names]:
        raise UsageError(f"{path} has no column {missing[0]!r}; expected {', '.join(PAIR_COLUMNS)}")
    rows = []
    for line, cells in table.rows(PAIR_COLUMNS):
        for column in PAIR_COLUMNS[1::2]:
            if not ((text := cells[column] or "").isascii() and is_count(text)):
                raise UsageError(
                    f"{table.where(line, column)} is {text!r}; expected the number of a frame, from 0"
                )
        clean, frame, donor, donor_frame = (cells[name] or "" for name in PAIR_COLUMNS)
        rows.append((clean, int(frame), donor, int(donor_frame)))
    if not rows:
        raise UsageError(f"{path} names no pair; expected a line per pair")
    return tuple(rows)
