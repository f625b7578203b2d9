"""The messages of openpi's wire: msgpack with arrays of numbers, read within bounds.

A message may come from anyone. Maps, lists, texts and depth are bounded, and arrays hold numbers alone, whose
bytes fit their shape; nothing in it is ever a pickle, a path or code.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ObservationError
from probe_kit.extract.sources.served_source import NUMBER_KINDS

MOST_BYTES = 16 << 20
MOST_ENTRIES, MOST_ITEMS, LONGEST_TEXT, DEEPEST = 256, 4096, 64 << 10, 8
_MOST_VALUES = 20_000
"""The most entries and items of a message together: a small message may hold very many of them."""
_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"


class MessageError(ObservationError):
    """A message that is no msgpack within the bounds; nothing in it can be answered."""


class _Counter:
    """The values of one message so far, and what its maps stand for."""

    def __init__(self) -> None:
        self._values = 0

    def plain_map(self, entries: dict[Any, Any]) -> dict[Any, Any]:
        self._count(len(entries))
        return entries

    def map(self, entries: dict[Any, Any]) -> Any:
        self._count(len(entries))
        if _ARRAY in entries:
            return _array(entries)
        return _scalar(entries) if _SCALAR in entries else entries

    def list(self, items: list[Any]) -> list[Any]:
        self._count(len(items))
        return items

    def _count(self, more: int) -> None:
        self._values += more
        if self._values > _MOST_VALUES:
            raise MessageError(f"the message has more than {_MOST_VALUES:,} values; send arrays, not lists")


def unpack(content: bytes) -> dict[str, Any]:
    """Return a message: a map whose keys are texts. Arrays are read-only.

    Raises:
        MessageError: For what is no msgpack within the bounds.
        ObservationError: For an array of another kind than numbers, or whose bytes do not fit its shape.
    """
    message = _read(content, (counter := _Counter()).map, counter)
    if not isinstance(message, dict) or not all(isinstance(key, str) for key in message):
        raise MessageError(f"the message is a {type(message).__name__}; expected a map whose keys are texts")
    _check_depth(message)
    return message


def check_bounds(content: bytes) -> None:
    """Check a message that another library decodes, arrays and all. Raises MessageError beyond the bounds."""
    message = _read(content, (counter := _Counter()).plain_map, counter)
    _check_depth({"message": message})


def _read(content: bytes, read_map: Callable[[dict[Any, Any]], Any], counter: "_Counter") -> Any:
    try:
        return msgpack.unpackb(
            content,
            object_hook=read_map,
            list_hook=counter.list,
            strict_map_key=True,
            max_map_len=MOST_ENTRIES,
            max_array_len=MOST_ITEMS,
            max_str_len=LONGEST_TEXT,
            max_bin_len=MOST_BYTES,
            max_ext_len=0,
        )
    except ObservationError:
        raise
    except (
        ValueError,
        TypeError,
        UnicodeDecodeError,
        msgpack.UnpackException,
        RecursionError,
        OverflowError,
    ) as error:
        raise MessageError(f"the message is no msgpack within the bounds: {type(error).__name__}") from None


def _check_depth(message: Mapping[str, Any]) -> None:
    level: list[Any] = [message]
    for _ in range(DEEPEST):
        level = [
            child
            for value in level
            for child in (value.values() if isinstance(value, dict) else value)
            if isinstance(child, dict | list)
        ]
    if level:
        raise MessageError(f"the message is nested deeper than {DEEPEST} levels; send a flat map")


def _array(entries: Mapping[Any, Any]) -> NDArray[Any]:
    data, shape = entries.get(_DATA), entries.get(_SHAPE)
    dtype = _dtype(entries.get(_DTYPE))
    sizes = shape if isinstance(shape, list) and len(shape) <= DEEPEST else None
    if sizes is None or not all(type(size) is int and size >= 0 for size in sizes) or not isinstance(data, bytes):
        raise ObservationError("an array has no bytes or no shape; expected those of a numpy array")
    if math.prod(sizes) * dtype.itemsize != len(data):
        raise ObservationError(f"an array of {dtype} {tuple(sizes)} has {len(data)} bytes; send it whole")
    return np.frombuffer(data, dtype).reshape(sizes)


def _scalar(entries: Mapping[Any, Any]) -> int | float | bool:
    _dtype(entries.get(_DTYPE))
    value = entries.get(_DATA)
    if not isinstance(value, bool | int | float):
        raise ObservationError(f"a number is a {type(value).__name__}; expected a number of numpy")
    return value


def _dtype(name: Any) -> np.dtype[Any]:
    """Return the type of an array. Raises ObservationError for anything but numbers."""
    try:
        dtype = np.dtype(name) if isinstance(name, str) and len(name) <= DEEPEST else None
    except (TypeError, ValueError):
        dtype = None
    if dtype is None or dtype.kind not in NUMBER_KINDS or dtype.fields is not None:
        raise ObservationError(f"an array has the type {name!r:.40}; expected numbers, such as uint8 or float32")
    return dtype


def pack(message: Mapping[str, Any]) -> bytes:
    """Return a message, in which arrays are as openpi's client reads them."""
    packed: bytes = msgpack.packb(message, default=_pack)
    return packed


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMBER_KINDS:
        array = np.asarray(value, order="C")
        return {_ARRAY: True, _DATA: array.tobytes(), _DTYPE: array.dtype.str, _SHAPE: list(array.shape)}
    raise TypeError(f"a message holds a {type(value).__name__}")
