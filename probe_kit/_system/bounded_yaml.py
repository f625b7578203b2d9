"""Parsing of untrusted YAML, with a limit on what its aliases stand for."""

from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import read_regular

MOST_NODES = 1_000_000
_MOST_YAML_BYTES = 16 << 20


def load_yaml(file: Path) -> Any:
    """Return the value in a file of safe YAML.

    Raises OSError as `read_regular` does, ValueError for other text, for text that nests too deeply, and for
    aliases that stand for more than `MOST_NODES` values: nine lines can stand for a billion.
    """
    import yaml

    try:
        value = yaml.safe_load(read_regular(file, _MOST_YAML_BYTES))
        count = _nodes(value, {})
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
    except RecursionError:
        raise ValueError("it nests too deeply, or refers to itself") from None
    if count > MOST_NODES:
        raise ValueError(f"its aliases stand for {count:.0e} values; expected at most {MOST_NODES:,}")
    return value


def _nodes(value: Any, counted: dict[int, int]) -> int:
    """The number of values below one, where an alias counts as all that it stands for."""
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) not in counted:
        children = value.values() if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(_nodes(child, counted) for child in children)
    return counted[id(value)]
