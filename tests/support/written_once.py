"""A tiny checkpoint is drawn and saved once per process, and copied when it is asked for again."""

import shutil
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def written_once(write: Callable[..., Path]) -> Callable[..., Path]:
    """A writer that copies what it wrote before, if it is given a folder alone."""
    stored: list[tuple[TemporaryDirectory[str], Path]] = []  # as long as the process

    @wraps(write)
    def written_or_copied(folder: Path, *arguments: Any, **fields: Any) -> Path:
        if arguments or fields:
            return write(folder, *arguments, **fields)
        if not stored:
            original = TemporaryDirectory(prefix="probe-kit-tests-")
            stored.append((original, write(Path(original.name, "made")).relative_to(Path(original.name, "made"))))
        original, checkpoint = stored[0]
        return Path(shutil.copytree(Path(original.name, "made"), folder, dirs_exist_ok=True)) / checkpoint

    return written_or_copied
