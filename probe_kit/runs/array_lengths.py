"""The length of a run's arrays as other tools see it.

Arrays begin with room for many episodes, and the run's identity holds the hash of that metadata. Other tools read
an array whole, so its stored metadata says the number of planned episodes instead: as the length of the first
axis, and as the attribute `episodes`. Nothing else of it changes. Readers here set both back before they compare
the hash, so the length is part of no identity, and no reader depends on it.
"""

import json
from typing import Any

from probe_kit._system.bounded_files import parse_strict_json
from probe_kit.runs.layout import METADATA, ROOM

EPISODES = "episodes"
"""The attribute of an array with its number of planned episodes."""


def with_length(begun: bytes, episodes: int) -> bytes:
    """Return the metadata of an array, or of a group as it is, with this number of episodes.

    Args:
        begun: The metadata with which the run began.
        episodes: The number of planned episodes, at least 1.
    """
    content = json.loads(begun)
    if content.get("node_type") != "array":
        return begun
    content["shape"][0] = episodes
    content["attributes"] |= {EPISODES: episodes}
    return _as_zarr_writes(content)


def without_length(stored: bytes) -> bytes:
    """Return the metadata with which the run began; whatever `with_length` did not make is returned as it is."""
    try:
        content = parse_strict_json(stored)
        length = content["attributes"].pop(EPISODES)
        content["shape"][0] = ROOM
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        return stored
    if type(length) is not int or not 0 < length <= ROOM:
        return stored
    begun = _as_zarr_writes(content)
    return begun if with_length(begun, length) == stored else stored


def is_metadata(key: str) -> bool:
    """Whether a key is that of the metadata of an array or group."""
    return key.rpartition("/")[2] == METADATA


def _as_zarr_writes(content: dict[str, Any]) -> bytes:
    return json.dumps(content, indent=2).encode()
