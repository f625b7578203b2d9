"""The commands that the README and the pages of `docs/` show, read out of their fenced blocks and their text."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "notes").glob("*.md")),
]
SHELLS = ("bash", "console", "sh")
NOT_COMMANDS = {
    ("docs/architecture.md", "suite ──► env"): "a diagram",
    ("docs/architecture.md", "extract ──► RUN"): "a diagram",
    ("docs/diagnose.md", "Inputs of pi0-tiny"): "output of diagnose",
    ("docs/storage.md", "RUN/"): "a tree of files",
    (
        "docs/suite.md",
        "instruction,correct,wrong",
    ): "a table, written to questions.csv before the page's commands run",
}
"""Blocks without a language that hold no commands, by their page and how they begin, and what they are."""


@dataclass(frozen=True)
class Command:
    """One line to type. text: without prompt and remark."""

    page: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line} {self.text}"

    @property
    def words(self) -> list[str]:
        """The line as a shell splits it, from the program on."""
        words = shlex.split(self.text)
        if words[0] != "./with-uv":
            return words
        return words[3:] if words[1] == "--extra" else words[1:]

    @property
    def ours(self) -> bool:
        """Whether it is a command of probe-kit's."""
        return self.words[0] == "probe-kit"


@dataclass(frozen=True)
class Block:
    """A fenced block. line: of its first line of content."""

    page: str
    line: int
    language: str
    lines: tuple[str, ...]

    @property
    def listed(self) -> tuple[str, str] | None:
        """Its place in `NOT_COMMANDS`, None if it has none."""
        begins = (key for key in NOT_COMMANDS if key[0] == self.page and self.lines[0].startswith(key[1]))
        return next(begins, None)

    @property
    def is_shell(self) -> bool:
        """Whether its lines are commands: what has no language is, unless it is listed as something else."""
        return self.language in SHELLS or (self.language == "" and self.listed is None)

    def commands(self) -> Iterator[Command]:
        """Its lines without prompts, remarks and empty ones."""
        for number, line in enumerate(self.lines, self.line):
            text = _without_remark(line.removeprefix("$ "))
            if text:
                yield Command(self.page, number, text)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """Every fenced block of a page."""
    listed, opened, lines = [], None, []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = re.fullmatch(r" *```(\w*)", line)
        if fence and opened is None:
            opened, lines = (number + 1, fence[1]), []
        elif fence and opened is not None:
            listed.append(Block(name_of(page), *opened, tuple(lines)))
            opened = None
        elif opened is not None:
            lines.append(line)
    assert opened is None, f"{page}: a block is not closed"
    return listed


def commands(page: Path) -> list[Command]:
    """Every line of the page's shell blocks, in order."""
    return [command for block in blocks(page) if block.is_shell for command in block.commands()]


def mentioned(page: Path) -> list[Command]:
    """What the page's text shows between backticks, outside of blocks."""
    text = page.read_text(encoding="utf-8")
    outside = re.sub(r"(?ms)^ *```.*?^ *```$", lambda block: "\n" * block[0].count("\n"), text)
    return [
        Command(name_of(page), outside.count("\n", 0, match.start()) + 1, " ".join(match[1].split()))
        for match in re.finditer(r"(?<!`)`([^`]+)`(?!`)", outside)
    ]


def _without_remark(line: str) -> str:
    return re.sub(r"(^|\s+)#.*$", "", line).strip()
