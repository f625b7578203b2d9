"""Import of optional libraries, with an error that names the missing extra."""

from importlib import import_module
from typing import Any

from probe_kit._system.installing import install_command
from probe_kit.errors import MissingExtraError


def require(module: str, extra: str) -> Any:
    """The module, or MissingExtraError naming the extra of probe-kit that brings it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs {module.partition('.')[0]}, which is not installed; `{install_command(extra)}`"
        ) from error
