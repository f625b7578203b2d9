"""A private physics server, so that no call can reach another environment by accident."""

import warnings
from functools import partial
from typing import Any


class BulletClient:
    """One PyBullet server without a window; every pybullet function is a method bound to it.

    pybullet is imported here, at the first use, and not by `import probe_kit.env`.
    """

    def __init__(self) -> None:
        import pybullet

        if not pybullet.isNumpyEnabled():
            warnings.warn(
                "pybullet was compiled without numpy: a picture comes back as nested tuples and costs three times "
                "as much. Reinstall it with numpy present: `uv sync --reinstall-package pybullet`, or "
                "`pip install --no-build-isolation pybullet` after `pip install numpy setuptools wheel`.",
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
