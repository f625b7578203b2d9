"""Networks of which only the sizes are needed: built on the meta device, without numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_SIZES_ONLY = ContextVar("sizes_only", default=False)


@contextmanager
def sizes_only() -> Iterator[None]:
    """A context in which networks are built on the meta device, and neither filled nor read."""
    token = _SIZES_ONLY.set(True)
    try:
        with torch.device("meta"):
            yield
    finally:
        _SIZES_ONLY.reset(token)


def builds_sizes_only() -> bool:
    """Whether networks are built for their sizes alone."""
    return _SIZES_ONLY.get()


def building_device(device: str = "cpu") -> str:
    """Return the device on which a network without numbers of its own is built: `device`, or meta for sizes."""
    return "meta" if builds_sizes_only() else device
