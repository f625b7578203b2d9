"""Tables of pairs of the user's own."""

from pathlib import Path

from probe_kit._system.text_tables import open_table
from probe_kit.errors import UsageError
from probe_kit.intervene.settings import PairRow

PAIR_COLUMNS = ("episode", "frame", "donor_episode", "donor_frame")


def read_pairs(path: Path) -> tuple[PairRow, ...]:
    """Return the rows of a table with the columns episode, frame, donor_episode, donor_frame.

    Raises UsageError.
    """
    table = open_table(path, PAIR_COLUMNS)
    if missing := [name for name in PAIR_COLUMNS if name not in table.names]:
        raise UsageError(f"{path} has no column {missing[0]!r}; expected {', '.join(PAIR_COLUMNS)}")
    rows = []
    for line, cells in table.rows(PAIR_COLUMNS):
        texts = [cells[name] or "" for name in PAIR_COLUMNS]
        for column, text in zip(PAIR_COLUMNS[1::2], texts[1::2], strict=True):
            if not text.isdecimal():
                raise UsageError(
                    f"{table.where(line, column)} is {text!r}; expected the number of a frame, from 0"
                )
        rows.append((_episode(texts[0]), int(texts[1]), _episode(texts[2]), int(texts[3])))
    if not rows:
        raise UsageError(f"{path} names no pair; expected a line per pair")
    return tuple(rows)


def _episode(text: str) -> str:
    """Return the id of a recorded episode that is named by its number."""
    return f"episode-{int(text):06d}" if text.isdecimal() else text
