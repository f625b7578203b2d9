"""Numbers of things in words."""

import pytest

from probe_kit._system.counting import counted


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (1, "table", "1 table"),
        (0, "run", "0 runs"),
        (1, "category", "1 category"),
        (2, "category", "2 categories"),
        (3, "key", "3 keys"),
        (2, "GPU", "2 GPUs"),
        (3440, "independent group", "3,440 independent groups"),
    ],
)
def test_a_noun_is_in_the_plural_unless_there_is_one(number: int, noun: str, text: str) -> None:
    assert counted(number, noun) == text
