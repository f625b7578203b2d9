import json
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.families.magma.checkpoint import ChatText
from probe_kit.models.magma import MagmaConfig
from tests.support.magma_checkpoints import IDS, config_values, write_tokenizer

CONFIG = MagmaConfig.from_json(config_values())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tokenizer(tmp_path)


def text(folder: Path, **options: bool) -> ChatText:
    return ChatText.of(folder, CONFIG, **options)


def test_the_question_is_told_from_the_frames_around_it(folder: Path) -> None:
    spoken = text(folder)
    prompt = spoken.prompt("Where is the star?")
    asked = [number for number, inside in zip(prompt.ids, prompt.question, strict=True) if inside]
    assert spoken.decode(asked) == "Where is the star?"
    frames = [number for number, inside in zip(prompt.ids, prompt.question, strict=True) if not inside]
    assert IDS["<image>"] in frames
    assert "talk and act" in spoken.decode(frames[: frames.index(IDS["<|eot_id|>"])])


@pytest.mark.parametrize("user_first", [False, True])
@pytest.mark.parametrize("question", ["see", "user", "Is it <here>?", "a\nb"])
def test_a_question_whose_words_stand_in_the_frames_too_is_found(
    folder: Path, question: str, user_first: bool
) -> None:
    spoken = text(folder, user_first=user_first)
    prompt = spoken.prompt(question)
    places = [place for place, inside in enumerate(prompt.question) if inside]
    assert spoken.decode([prompt.ids[place] for place in places]) == question
    assert places == list(range(places[0], places[-1] + 1))
    assert places[0] > prompt.ids.index(IDS["<image>"])


def test_a_begun_answer_stands_behind_the_frames(folder: Path) -> None:
    spoken = text(folder)
    plain, begun = spoken.prompt("Which?"), spoken.prompt("Which?", "The answer is ")
    assert begun.ids[: len(plain.ids)] == plain.ids
    assert sum(begun.question) == sum(plain.question)


def test_the_order_of_turns_can_be_the_releases(folder: Path) -> None:
    ours, theirs = text(folder).prompt("q?"), text(folder, user_first=True).prompt("q?")
    assert sorted(ours.ids) == sorted(theirs.ids)
    assert ours.ids.index(IDS["<image>"]) > theirs.ids.index(IDS["<image>"])


def test_a_checkpoints_own_template_is_used(folder: Path) -> None:
    template = "{{ bos_token }}{% for m in messages %}[{{ m.role }}]{{ m.content }}{% endfor %}#"
    (folder / "chat_template.jinja").write_text(template, encoding="utf-8")
    assert text(folder).decode(text(folder).prompt("q?").ids[-2:]) == "?#"
    (folder / "chat_template.jinja").write_text("{{ messages[1].content | upper }}", encoding="utf-8")
    with pytest.raises(CheckpointError, match="changes the words"):
        text(folder).prompt("where?")


@pytest.mark.parametrize("marker", ["<image>", "<|eot_id|>"])
def test_a_question_with_a_marker_in_it_is_refused(folder: Path, marker: str) -> None:
    with pytest.raises(InstructionError, match="stands for something else"):
        text(folder).prompt(f"Put it on {marker} now")


def test_an_option_is_its_first_token_behind_the_prompt(folder: Path) -> None:
    spoken = text(folder)
    assert spoken.decode([spoken.option("A or B?", "", "B")]) == "B"
    assert spoken.option("A or B?", "", "Bad") == spoken.option("A or B?", "", "B")
    with pytest.raises(UsageError, match="merges with the end of the prompt"):
        spoken.option("A or B?", "", "")


def test_text_ends_with_the_turn(folder: Path) -> None:
    spoken = text(folder)
    letter = spoken.option("q?", "", "x")
    assert spoken.ends >= {IDS["<|eot_id|>"]}
    assert spoken.decode([letter, letter, IDS["<|eot_id|>"], letter]) == "xx"
    assert spoken.decode([IDS["<|eot_id|>"]]) == ""


def test_another_models_tokenizer_is_refused(folder: Path, tmp_path: Path) -> None:
    assert text(folder).vocabulary == 512  # without the added tokens
    other = MagmaConfig.from_json(config_values(tokenizer_vocab_size=520))
    with pytest.raises(CheckpointError, match=r"512 ids before the added ones, config\.json says 520"):
        ChatText.of(folder, other)
    small = MagmaConfig.from_json(config_values(text={"vocab_size": 515}))
    with pytest.raises(CheckpointError, match=r"ids up to 520; this model has 515"):
        ChatText.of(folder, small)
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing"):
        ChatText.of(tmp_path / "nowhere", CONFIG)


def test_the_beginning_is_the_tokenizers_own(folder: Path) -> None:
    file = folder / "tokenizer_config.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text(encoding="utf-8")), "bos_token": {"content": "<|end_of_text|>"}}),
        encoding="utf-8",
    )
    assert text(folder).prompt("q?").ids[:2] == (IDS["<|begin_of_text|>"], IDS["<|end_of_text|>"])
