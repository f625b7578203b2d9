"""Runs: plan them, extract them, read them. Reading needs neither a simulator nor a model."""

from typing import TYPE_CHECKING

from probe_kit.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.extract.export import export_run
    from probe_kit.extract.extraction import Extraction, extract_run, prepare
    from probe_kit.extract.location import Location, locate
    from probe_kit.extract.run import Run, open_run
    from probe_kit.extract.sealing import seal
    from probe_kit.extract.settings import ExtractSettings
    from probe_kit.extract.verify import Verification, verify_run

__all__ = [
    "ExtractSettings",
    "Extraction",
    "Location",
    "Run",
    "Verification",
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
        "export_run": "export",
        "extract_run": "extraction",
        "prepare": "extraction",
        "Location": "location",
        "locate": "location",
        "Run": "run",
        "open_run": "run",
        "seal": "sealing",
        "Verification": "verify",
        "verify_run": "verify",
    },
)
