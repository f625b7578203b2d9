"""Other words of one meaning, from a table of the user's."""

from pathlib import Path

from probe_kit._system.text_tables import open_table
from probe_kit.errors import UsageError

COLUMNS = ("instruction", "other")


def read_paraphrases(file: Path) -> dict[str, str]:
    """Return, by instruction, its other words.

    Raises UsageError for a file without the columns, a blank cell, and an instruction with two other texts.
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
