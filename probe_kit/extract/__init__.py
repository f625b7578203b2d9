"""Runs: plan them, extract them, read them. Reading needs neither a simulator nor a model."""

from typing import TYPE_CHECKING

from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction, extract_run, prepare
    from probe_kit.extract.settings import ExtractSettings
    from probe_kit.extract.store.audit import Audit, verify_run
    from probe_kit.extract.store.export import export_run
    from probe_kit.extract.store.locate import locate
    from probe_kit.extract.store.location import Location
    from probe_kit.extract.store.run import Run, open_run
    from probe_kit.extract.store.sealing import seal

__all__ = [
    "Audit",
    "ExtractSettings",
    "Extraction",
    "Location",
    "Run",
    "export_run",
    "extract_run",
    "locate",
    "open_run",
    "prepare",
    "seal",
    "verify_run",
]

__getattr__ = lazy_names(
    __name__,
    {
        "ExtractSettings": "settings",
        "Extraction": "extraction",
        "export_run": "store.export",
        "extract_run": "extraction",
        "prepare": "extraction",
        "Location": "store.location",
        "locate": "store.locate",
        "Run": "store.run",
        "open_run": "store.run",
        "seal": "store.sealing",
        "Audit": "store.audit",
        "verify_run": "store.audit",
    },
)
