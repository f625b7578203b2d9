"""What a terminal would obey, made visible."""

import pytest

from probe_kit._terminal.plain_text import terminal_safe


@pytest.mark.parametrize(
    ("hostile", "harmless"),
    [
        ("\x1b[31mred\x1b[0m", "␛[31mred␛[0m"),
        ("\x1b]0;title\x07", "␛]0;title␇"),
        ("\x9b31m", "\ufffd31m"),
        ("over\rwritten", "over␍written"),
        ("gone\x08\x7f", "gone␈␡"),
        ("user\u202egnp.exe", "user\ufffdgnp.exe"),
        ("\u2066isolate\u2069", "\ufffdisolate\ufffd"),
        ("half \ud800", "half \ufffd"),
        ("line\u2028line", "line\ufffdline"),
    ],
)
def test_nothing_is_left_that_a_terminal_obeys(hostile: str, harmless: str) -> None:
    assert terminal_safe(hostile) == harmless


@pytest.mark.parametrize("text", ["plain", "Δ, π and ×", "two\nlines\tand a tab", "日本語", "[bold]brackets[/]"])
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert terminal_safe(text) == text
