"""How questions become ids, on a tokenizer of bytes."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.families.shared.text import Frame, FramedText
from tests.support.qwen_checkpoints import ID, write_tokenizer

FRAME = Frame("<|im_start|>user\n<|vision_start|>", "<|vision_end|>", "<|im_start|>user\n", "<|im_end|>\nSay: ")
PAD = ID["<|image_pad|>"]


def _text(folder: Path, vocabulary: int = 272, end: object = ID["<|im_end|>"]) -> FramedText:
    write_tokenizer(folder)
    return FramedText.of(folder, FRAME, SimpleNamespace(vocab_size=vocabulary, eos_token_id=end), folder)


def test_the_question_stands_between_picture_and_end(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why not?", "Yes", [PAD] * 5)
    said = [index for index, asked in enumerate(prompt.question) if asked]
    assert len(said) == len("Why not?")
    assert prompt.ids[slice(*prompt.picture)] == (PAD,) * 5
    assert prompt.ids[prompt.picture[1]] == ID["<|vision_end|>"]
    assert said[0] == prompt.picture[1] + 1
    assert len(prompt.ids) - 1 - said[-1] == 1 + len("\nSay: ") + len("Yes")


def test_without_a_picture_nothing_marks_its_place(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why?")
    assert prompt.picture == (0, 0)
    assert ID["<|vision_start|>"] not in prompt.ids
    assert ID["<|vision_end|>"] not in prompt.ids


def test_marks_at_the_ends_of_a_picture_are_no_picture(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why?", picture=[-1, -9, -9, -2], marks=1)
    assert prompt.ids[slice(*prompt.picture)] == (-9, -9)


@pytest.mark.parametrize("token", ["<|im_end|>", "<|image_pad|>"])
def test_a_question_that_holds_a_token_of_the_frames_is_refused(token: str, tmp_path: Path) -> None:
    text = _text(tmp_path)
    with pytest.raises(InstructionError, match="stands for something else"):
        text.prompt(f"Do you see {token}?")
    with pytest.raises(InstructionError, match="stands for something else"):
        text.prompt("Why?", begun=token)


def test_an_option_is_the_token_behind_the_prompt(tmp_path: Path) -> None:
    text = _text(tmp_path)
    prompt = text.prompt("Why?")
    assert text.option(prompt, "A") == text.prompt("Why?", "A").ids[-1]
    assert text.option(prompt, "Apple") == text.option(prompt, "A")
    with pytest.raises(UsageError, match="merges with"):
        text.option(prompt, "")


def test_what_is_said_ends_at_an_end(tmp_path: Path) -> None:
    (tmp_path / "generation_config.json").write_text(
        json.dumps({"eos_token_id": [ID["<|endoftext|>"], 0]}), encoding="utf-8"
    )
    text = _text(tmp_path)
    left = list(text.prompt("", "left").ids[-4:])
    assert text.decode([*left, ID["<|endoftext|>"], *left]) == "left"
    assert text.decode([ID["<|im_start|>"], *left]) == "left"


def test_another_models_tokenizer_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="ids up to 262; this model has 260"):
        _text(tmp_path, 260)
    with pytest.raises(CheckpointError, match=r"config\.json says 7"):
        _text(tmp_path).check_token("<|image_pad|>", 7)


def test_files_that_are_missing_are_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing"):
        FramedText.of(tmp_path, FRAME, SimpleNamespace(vocab_size=272, eos_token_id=1), tmp_path)
    with pytest.raises(CheckpointError, match="eos_token_id"):
        _text(tmp_path, end=None)
