"""The word-level tokenizer of the embedded VLM: the grammar of the embedded suite and of questions."""

import json
import re
from collections.abc import Collection
from pathlib import Path

from probe_kit.suite.generators import vocabulary

SPECIAL = ("<pad>", "<eos>", "<bos>", "<unk>", "<image>")
IMAGE_TOKEN = SPECIAL.index("<image>")
END = SPECIAL.index("<eos>")
_OF_QUESTIONS = (
    *("\n", ".", ",", ":", "?", '"', "a", "b", "answer", "center", "choices", "color", "directly", "do", "from"),
    *("given", "if", "is", "left", "letter", "no", "option's", "or", "right", "see", "specify", "state", "there"),
    *("traffic", "what", "where", "with", "yes", "you"),
)
"""Words of the prompts of `probe-kit ask` and of the questions that `vlm-tiny` was trained on besides."""
WORDS = tuple(dict.fromkeys((*SPECIAL, *_OF_QUESTIONS, *vocabulary())))
VOCABULARY = -(-len(WORDS) // 64) * 64
"""Rows of an embedding table for the words."""
_ISOLATED = r'\n|"|[.,:?](?=\s|$)'
"""Pattern of characters that are words of their own wherever they stand; not the colon in 7:30."""


def known_words() -> Collection[str]:
    """Return the words of an instruction or question that the embedded models know, in small letters."""
    return [word for word in WORDS if word not in SPECIAL]


def words_in(text: str) -> list[str]:
    """Return the words of a text as the tokenizer separates them, in small letters."""
    return [word for word in re.sub(_ISOLATED, r" \g<0> ", text.lower()).split(" ") if word]


def write_tokenizer(folder: Path, most: int) -> None:
    """Write `tokenizer.json` and its card.

    Args:
        folder: Folder of the files.
        most: Largest number of tokens of an instruction.
    """
    from tokenizers import Regex, Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.normalizers import Lowercase
    from tokenizers.pre_tokenizers import Sequence, Split
    from tokenizers.processors import TemplateProcessing

    tokenizer = Tokenizer(WordLevel({word: index for index, word in enumerate(WORDS)}, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Sequence([Split(Regex(_ISOLATED), "isolated"), Split(" ", "removed")])
    tokenizer.post_processor = TemplateProcessing(
        single="<bos> $A", special_tokens=[("<bos>", SPECIAL.index("<bos>"))]
    )
    tokenizer.add_special_tokens(list(SPECIAL))
    tokenizer.save(str(folder / "tokenizer.json"))
    card = {"tokenizer_class": "PreTrainedTokenizerFast", "model_max_length": most}
    tokens = {f"{name}_token": f"<{name}>" for name in ("pad", "eos", "bos", "unk")}
    (folder / "tokenizer_config.json").write_text(json.dumps(card | tokens, indent=1), encoding="utf-8")
