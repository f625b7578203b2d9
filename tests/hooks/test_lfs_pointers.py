"""A Git LFS pointer in place of any file of the user is named as one, with what fetches the file."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from probe_kit._system.bounded_files import (
    check_no_pointer,
    load_json,
    load_yaml,
    open_arrays,
    read_json,
    read_regular,
)
from probe_kit._system.text_tables import open_table
from probe_kit.errors import LfsPointerError, MissingExtraError, ProbeKitError, UsageError
from probe_kit.hooks.registry import find_family
from probe_kit.runs.direction_files import read_direction
from probe_kit.suite.pictures import load_picture
from probe_kit.train.label_columns import read_table
from tests.support.every_checkpoint import WRITERS, families

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0f' * 32}\nsize 6699736\n"

READERS: dict[str, Callable[[Path], object]] = {
    "any.bin": read_regular,
    "settings.json": load_json,
    "card.json": lambda file: read_json(file, UsageError, "Write it again"),
    "scene.yaml": load_yaml,
    "arrays.npz": open_arrays,
    "direction.npz": lambda file: read_direction(f"{file}#name"),
    "direction.safetensors": lambda file: read_direction(f"{file}#name"),
    "table.csv": lambda file: open_table(file, ("picture",)),
    "labels.csv": lambda file: read_table(file, ["label"]),
    "labels.parquet": lambda file: read_table(file, ["label"]),
    "tile.png": load_picture,
}


@pytest.mark.parametrize("name", READERS)
def test_a_pointer_is_named_wherever_a_file_is_read(name: str, tmp_path: Path) -> None:
    file = tmp_path / name
    file.write_text(POINTER, encoding="utf-8")
    with pytest.raises(LfsPointerError, match=rf"{name} is a Git LFS pointer.*6,699,736 bytes.*git lfs pull"):
        READERS[name](file)


def test_the_clone_is_named_in_which_the_files_are_fetched(tmp_path: Path) -> None:
    (tmp_path / "clone" / ".git").mkdir(parents=True)
    file = tmp_path / "clone" / "data" / "file.parquet"
    file.parent.mkdir()
    file.write_text(POINTER.replace("\n", "\r\n"), encoding="utf-8")
    with pytest.raises(LfsPointerError, match=rf"Run `git lfs pull` in {tmp_path / 'clone'}$"):
        check_no_pointer(file)


def test_a_text_that_speaks_of_pointers_is_none(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text(f"A pointer begins so:\n{POINTER}", encoding="utf-8")
    check_no_pointer(file)
    file.write_text(POINTER + "x" * 2000, encoding="utf-8")
    check_no_pointer(file)
    assert read_regular(file).endswith(b"x")


@pytest.mark.slow
@pytest.mark.parametrize("family", families())
def test_every_file_of_a_checkpoint_that_is_a_pointer_is_named_or_not_needed(family: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    checkpoint = write(tmp_path / "made")
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    refused = []
    try:
        find_family(family).load(str(checkpoint), options=options)
    except MissingExtraError as error:
        pytest.skip(str(error))
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        shutil.copy(file, tmp_path / "intact")
        file.write_text(POINTER, encoding="utf-8")
        if (message := _refusal(family, checkpoint, options)) is not None:
            assert "is a Git LFS pointer" in message, f"{file.name}: {message}"
            assert file.name in message, f"{file.name}: {message}"
            refused.append(file.name)
        file.unlink()
        shutil.copy(tmp_path / "intact", file)
    assert any(name.endswith((".safetensors", ".pt")) for name in refused), refused
    assert any(name.endswith(".json") for name in refused), refused


def _refusal(family: str, checkpoint: Path, options: dict[str, object]) -> str | None:
    """The message with which a checkpoint is refused; None for one that loads."""
    try:
        find_family(family).check_instructions(str(checkpoint), ["the cube"], options)
        find_family(family).load(str(checkpoint), options=options)
    except ProbeKitError as error:
        return str(error)
    return None
