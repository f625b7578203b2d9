"""Foreign text in Markdown is read by a parser of Markdown as the text that it is."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from probe_kit._system.markdown_text import markdown_safe

PARSER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
HOSTILE = [
    "<img src=x onerror=alert(1)>", "<!-- gone -->", "<https://evil.example>", "<script>alert(1)</script>",
    "[text](https://evil.example)", "![picture](https://evil.example/x.png)", "[text][1]", "[1]: https://evil.example",
    "**bold**", "_emphasis_", "__strong__", "*a*", "~~gone~~", "# heading", "> quotation", "- entry", "+ entry",
    "1. entry", "12) entry", "a | b", "&lt;script&gt;", "&#60;b&#62;", "\\<b>", "\\\\<b>", "a\\", "```", "~~~",
    "a\nb", "a\n\n# heading", "===", "---x", "$x$", "a_b", "snake_case_name", "[0.41, 0.63]", "p < 0.05",
    "−0.3 ± 0.1", "0.65*", "a > b", "r'(x)'",
]  # fmt: skip


def shown(markdown: str) -> str:
    """The text that a reader sees, if the parser makes nothing but one paragraph of text; else its HTML."""
    tokens = PARSER.parse(markdown)
    if [token.type for token in tokens] != ["paragraph_open", "inline", "paragraph_close"]:
        return PARSER.render(markdown)
    children = tokens[1].children or []
    if {child.type for child in children} - {"text", "text_special", "code_inline", "softbreak"}:
        return PARSER.render(markdown)
    return "".join(f"`{one.content}`" if one.type == "code_inline" else one.content for one in children)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_is_shown_as_it_is(text: str) -> None:
    assert shown(markdown_safe(text)) == re.sub(r"\s*\n+\s*", " ", text)


@pytest.mark.parametrize(
    "text", ["snake_case_name", "suite@1#0123", "[0.41, 0.63]", "p < 0.05", "−0.3 ± 0.1", "0.65 (n = 3)"]
)
def test_names_and_numbers_are_written_without_escapes(text: str) -> None:
    assert markdown_safe(text) == text


@settings(max_examples=200, deadline=None)
@given(st.text("abX1 _*~<>[]()!#|\\&;:/.@-+=$'\"", min_size=1, max_size=24).map(str.strip).filter(bool))
def test_no_text_becomes_markup_and_none_ends_a_cell(text: str) -> None:
    assert shown(markdown_safe(text)) == text
    page = PARSER.render(f"| heading |\n| --- |\n| {markdown_safe(text)} |\n")
    assert page.count("<td>") == 1
    assert not re.search(r"<(?!/?(table|thead|tbody|tr|th|td)>)", page)


@pytest.mark.parametrize("text", ["https://evil.example/x", "http://x", "www.evil.example", "me@evil.example"])
def test_no_address_becomes_a_link_by_itself(text: str) -> None:
    """GitHub and the hub make links of `scheme://`, `www.` and `name@` that stand in the source."""
    assert not re.search(r"://|www\.|\w@\w", markdown_safe(text))
    assert shown(markdown_safe(text)) == text
