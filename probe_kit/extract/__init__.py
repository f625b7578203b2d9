"""Extraction: sources, settings, and the play of a model that makes a run."""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.extract.extraction import Extraction, ask_run, extract_run, prepare, prepare_asks
    from probe_kit.extract.prompts import TEMPLATES
    from probe_kit.extract.settings import AskSettings, ExtractSettings
    from probe_kit.extract.sources.environment import EnvEpisode, EnvironmentSettings, OwnEnvironment, Step
    from probe_kit.extract.sources.environment_check import check_environment
    from probe_kit.extract.sources.pictures import PictureFolder
    from probe_kit.extract.sources.recording import LeRobotSource

__all__ = [
    "TEMPLATES",
    "AskSettings",
    "EnvEpisode",
    "EnvironmentSettings",
    "ExtractSettings",
    "Extraction",
    "LeRobotSource",
    "OwnEnvironment",
    "PictureFolder",
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
        "TEMPLATES": "prompts",
        "AskSettings": "settings",
        "ExtractSettings": "settings",
        "Extraction": "extraction",
        "EnvEpisode": "sources.environment",
        "EnvironmentSettings": "sources.environment",
        "OwnEnvironment": "sources.environment",
        "Step": "sources.environment",
        "check_environment": "sources.environment_check",
        "LeRobotSource": "sources.recording",
        "PictureFolder": "sources.pictures",
        "ask_run": "extraction",
        "extract_run": "extraction",
        "prepare": "extraction",
        "prepare_asks": "extraction",
    },
)
