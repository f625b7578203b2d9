"""Runs: planning, extraction and reading. Reading needs neither a simulator nor a model."""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction, ask_run, extract_run, prepare, prepare_asks
    from probe_kit.extract.own_environments.contract import EnvEpisode, OwnEnvironment, Step
    from probe_kit.extract.own_environments.env_source import EnvSource
    from probe_kit.extract.own_environments.source_contract import check_environment
    from probe_kit.extract.recordings.lerobot_source import LeRobotSource
    from probe_kit.extract.settings import AskSettings, ExtractSettings
    from probe_kit.extract.store.copying import copy_run
    from probe_kit.extract.store.exports.export import export_run
    from probe_kit.extract.store.integrity.audit import Audit, verify_run
    from probe_kit.extract.store.label import label_run
    from probe_kit.extract.store.locations.locate import locate
    from probe_kit.extract.store.locations.location import Location
    from probe_kit.extract.store.recorded.action_errors import ActionErrors, compare_actions
    from probe_kit.extract.store.run import Run, open_run
    from probe_kit.extract.store.sealing import seal
    from probe_kit.extract.vqa.templates import TEMPLATES

__all__ = [
    "TEMPLATES",
    "ActionErrors",
    "AskSettings",
    "Audit",
    "EnvEpisode",
    "EnvSource",
    "ExtractSettings",
    "Extraction",
    "LeRobotSource",
    "Location",
    "OwnEnvironment",
    "Run",
    "Step",
    "ask_run",
    "check_environment",
    "compare_actions",
    "copy_run",
    "export_run",
    "extract_run",
    "label_run",
    "locate",
    "open_run",
    "prepare",
    "prepare_asks",
    "seal",
    "verify_run",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "TEMPLATES": "vqa.templates",
        "AskSettings": "settings",
        "ExtractSettings": "settings",
        "Extraction": "extraction",
        "EnvEpisode": "own_environments.contract",
        "EnvSource": "own_environments.env_source",
        "OwnEnvironment": "own_environments.contract",
        "Step": "own_environments.contract",
        "check_environment": "own_environments.source_contract",
        "LeRobotSource": "recordings.lerobot_source",
        "ActionErrors": "store.recorded.action_errors",
        "compare_actions": "store.recorded.action_errors",
        "copy_run": "store.copying",
        "export_run": "store.exports.export",
        "ask_run": "extraction",
        "extract_run": "extraction",
        "prepare": "extraction",
        "prepare_asks": "extraction",
        "Location": "store.locations.location",
        "locate": "store.locations.locate",
        "Run": "store.run",
        "open_run": "store.run",
        "label_run": "store.label",
        "seal": "store.sealing",
        "Audit": "store.integrity.audit",
        "verify_run": "store.integrity.audit",
    },
)
