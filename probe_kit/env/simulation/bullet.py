"""A private physics server per environment, so that calls cannot affect another environment."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from tempfile import TemporaryFile
from threading import Lock
from typing import Any

from probe_kit._system.installing import install_command

_GREETING = b"pybullet build time:"
_importing = Lock()  # the descriptor that is exchanged meanwhile is of the whole process


def import_pybullet() -> Any:
    """The module pybullet, without the line on stderr that says when it was compiled.

    Its C code writes that line to the file descriptor on every first import, past `sys.stderr`.
    """
    with _importing:
        if "pybullet" in sys.modules:
            return sys.modules["pybullet"]
        with _without_greeting():
            return import_module("pybullet")


@contextmanager
def _without_greeting() -> Iterator[None]:
    """Hold back what is written to file descriptor 2, and pass it on without the greeting."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        stderr = os.dup(2)
    except OSError:  # the process has no stderr; nothing can be seen
        yield
        return
    with TemporaryFile() as buffer:
        os.dup2(buffer.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            buffer.seek(0)
            text = b"".join(line for line in buffer if not line.startswith(_GREETING))
            if text:
                os.write(2, text)


class BulletClient:
    """One PyBullet server without a window; every pybullet function is a method bound to it.

    pybullet is imported here, at the first use, and not by `import probe_kit.env`.
    """

    def __init__(self) -> None:
        pybullet = import_pybullet()
        if not pybullet.isNumpyEnabled():
            warnings.warn(
                "pybullet was compiled without numpy: a picture comes back as nested tuples and costs three times "
                "as much. Build it again beside numpy: "
                f"`{install_command(rebuild='pybullet')}`.",
                stacklevel=2,
            )
        self._pybullet = pybullet
        self._server = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._pybullet, name)
        return partial(member, physicsClientId=self._server) if callable(member) else member

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._server >= 0:
            self._pybullet.disconnect(physicsClientId=self._server)
            self._server = -1
