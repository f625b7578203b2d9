from pathlib import Path

from tokenizers import Tokenizer

from probe_kit.models.magma import ACTION_QUESTION, chat_text, conversation, picture_question
from tests.support.magma_checkpoints import IDS, write_tokenizer


def question(start_end: bool = True) -> str:
    return picture_question(ACTION_QUESTION.format(instruction="Put the cube on the Star"), start_end)


def test_a_whole_prompt_in_the_frames_of_llama_3() -> None:
    assert chat_text(conversation(question())) == (
        "<|begin_of_text|><|start_header_id|>system<|end_header_id|>\n\n"
        "You are agent that can see, talk and act.<|eot_id|>"
        "<|start_header_id|>user<|end_header_id|>\n\n"
        "<image_start><image><image_end>\n"
        "What action should the robot take to Put the cube on the Star?<|eot_id|>"
        "<|start_header_id|>assistant<|end_header_id|>\n\n"
    )
    assert question(start_end=False).startswith("<image>\nWhat")


def test_the_checkpoints_own_template_wins() -> None:
    template = "{{ bos_token }}{% for m in messages %}[{{ m.role }}] {{ m.content }} {% endfor %}>"
    text = chat_text(conversation("q"), template, beginning="<s>")
    assert text == "<s>[system] You are agent that can see, talk and act. [user] q >"


def test_the_system_speaks_first_unless_asked_otherwise() -> None:
    assert [message.role for message in conversation("q")] == ["system", "user"]
    assert [message.role for message in conversation("q", user_first=True)] == ["user", "system"]


def test_markers_are_single_tokens_of_a_tokenizer_in_the_released_layout(tmp_path: Path) -> None:
    tokenizer = Tokenizer.from_file(str(write_tokenizer(tmp_path) / "tokenizer.json"))
    ids = tokenizer.encode(chat_text(conversation(question()))).ids
    for token in ("<image>", "<image_start>", "<image_end>"):
        assert ids.count(IDS[token]) == 1
    assert ids[:2] == [IDS["<|begin_of_text|>"]] * 2  # written out, and once more by the tokenizer
    assert tokenizer.get_vocab_size(with_added_tokens=False) == 512
