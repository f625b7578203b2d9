from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError, InstructionError
from probe_kit.hooks.families.prismatic.adapter import ByteTokenizer, FileTokenizer, find_tokenizer
from tests.support.prismatic_checkpoints import write_tokenizer


def test_the_first_folder_that_has_a_tokenizer_wins(tmp_path: Path) -> None:
    write_tokenizer(tmp_path / "base")
    found = find_tokenizer([tmp_path / "adapter", tmp_path / "base"], None, 1, 320)
    assert found == FileTokenizer(tmp_path / "base", 1)


def test_a_folder_that_was_asked_for_is_the_only_place(tmp_path: Path) -> None:
    write_tokenizer(tmp_path / "base")
    with pytest.raises(CheckpointError, match="elsewhere"):
        find_tokenizer([tmp_path / "base"], str(tmp_path / "elsewhere"), 1, 320)


def test_the_beginning_comes_from_the_tokenizers_files_before_the_models(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    assert FileTokenizer(tmp_path, 2).encode("put the cube")[0] == 1
    (tmp_path / "tokenizer_config.json").unlink()
    assert FileTokenizer(tmp_path, 2).encode("put the cube")[0] == 2
    assert FileTokenizer(tmp_path, None).encode("<s> put")[0] == 1


def test_special_tokens_are_those_the_file_declares(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    assert FileTokenizer(tmp_path, 1).special == {0, 1, 2}


def test_an_unknown_word_is_an_error_that_shows_the_tokens(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    with pytest.raises(InstructionError, match="<unk>"):
        FileTokenizer(tmp_path, 1).encode("put the zebra")


def test_bytes_know_every_text_and_need_room_for_256_of_them() -> None:
    assert ByteTokenizer(1).encode("zé\n") == [1, 125, 198, 172, 13]
    with pytest.raises(CheckpointError, match="259"):
        find_tokenizer([], "bytes", 1, 128)
