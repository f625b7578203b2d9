"""Loading of transformers' objects from a checkpoint's files, without the Python code that those files name."""

from pathlib import Path
from typing import Any

from probe_kit.errors import CheckpointError

_REMOTE_CODE = "trust_remote_code"


def load_pretrained(loader: Any, source: Path | str, **options: Any) -> Any:
    """Return `loader.from_pretrained(source, **options)` of a class of transformers.

    A configuration can name Python code in its `auto_map`; without `trust_remote_code=False`, transformers asks on
    the terminal whether to run it. source: a folder or a hub id.
    Raises CheckpointError where the object needs such code, OSError for missing files, ValueError for others.
    """
    try:
        return loader.from_pretrained(str(source), trust_remote_code=False, **options)
    except ValueError as error:
        if _REMOTE_CODE not in str(error):
            raise
        raise CheckpointError(
            f"{source}: its configuration names Python code (auto_map) for {loader.__name__}, and probe_kit runs "
            "no code of a checkpoint. Take files that name a class of transformers, such as tokenizer.json with "
            "tokenizer_class in tokenizer_config.json"
        ) from error
