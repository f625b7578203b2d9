"""Foreign text in Markdown: names and notes are shown as they are, and never as markup, links or HTML."""

import re

_MARKUP = re.compile(
    r"""
    [\\*|$]                        # escapes, emphasis, cells, mathematics
    | (?<![^\W_])_ | _(?![^\W_])   # emphasis; not inside a word, where it means nothing
    | ~(?=~) | (?<=~)~             # struck out
    | <(?=[A-Za-z/!?])             # HTML and links in angle brackets
    | &(?=\#?\w+;)                 # entities
    | \](?=[(\[:])                 # links, pictures and their definitions
    | ^\s*(?:\#|>|[-+](?=[-\s]|$)|=+\s*$|```|~~~)   # headings, quotations, lists, rules, code
    | ^\s*\d{1,9}[.)](?=\s|$)      # numbered lists
    | (?<=:)/(?=/)                 # addresses, which become links by themselves
    | (?<=www)\.
    | (?<=\w)@(?=[\w.-]*\.[a-z])
    """,
    re.VERBOSE | re.IGNORECASE,
)


def markdown_safe(text: str) -> str:
    """Return one line of Markdown that shows `text`; line ends become spaces."""
    return _MARKUP.sub(_escaped, re.sub(r"\s*[\r\n\u2028\u2029]+\s*", " ", text))


def _escaped(found: re.Match[str]) -> str:
    sign = found[0].lstrip()
    if sign[0].isdigit():
        return f"{found[0][:-1]}\\{sign[-1]}"
    return found[0][: len(found[0]) - len(sign)] + f"\\{sign}"
