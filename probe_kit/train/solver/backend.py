"""Linear algebra for numpy arrays and torch tensors, written once in the names that both share."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.machine import check_device_name, what_is_here
from probe_kit.errors import MissingExtraError, UsageError

if TYPE_CHECKING:
    import torch

Array = Any
"""A numpy array, or a torch tensor on any device."""


def array_namespace(array: Array) -> Any:
    """The module that made `array`: numpy or torch."""
    return import_module(type(array).__module__.partition(".")[0])


def to_device(array: NDArray[Any], device: "str | torch.device | None") -> Array:
    """`array` as a torch tensor on `device`, or as it is without one."""
    if device is None:
        return array
    import torch

    # Of an array of a run, or out of Ray's memory, which may not be written to, `as_tensor` warns.
    return torch.as_tensor(array if array.flags.writeable else array.copy(), device=device)


def to_device_of(like: Array, array: NDArray[Any]) -> Array:
    """`array` where `like` is, and made by the same module."""
    return array if isinstance(like, np.ndarray) else to_device(array, like.device)


def to_numpy(array: Array) -> NDArray[Any]:
    """`array` as a numpy array in this machine's memory."""
    return array if isinstance(array, np.ndarray) else np.asarray(array.cpu())


def check_device(device: str | None) -> None:
    """Raises MissingExtraError without torch, and UsageError for a device torch does not know or see."""
    if device is None:
        return
    check_device_name(device)
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"device {device!r} needs torch. Install it, or leave `device` out.") from error
    try:
        torch.zeros(1, dtype=torch.float64, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:  # what torch raises: unknown, absent, no float64
        reason = str(error).partition("\n")[0]
        raise UsageError(
            f"device {device!r} cannot be used: {reason}. {what_is_here()}; or leave `device` out"
        ) from error


def keep_freed_memory() -> None:
    """Have glibc keep up to 64 MB of what is freed for the next arrays, instead of giving it back to the system.

    It learns so from the largest block, up to 32 MB, that was ever freed. Arrays of some megabytes that come and
    go with every step are otherwise mapped anew each time. Costs nothing: the block is never touched.
    """
    np.empty(2**25 - 2**16, np.uint8)  # below 32 MB, with what glibc adds to a block
