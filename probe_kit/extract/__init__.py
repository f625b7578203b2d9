"""Extraction: sources, settings, and the play of a model that makes a run."""

from typing import TYPE_CHECKING

from probe_kit._system.lazy import lazy_names

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction, ask_run, extract_run, prepare, prepare_asks
    from probe_kit.extract.own_environments.contract import EnvEpisode, OwnEnvironment, Step
    from probe_kit.extract.own_environments.source_contract import check_environment
    from probe_kit.extract.settings import AskSettings, ExtractSettings
    from probe_kit.extract.sources.environment import EnvSource
    from probe_kit.extract.sources.recording import LeRobotSource
    from probe_kit.extract.vqa.templates import TEMPLATES

__all__ = [
    "TEMPLATES",
    "AskSettings",
    "EnvEpisode",
    "EnvSource",
    "ExtractSettings",
    "Extraction",
    "LeRobotSource",
    "OwnEnvironment",
    "Step",
    "ask_run",
    "check_environment",
    "extract_run",
    "prepare",
    "prepare_asks",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "TEMPLATES": "vqa.templates",
        "AskSettings": "settings",
        "ExtractSettings": "settings",
        "Extraction": "extraction",
        "EnvEpisode": "own_environments.contract",
        "EnvSource": "sources.environment",
        "OwnEnvironment": "own_environments.contract",
        "Step": "own_environments.contract",
        "check_environment": "own_environments.source_contract",
        "LeRobotSource": "sources.recording",
        "ask_run": "extraction",
        "extract_run": "extraction",
        "prepare": "extraction",
        "prepare_asks": "extraction",
    },
)
