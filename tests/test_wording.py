"""Help texts, messages, docstrings, comments, pages and notebooks are plain technical English."""

import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.support.prose import (
    Prose,
    prose_of_module,
    prose_of_notebook,
    prose_of_page,
    remarks_of_module,
    sentences,
    without_code,
)

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "probe_kit"

AVOIDED = {
    "a person who does not exist": r"somebody|someone|anybody|nobody|everybody|whoever",
    "code as a person": r"hear(s|d|ing)?|listen(s|ed|ing)?|told|tells of|thinks?|speaks?|looks? after|lends?|lent",
    "a riddle": r"what acts|by lot|all the same|as ever|held against|taken over|takes? over|laid over|to be had",
    "an old word": r"mend(s|ed|ing)?|foretells?|foretold|foremost|weighed|carried out|says? nothing",
    "a private term": r"defects?|reads? back|continues behind|goes? on|go on|stands? beside",
}
"""Words that the project does not use, by what is wrong with them; CONTRIBUTING.md says what to write instead."""
PATTERN = re.compile(rf"\b({'|'.join(AVOIDED.values())})\b(?!:)", re.IGNORECASE)
"""A word with a colon behind it is the name of a field."""
NAMES = re.compile(r"VL-Think|--no-act\b", re.IGNORECASE)
MOST_WORDS = 25

MODULES = {path.name.removesuffix(".py") for path in PACKAGE.iterdir() if path.name != "__pycache__"}
PARTS = [*sorted(MODULES), "docs"]


@cache
def prose_of(part: str) -> tuple[Prose, ...]:
    """All texts of a package, of a module of the root, or of README, docs and notebooks."""
    return tuple(_prose_of(part))


def _prose_of(part: str) -> Iterator[Prose]:
    if part == "docs":
        for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
            yield from prose_of_page(path, path.relative_to(ROOT).as_posix())
        for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
            yield from prose_of_notebook(path, path.relative_to(ROOT).as_posix())
        return
    file = PACKAGE / f"{part}.py"
    for path in [file] if file.exists() else sorted((PACKAGE / part).rglob("*.py")):
        yield from prose_of_module(path, path.relative_to(ROOT).as_posix())


def avoided_words(texts: Iterable[Prose]) -> list[str]:
    return [
        f"{prose.location}: “{match[0]}” in “{sentence}”"
        for prose in texts
        for sentence in sentences(without_code(NAMES.sub("code", prose.text)))
        if (match := PATTERN.search(sentence))
    ]


@pytest.mark.parametrize("part", PARTS)
def test_no_text_uses_a_word_that_the_project_avoids(part: str) -> None:
    violations = avoided_words(prose_of(part))
    assert not violations, "\n".join(violations)


def test_pages_help_texts_and_first_lines_of_modules_have_short_sentences() -> None:
    long = [
        f"{prose.location}: {words} words in “{sentence}”"
        for part in PARTS
        for prose in prose_of(part)
        if prose.kind in ("summary", "help", "page")
        for sentence in sentences(without_code(prose.text))
        if (words := len(re.findall(r"\w[\w'’-]*", sentence))) > MOST_WORDS
    ]
    assert not long, "\n".join(long)


def test_no_other_page_of_the_repository_uses_a_word_that_the_project_avoids() -> None:
    names = [*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))]
    assert {"SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md"} <= {page.name for page in names}
    violations = avoided_words(
        prose for page in names for prose in prose_of_page(page, page.relative_to(ROOT).as_posix())
    )
    assert not violations, "\n".join(violations)


FOLDERS = ("benchmarks", "scripts", "tests", "probe_kit")


def test_no_comment_and_no_docstring_uses_a_word_that_the_project_avoids() -> None:
    paths = {path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    # Only a module that has such a word anywhere, also in code, is taken apart: that takes most of the time.
    suspects = [
        path for path in sorted(paths) if PATTERN.search(" ".join(path.read_text(encoding="utf-8").split()))
    ]
    assert suspects, "this file lists the words"
    violations = avoided_words(
        remark for path in suspects for remark in remarks_of_module(path, path.relative_to(ROOT).as_posix())
    )
    assert not violations, "\n".join(violations)


@pytest.mark.parametrize(
    ("text", "is_avoided"),
    [
        ("The image that nobody saw.", True),
        ("It was told\nwhich side.", True),
        ("How much attention what acts pays.", True),
        ("Boards of VL-Think.", False),
        ("`AnswerModel.speak` returns text.", False),
        ("A recommended length.", False),
    ],
)
def test_a_word_is_found_across_lines_and_not_inside_code_or_other_words(text: str, is_avoided: bool) -> None:
    assert bool(PATTERN.search(without_code(NAMES.sub("code", " ".join(text.split()))))) == is_avoided
