"""The interactive viewer of runs: payloads, a folder that opens without a server, and a server on loopback."""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.view.export import write_viewer

__all__ = ["write_viewer"]

# `probe-kit --help` must load neither pandas nor zarr.
__getattr__, __dir__ = lazy_names(__name__, {"write_viewer": "export"})
