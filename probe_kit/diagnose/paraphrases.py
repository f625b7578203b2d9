"""Other words of one meaning, from a table of the user's."""

from pathlib import Path

from probe_kit.errors import UsageError


def read_paraphrases(file: Path) -> dict[str, str]:
    """By instruction, its other words. Raises UsageError for a file without the columns, or with a blank cell."""
    import pandas as pd

    try:
        table = pd.read_csv(file, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read as CSV ({error}); give columns instruction, other") from error
    if missing := [name for name in ("instruction", "other") if name not in table.columns]:
        raise UsageError(f"{file} has no column {missing[0]}; expected columns instruction and other")
    for line, (instruction, other) in enumerate(zip(table["instruction"], table["other"], strict=True), 2):
        if not instruction.strip() or not other.strip() or instruction == other:
            raise UsageError(f"{file} line {line}: expected two different texts, found {instruction!r}, {other!r}")
    return dict(zip(table["instruction"], table["other"], strict=True))
