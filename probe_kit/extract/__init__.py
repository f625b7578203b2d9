"""Runs: plan them, extract them, read them. Reading needs neither a simulator nor a model."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction, extract_run, prepare
    from probe_kit.extract.run import Run, open_run
    from probe_kit.extract.settings import ExtractSettings

__all__ = ["ExtractSettings", "Extraction", "Run", "extract_run", "open_run", "prepare"]

_LAZY = {
    "ExtractSettings": "settings",
    "Extraction": "extraction",
    "extract_run": "extraction",
    "prepare": "extraction",
    "Run": "run",
    "open_run": "run",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"probe_kit.extract.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
