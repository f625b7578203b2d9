"""The `preprocessor_config.json` of a checkpoint."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError

PROCESSOR_FILE = "preprocessor_config.json"


def processor_settings(folder: Path, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Any]:
    """The named values of the file in `folder`; `optional` ones only where they are set.

    Raises CheckpointError if the file is missing, is not JSON or lacks a needed one.
    """
    file = folder / PROCESSOR_FILE
    if not file.is_file():
        raise CheckpointError(
            f"{file} is missing; it defines how pictures are prepared for this checkpoint. "
            "Copy it from the model's page"
        )
    try:
        values = load_json(file)
    except ValueError as error:
        raise CheckpointError(f"{file} is not JSON ({error}); download the checkpoint again") from error
    if not isinstance(values, dict) or (missing := [name for name in needed if values.get(name) is None]):
        raise CheckpointError(f"{file} lacks {', '.join(missing) if isinstance(values, dict) else 'named values'}")
    return {name: values[name] for name in (*needed, *optional) if values.get(name) is not None}


def square_side(values: dict[str, Any], folder: Path) -> int:
    """Pixels of the side of the square that `size` names. Raises CheckpointError if it names none."""
    size = values["size"]
    height, width = (size.get(side) if isinstance(size, dict) else size for side in ("height", "width"))
    if not isinstance(height, int) or height != width:
        raise CheckpointError(f"{folder / PROCESSOR_FILE} has size {size}; expected a square of so many pixels")
    return height
