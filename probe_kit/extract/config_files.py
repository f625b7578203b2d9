"""Files of settings for `extract --config`: written by `--print-config`, or those of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import UsageError
from probe_kit.runs.layout import RUN_FILE

CONFIG = "config"
"""The part of a run's settings that holds them as they were requested, by part."""


def read_config(path: Path) -> Mapping[str, Any]:
    """Settings by part, from a file of `--print-config`, or from a run that its folder or `run.json` names.

    Raises UsageError for a file that holds neither, and for a run without its settings.
    """
    if path.is_dir() or path.name == RUN_FILE:
        from probe_kit.runs.run import open_run

        folder = path if path.is_dir() else path.parent
        settings = open_run(folder, allow_partial=True).settings
        if CONFIG not in settings:
            raise UsageError(f"{folder} does not say with which settings it was requested; type the options again")
        requested: Mapping[str, Any] = settings[CONFIG]
        return requested
    return read_json_object(path, UsageError, "Write one with `probe-kit extract … --print-config`")
