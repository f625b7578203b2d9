"""Checks of an extraction that run before its model is loaded."""

import json
import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.installing import install_command
from probe_kit.errors import DiskSpaceError, MissingExtraError, UsageError
from probe_kit.extract.plan import plan_episodes, plan_rows, suite_name
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.vqa.phrases import phrases
from probe_kit.hashing import canonical_json
from probe_kit.runs.growth import check_other_settings, further_rows
from probe_kit.runs.layout import RUN_FILE

if TYPE_CHECKING:
    from probe_kit.runs.location import Location
    from probe_kit.suite import Suite

_OF_THE_CHECKPOINT = ("dtype", "execute", "random_weights", "captured_calls")
"""Settings whose value the loaded model may decide."""


def check_model(settings: Settings, scripted: tuple[str, ...], fetch: bool = True) -> None:
    """Refuse a model, option, device or checkpoint that cannot be used; imports no torch.

    scripted: names of models that are none. fetch: see `Family.check`. Raises UnknownModelError and what
    `Family.check` raises.
    """
    if settings.machine.ray is not None and find_spec("ray") is None:
        raise MissingExtraError(f"--ray needs ray, which is not installed; `{install_command('ray')}`")
    from probe_kit.hooks.registry import find_family, known_families

    asked = isinstance(settings, AskSettings)
    if asked and (settings.model.family in scripted or not find_family(settings.model.family, scripted).reads):
        reads = [name for name, family in known_families().items() if family.reads]
        raise UsageError(
            f"{settings.model.family} acts and does not answer questions; those that do: {', '.join(reads)}"
        )
    if settings.model.family in scripted:
        return

    family = find_family(settings.model.family, scripted)
    if not asked and not family.acts:
        raise UsageError(
            f"{settings.model.family} answers and does not act; use `probe-kit ask`, or a model that acts"
        )
    if (
        isinstance(settings, ExtractSettings)
        and isinstance(settings.source, SceneSettings)
        and not settings.task.capture_only
    ):
        family.check_acting(settings.model.checkpoint, settings.model.options)
    model = settings.model
    # Elsewhere there may be other devices than here.
    device = "cpu" if settings.machine.elsewhere else settings.machine.device
    family.check(
        model.checkpoint, device, model.dtype, model.random_weights, model.options, model.weights_seed, fetch,
    )  # fmt: skip


def check_words(settings: Settings, texts: Iterable[str], scripted: tuple[str, ...]) -> None:
    """Refuse instructions, or objects of questions, with words that the model does not know; imports no torch.

    Raises InstructionError naming the words.
    """
    from probe_kit.hooks.registry import find_family

    if settings.model.family not in scripted:
        find_family(settings.model.family, scripted).check_words(texts, settings.model.checkpoint)


def check_place(settings: Settings, suite: "Suite", location: "Location") -> None:
    """Refuse a place that cannot be written, or where a run lies that has other settings or cannot grow so.

    Only what is known without the model is compared; the writer compares all of it.
    Raises UsageError, DiskSpaceError for a read-only disk, SettingsMismatchError, or RunDamagedError if what lies
    there was changed.
    """
    from probe_kit.runs.root import read_root

    check_writable(location)
    with location.in_words():
        if not location.exists(RUN_FILE):
            return
        root = read_root(location)
        root.check_continuable()
        stored = root.own_settings
        known = {name: value for name, value in _known_settings(settings, suite).items() if name in stored}
        check_other_settings({name: stored[name] for name in known}, known, str(location))
        episodes = plan_episodes(suite, settings.seed, settings.wordings, asked_objects(settings, suite))
        if root.plan:
            further_rows(root.plan, plan_rows(suite, episodes), str(location))


def _known_settings(settings: Settings, suite: "Suite") -> dict[str, Any]:
    decided = {name: value for name, value in settings.identity().items() if name not in _OF_THE_CHECKPOINT}
    known = {
        **decided,
        "suite": suite_name(suite),
        "scene": settings.scene.to_json(),
    }
    as_stored: dict[str, Any] = json.loads(canonical_json(known))
    return as_stored


def asked_objects(settings: Settings, suite: "Suite") -> Mapping[str, str]:
    """By item, what a question asks for where this is not the object of the instruction; empty otherwise.

    Raises UsageError for items without such a phrase.
    """
    if not isinstance(settings, AskSettings):
        return {}
    named = phrases(suite, settings.task.query, settings.seed)
    return {} if settings.task.query == "target" else {item: phrase.with_article for item, phrase in named.items()}


def check_writable(location: "Location") -> None:
    """Raise UsageError for a place that cannot be written, DiskSpaceError for a read-only disk."""
    if "://" in location.address:
        return  # a bucket says so itself, and creating anything there is no check
    place = Path(location.address)
    there = next(folder for folder in (place, *place.parents) if folder.exists())
    if not there.is_dir():
        raise UsageError(f"{location} cannot be used: {there} is not a folder. Give another path")
    if os.statvfs(there).f_flag & os.ST_RDONLY:
        raise DiskSpaceError(f"{location} cannot be used: the disk of {there} is read-only. Choose another --out")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UsageError(f"{location} cannot be used: {there} cannot be written. Give another path")
