from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.families.spatialvla.adapter import Speech
from probe_kit.models.spatialvla import SpatialVLAConfig
from tests.support.spatialvla_checkpoints import IMAGE, WORDS, config_values, write_tokenizer

CONFIG = SpatialVLAConfig.from_json(config_values())


def speech(folder: Path, **fields: Any) -> Speech:
    chosen = {"prompt": None, "lowercase": True, "tokenizer": None, **fields}
    return Speech.of(CONFIG, write_tokenizer(folder), **chosen)


def words(ids: list[int]) -> str:
    return "".join(WORDS[number] for number in ids).replace("▁", " ")


def test_the_picture_comes_first_then_the_bare_instruction_in_lower_case_and_a_new_line(tmp_path: Path) -> None:
    ids = speech(tmp_path).prompt("Put the Cube on the star")
    assert ids[:9] == [IMAGE] * 9
    assert words(ids[9:]) == "<bos>put the cube on the star\n"
    assert ids.count(IMAGE) == CONFIG.patches


def test_case_and_template_are_options(tmp_path: Path) -> None:
    assert words(speech(tmp_path, lowercase=False).prompt("Put it")[9:]) == "<bos>Put it\n"
    asked = speech(tmp_path, prompt="question").prompt("Take it")
    assert words(asked[9:]) == "<bos>What action should the robot take to take it?\n"
    assert words(speech(tmp_path, prompt="do: {instruction}").prompt("it")[9:]) == "<bos>do: it\n"
    with pytest.raises(UsageError, match="neither one of bare, question nor a template"):
        speech(tmp_path, prompt="do it")


def test_letters_beyond_the_vocabulary_become_bytes(tmp_path: Path) -> None:
    assert words(speech(tmp_path).prompt("é")[9:]) == "<bos><0xC3><0xA9>\n"


def test_missing_tokenizer_files_are_named(tmp_path: Path) -> None:
    without = Speech.of(CONFIG, tmp_path, None, lowercase=True, tokenizer=None)
    with pytest.raises(CheckpointError, match=r"tokenizer\.json and tokenizer_config\.json are missing"):
        without.prompt("put the cube on the star")


def test_another_checkpoints_tokenizer_is_refused(tmp_path: Path) -> None:
    """Its words may mean something else, which nothing but the added tokens gives away."""
    other = write_tokenizer(tmp_path / "other", more=("<video>",))
    with pytest.raises(CheckpointError, match=r"reads <ACTION00000> as .* the model expects"):
        speech(tmp_path, tokenizer=str(other)).prompt("put it")


@pytest.mark.parametrize("text", ["put the <image> on the star", "do <ACTION00003> now"])
def test_an_instruction_cannot_smuggle_in_pictures_or_actions(tmp_path: Path, text: str) -> None:
    with pytest.raises(InstructionError, match="stands for a picture or an action"):
        speech(tmp_path, lowercase=False).prompt(text)


def test_a_new_line_that_melts_into_the_one_behind_it_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InstructionError, match="merges with the new line"):
        speech(tmp_path).prompt("put the cube on the star\n")


def test_bytes_serve_checkpoints_without_a_tokenizer(tmp_path: Path) -> None:
    ids = Speech.of(CONFIG, tmp_path, None, lowercase=True, tokenizer="bytes").prompt("Go")
    assert ids == [IMAGE] * 9 + [2, *(3 + byte for byte in b"go\n")]
