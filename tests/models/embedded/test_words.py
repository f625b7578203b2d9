"""The words of the embedded models: listed, and checked before a model is loaded."""

import json
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import InstructionError
from probe_kit.extract import AskSettings, ExtractSettings
from probe_kit.extract.extraction import open_checked
from probe_kit.hooks.registry import find_family
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.models.embedded.words import SPECIAL, WORDS, known_words, words_in
from probe_kit.suite import Terms, suite_from_csv

EMBEDDED = ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state", "vlm-tiny")
TEXTS = (
    "Put the cube on the red square",
    "Put the cube on the clock that says 7:30, not 8:15.",
    'Choices: "a" or "b"?\nAnswer directly with yes.',
    "put  the   cube on Bananas!",
)


@pytest.mark.parametrize("name", ["pi0-tiny", "vlm-tiny"])
@pytest.mark.parametrize("text", TEXTS)
def test_words_are_separated_as_the_tokenizer_of_the_checkpoint_does(name: str, text: str) -> None:
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(embedded_checkpoint(name) / "tokenizer.json"))
    tokens = tokenizer.encode(text, add_special_tokens=False).tokens
    assert tokens == [word if word in WORDS else "<unk>" for word in words_in(text)]


@pytest.mark.parametrize("name", EMBEDDED)
def test_an_unknown_word_is_refused_by_name(name: str) -> None:
    family = find_family(name, ())
    family.check_words(TEXTS[:1])
    with pytest.raises(InstructionError, match=r"does not know 'xylophone' in .* 1 further .*models --words"):
        family.check_words(["Put the cube on the xylophone", "Put the cube on the zither"])
    family.check_words(["Put the cube on the xylophone"], checkpoint="a folder with a tokenizer of its own")


def test_other_families_read_any_text() -> None:
    find_family("pi0", ()).check_words(["Put the cube on the xylophone"])


def test_models_words_lists_every_word_and_no_special_token() -> None:
    answer = CliRunner().invoke(app, ["models", "--words"])
    assert answer.exit_code == 0
    listed = answer.stdout.split("\n")
    assert {"red", "square", "cube"} <= set(listed)
    assert set(filter(None, listed)) == {word for word in known_words() if word.strip()}
    assert not set(SPECIAL) & set(listed)
    named = CliRunner().invoke(app, ["models", "vlm-tiny", "--words", "--json"])
    assert json.loads(named.stdout) == list(filter(None, listed))
    other = CliRunner().invoke(app, ["models", "pi0", "--words"])
    assert (other.exit_code, "pi0 reads any text" in other.stderr) == (2, True)


@pytest.mark.parametrize("settings", [ExtractSettings("pi0-tiny"), AskSettings("vlm-tiny")])
def test_a_suite_with_an_unknown_word_is_refused_before_the_model_is_loaded(
    settings: ExtractSettings | AskSettings, tmp_path: Path
) -> None:
    for name in ("red", "blue"):
        Image.new("RGB", (300, 300), name).save(tmp_path / f"{name}.png")
    table = tmp_path / "table.csv"
    table.write_text("instruction,correct,wrong\nPut it on the xylophone,red.png,blue.png\n", encoding="utf-8")
    suite = suite_from_csv(table, tmp_path / "suite", terms=Terms("CC0-1.0", "the test"))
    with pytest.raises(InstructionError, match=r"does not know .*'xylophone'"):
        open_checked(settings.changed(suite=suite.folder))
