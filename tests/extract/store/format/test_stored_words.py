"""Old words of stored records are translated, at any depth, and everything else stays."""

import pytest

from probe_kit.extract.store.format import stored_words
from probe_kit.extract.store.format.stored_words import Words, in_current_words

OLD = {
    "kind": "follow",
    "conditions": ["plain", "exchanged"],
    "reader": {"note": "plain", "conditions": "plain"},
    "count": 3,
}


@pytest.fixture(autouse=True)
def renamed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if three words of interventions had been renamed."""
    words = Words({"reader": "answer_model"}, {"conditions": {"plain": "clean"}, "kind": {"follow": "image_swap"}})
    monkeypatch.setitem(stored_words.STORED_WORDS, "intervention", words)


def test_names_and_values_are_translated_where_they_stand_and_nowhere_else() -> None:
    now = in_current_words(OLD, "intervention")
    assert now == {
        "kind": "image_swap",
        "conditions": ["clean", "exchanged"],
        "answer_model": {"note": "plain", "conditions": "clean"},
        "count": 3,
    }
    assert in_current_words(now, "intervention") == now


def test_another_kind_of_record_keeps_its_words_and_the_record_itself_is_not_changed() -> None:
    before = repr(OLD)
    assert in_current_words(OLD, "probes") == OLD
    in_current_words(OLD, "intervention")
    assert repr(OLD) == before


def test_a_single_word_is_translated_as_in_a_record() -> None:
    assert in_current_words({"conditions": "plain"}, "intervention") == {"conditions": "clean"}
    assert in_current_words({"conditions": "exchanged"}, "intervention") == {"conditions": "exchanged"}
    assert in_current_words({"conditions": "plain"}, "outcome") == {"conditions": "plain"}
