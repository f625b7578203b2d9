"""Words that a cut prompt keeps from a network, found from the ids alone, with a tokenizer that really cuts."""

import warnings

import pytest
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace

from probe_kit.errors import InstructionError
from probe_kit.extract.rollout.controllers import count_lost_words

WORDS = ["put", "the", "cube", "on", "the", "black", "shape"]
TEMPLATE = "what to do : {} ?"


def tokenizer(most: int | None) -> Tokenizer:
    """Of whole words; most: tokens that it keeps."""
    vocabulary = dict.fromkeys([*TEMPLATE.format(" ".join(WORDS)).split(), "[UNK]"])
    found = Tokenizer(WordLevel({word: place for place, word in enumerate(vocabulary)}, unk_token="[UNK]"))
    found.pre_tokenizer = Whitespace()
    if most is not None:
        found.enable_truncation(most)
    return found


@pytest.mark.parametrize("framed", [False, True], ids=["bare", "in a frame"])
@pytest.mark.parametrize("lost", range(len(WORDS) - 1))
def test_the_words_behind_a_cut_are_counted(lost: int, framed: bool) -> None:
    before = TEMPLATE.split("{")[0].split() if framed else []
    cut = tokenizer(len(before) + len(WORDS) - lost)

    def pack(text: str) -> list[int]:
        return list(cut.encode(TEMPLATE.format(text) if framed else text).ids)

    if not lost:
        assert count_lost_words(pack, " ".join(WORDS)) == 0
        return
    with pytest.warns(UserWarning, match="the last words of an instruction do not reach its network"):
        assert count_lost_words(pack, " ".join(WORDS)) == lost


def test_what_is_whole_or_unknown_has_lost_nothing() -> None:
    whole = tokenizer(None)
    asked = []

    def refuse(text: str) -> list[int]:
        asked.append(text)
        if len(asked) > 1:
            raise InstructionError("too short")
        return [1]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert count_lost_words(lambda text: list(whole.encode(text).ids), " ".join(WORDS)) == 0
        assert count_lost_words(lambda _text: None, " ".join(WORDS)) == 0
        assert count_lost_words(lambda _text: [1], "put") == 0
        assert count_lost_words(refuse, " ".join(WORDS)) == 0
    assert len(asked) == 2
