"""The kinds of sources: those of probe_kit, and third-party ones from entry points.

A third party's module of settings is imported with the command line, whose options it adds. It must not import
torch, and names the module of its `Source` in `opens`.
"""

import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from probe_kit._system.imports import entry_points
from probe_kit._terminal.field_options import options_of
from probe_kit.errors import UsageError
from probe_kit.extract.sources.environment import EnvironmentSettings
from probe_kit.extract.sources.pictures import PictureFolder
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.extract.sources.source import SourceSettings

ENTRY_POINTS = "probe_kit.sources"
OWN: tuple[type[SourceSettings], ...] = (SceneSettings, LeRobotSource, EnvironmentSettings, PictureFolder)
SERVED: tuple[type[SourceSettings], ...] = (ServedSettings,)
"""The sources of other commands than `extract` and `ask`, which do not offer their options."""


class BrokenSourceWarning(UserWarning):
    """A warning that a third party's source cannot be used; all others can."""


def _third_party() -> Iterator[type[SourceSettings]]:
    """Yield the settings that entry points name; warn of each that cannot be used."""
    options = {option.parameter for kind in OWN for option in kind.command_options().values()}
    kinds = {kind.model_fields["kind"].default for kind in (*OWN, *SERVED)}
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            settings = entry.load()
            problem = _problem(settings, kinds, options)
        except Exception as error:  # noqa: BLE001 - of code that is not ours
            problem = f"its import fails with {type(error).__name__}: {error}"
        if problem:
            warnings.warn(
                f"the source {entry.name} ({entry.value}) is left out: {problem}. Correct it, or remove "
                "its package",
                BrokenSourceWarning,
                stacklevel=2,
            )
            continue
        options |= {option.parameter for option in options_of(settings)}
        kinds.add(settings.model_fields["kind"].default)
        yield settings


def _problem(settings: Any, kinds: set[str], options: set[str]) -> str:
    """Return why an entry point names no further source; empty if it does."""
    if not (isinstance(settings, type) and issubclass(settings, SourceSettings)):
        return "it is no class derived from SourceSettings"
    if (kind := settings.model_fields["kind"].default) in kinds or not isinstance(kind, str):
        return f"its kind is {kind!r}; expected a name that no other source has ({', '.join(sorted(kinds))})"
    if not settings.opens or not settings.command:
        return "it lacks `opens` or `command`"
    parameters = {option.parameter for option in options_of(settings)}
    if not parameters or parameters & options:
        shared = ", ".join(sorted(parameters & options)) or "none"
        return f"of its options other sources have {shared}; expected at least one option, and names of its own"
    return ""


SOURCES: tuple[type[SourceSettings], ...] = (*OWN, *_third_party())
"""The settings of the sources of `extract` and `ask`; the scene, which no option names, comes first."""


def kinds_typed(typed: Collection[str]) -> dict[type[SourceSettings], str]:
    """Return the kinds whose first option is among typed parameters, with the option's flag; never the scene."""
    first = {kind: next(options_of(kind)) for kind in SOURCES[1:]}
    return {kind: option.flag for kind, option in first.items() if option.parameter in typed}


def kind_of(values: Mapping[str, Any]) -> type[SourceSettings]:
    """Return the class of a source's settings from their part of a file. Raises UsageError for an unknown kind."""
    kinds = {kind.model_fields["kind"].default: kind for kind in (*SOURCES, *SERVED)}
    if values.get("kind") not in kinds:
        raise UsageError(f"source.kind is {values.get('kind')!r}; expected one of {', '.join(kinds)}")
    return kinds[values["kind"]]
