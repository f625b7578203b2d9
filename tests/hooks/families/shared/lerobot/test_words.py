"""Words are checked with the small files alone: a checkpoint on the hub is not fetched for that."""

from fnmatch import fnmatch
from pathlib import Path

import pytest

from probe_kit.errors import InstructionError
from probe_kit.hooks.families.shared.lerobot.policy import TEXT_FILES
from probe_kit.hooks.registry import find_family
from tests.support.every_checkpoint import WRITERS

LEROBOTS = ("pi0", "pi05", "pi0-fast", "molmoact2", "groot", "xvla", "eo1", "smolvla")


@pytest.mark.parametrize("name", LEROBOTS)
def test_a_text_that_does_not_fit_is_refused_and_never_cut_also_without_the_weights(
    name: str, tmp_path: Path
) -> None:
    write, options = WRITERS[name]
    checkpoint, family = write(tmp_path / "checkpoint"), find_family(name)
    policy = family.load(str(checkpoint), options=options)
    for path in [path for path in checkpoint.rglob("*") if path.is_file()]:
        if not any(fnmatch(path.relative_to(checkpoint).as_posix(), pattern) for pattern in TEXT_FILES):
            path.unlink()
    assert not (checkpoint / "model.safetensors").exists()
    family.check_instructions(str(checkpoint), ["Put the cube on the star"], options)
    unreadable = "?" if name == "groot" else " " if name == "eo1" else "Put the cube on the star " * 200
    with pytest.raises(InstructionError):
        policy.token_ids([unreadable])
    with pytest.raises(InstructionError):
        family.check_instructions(str(checkpoint), [unreadable], options)
