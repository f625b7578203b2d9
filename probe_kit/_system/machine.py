"""The machine that runs probe_kit: its scheduling, and the facts that results record."""

import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from probe_kit._system.counting import plural
from probe_kit.errors import UsageError

CORES = "PROBE_KIT_CORES"
"""The environment variable by which a pool gives its workers their share of the cores."""
_DEVICE = re.compile(r"(?P<kind>[a-z]+)(:(?P<index>\d+))?")
_KINDS = ("cpu", "cuda", "hpu", "mps", "mtia", "xpu")
"""The kinds of devices of torch that compute."""
AUTO = "auto"
"""The device that a machine chooses, see `device_here`."""
_GPU_NODES = ("nvidia[0-9]*", "nvidiactl", "nvhost-*", "nvgpu*", "nvmap", "dxg", "kfd")
"""Device files of Linux without any of which neither CUDA nor ROCm has a GPU."""
_OUT_OF_MEMORY = ("can't allocate memory", "MPS backend out of memory")
"""What torch says of a CPU and of Apple's GPUs in a plain RuntimeError."""
_NVIDIA = Path("/proc/driver/nvidia/gpus")


def check_device_name(device: str, present: bool = True) -> None:
    """Raise UsageError for a text that is no device, or names one that this machine surely lacks.

    The message names the devices that the machine has. With `present=False` a device of another machine is
    accepted.
    """
    if device == AUTO:
        return
    match = _DEVICE.fullmatch(device)
    if match is None or match["kind"] not in _KINDS:
        raise UsageError(
            f"device {device!r} cannot be used: it is none of {', '.join((*_KINDS, AUTO))}, with an index such as "
            f"cuda:1. "
            f"{what_is_here()}"
        )
    if not present:
        return
    if (match["kind"] == "cuda" and _surely_without_gpu()) or (
        match["kind"] == "mps" and sys.platform != "darwin"
    ):
        raise UsageError(
            f"device {device!r} cannot be used: this machine has no such device. {what_is_here()}. "
            "Give one of these, or --device auto"
        )


def device_here(device: str) -> str:
    """Return the device that a text means on this machine, for `auto` a GPU where torch finds one.

    `auto` is `cuda` or `cpu`: no family is tested on another kind. It imports torch only where the system shows a
    GPU.
    """
    if device != AUTO:
        return device
    if sys.platform == "darwin" or _surely_without_gpu():
        return "cpu"
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def what_is_here() -> str:
    """Return a sentence on the devices that torch finds or, before torch is imported, that the system shows."""
    return f"This machine has {', '.join(_devices())}"


def cores_here() -> int:
    """Count the cores this process may use: those of the system, or its share if it is a worker of a pool."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = os.environ.get(CORES, "")
    return min(cores, int(share)) if share.isdecimal() and int(share) else cores


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ended, of the machine or of a device, in Python or in a library that it called.

    The libraries differ: torch has a class for a GPU and raises plain RuntimeError for a CPU, and the system
    refuses to map a file with an OSError.
    """
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _OUT_OF_MEMORY)


def _devices() -> list[str]:
    return [
        f"cpu ({plural(cores_here(), 'core')})",
        *(_torch_devices() if "torch" in sys.modules else _system_devices()),
    ]


def _torch_devices() -> list[str]:
    torch = sys.modules["torch"]
    if torch.cuda.is_available():
        return [f"cuda:{n} ({torch.cuda.get_device_name(n)})" for n in range(torch.cuda.device_count())]
    return ["mps"] if torch.backends.mps.is_available() else []


def _system_devices() -> list[str]:
    """Return the devices that the system shows without torch."""
    if sys.platform == "darwin":
        return ["mps"]
    models = [
        match[1].strip()
        for card in sorted(_NVIDIA.glob("*/information"))
        if (match := re.search(r"^Model:(.*)$", card.read_text(errors="replace", encoding="utf-8"), re.MULTILINE))
    ]
    return [f"{plural(len(models), 'GPU')} ({', '.join(dict.fromkeys(models))})"] if models else []


def _surely_without_gpu() -> bool:
    return sys.platform == "linux" and not any(any(Path("/dev").glob(name)) for name in _GPU_NODES)


@contextmanager
def same_scheduling() -> Iterator[None]:
    """Restore the scheduling policy of this thread at the end of the body.

    For root, the video encoder SVT-AV1 makes the thread that opens it a real-time one of the highest priority. All
    other processes of the machine would then wait for this one, and for those that it starts. Does nothing on
    systems without scheduling policies.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
