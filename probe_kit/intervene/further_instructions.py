"""Further instructions: the words of other tasks, for data sets whose frames hold one instruction."""

from collections.abc import Iterable, Sequence
from hashlib import sha256
from pathlib import Path

from probe_kit._system.text_tables import SEPARATORS, open_table, read_lines
from probe_kit.errors import UsageError
from probe_kit.extract.sources.inputs import INSTRUCTION, normal_form

TABLES = (".csv", ".tsv")
"""Endings of files that are tables, of which one column is read."""
MOST = 1000
"""The most further instructions: a frame gets a few of them."""


def read_instructions(path: Path) -> tuple[str, ...]:
    """Return the instructions of a file: one per line, or the column `instruction` of a table.

    A file is a table by its ending, `.csv` or `.tsv`, or by the column in its first line. Lines at the end without
    text are left out.

    Raises:
        UsageError: For a file without instructions or with too many, an empty line, and a text that is there
            twice; texts that differ in case, spaces, punctuation or Unicode form alone are one text.
    """
    is_table = path.suffix.lower() in TABLES
    lines = [] if is_table else read_lines(path)
    is_table |= bool(lines) and any(INSTRUCTION in lines[0].split(sign) for sign in SEPARATORS)
    numbered = list(_pairs_of_table(path) if is_table else _pairs_of_lines(path, lines))
    texts: dict[str, tuple[str, str]] = {}
    for where, text in numbered:
        if not normal_form(text):
            raise UsageError(f"{where} is {text!r}, which names no task; expected an instruction. Remove the line")
        if normal_form(text) in texts:
            before, other = texts[normal_form(text)]
            raise UsageError(
                f"{where} is {text!r}, and {before} is {other!r}; they are one instruction. Remove one of them"
            )
        texts[normal_form(text)] = where, text
    if not 0 < len(numbered) <= MOST:
        raise UsageError(
            f"{path} has {len(numbered)} instructions; expected 1 to {MOST}, one per line, or a table with a "
            f"column {INSTRUCTION}"
        )
    return tuple(text for _, text in numbered)


def _pairs_of_lines(path: Path, lines: list[str]) -> Iterable[tuple[str, str]]:
    while lines and not lines[-1]:
        lines.pop()
    return [(f"{path}, line {number}", line) for number, line in enumerate(lines, start=1)]


def _pairs_of_table(path: Path) -> Iterable[tuple[str, str]]:
    table = open_table(path, (INSTRUCTION,))
    if INSTRUCTION not in table.names:
        raise UsageError(
            f"{path} has the columns {', '.join(table.names) or 'of no heading'}; expected a column {INSTRUCTION}"
        )
    return [(table.where(line), cells[INSTRUCTION] or "") for line, cells in table.rows((INSTRUCTION,))]


def check_further_instructions(
    task_words: Sequence[str], instructions: Iterable[str], has_pairs: bool = False
) -> None:
    """Raise UsageError for a further instruction that frames hold already, but for spelling.

    Args:
        task_words: The words of other tasks.
        instructions: The instructions of the frames.
        has_pairs: Whether a table of pairs names the donors, whose words these would be.
    """
    if has_pairs:
        raise UsageError("--instructions gives words of donors, and --pairs names donors; leave one of both out")
    held = {normal_form(text): text for text in instructions}
    for text in task_words:
        if (same := held.get(normal_form(text))) is not None:
            raise UsageError(
                f"--instructions has {text!r}, which is the task {same!r} of these frames; expected the words of "
                "other tasks. Remove it"
            )


def hash_of_instructions(task_words: Sequence[str]) -> str:
    """Return the first 12 hex digits of the sha256 of instructions, as results name them."""
    return sha256("\n".join(task_words).encode()).hexdigest()[:12]
