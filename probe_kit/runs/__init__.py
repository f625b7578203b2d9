"""Runs: where they are stored, their records and arrays, and how these are written, read, verified and exported.

Reading needs neither a simulator nor a model.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.runs.action_errors import ActionErrors, compare_actions
    from probe_kit.runs.contents import copy_run
    from probe_kit.runs.export import export_run
    from probe_kit.runs.root import label_run
    from probe_kit.runs.run import Run, open_run
    from probe_kit.runs.store import Location, locate
    from probe_kit.runs.verify import Audit, seal, verify_run

__all__ = [
    "ActionErrors",
    "Audit",
    "Location",
    "Run",
    "compare_actions",
    "copy_run",
    "export_run",
    "label_run",
    "locate",
    "open_run",
    "seal",
    "verify_run",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "ActionErrors": "action_errors",
        "Audit": "verify",
        "Location": "store",
        "Run": "run",
        "compare_actions": "action_errors",
        "copy_run": "contents",
        "export_run": "export",
        "label_run": "root",
        "locate": "store",
        "open_run": "run",
        "seal": "verify",
        "verify_run": "verify",
    },
)
