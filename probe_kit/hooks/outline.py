"""A model without numbers, of the configuration that is here: for plans, which read no weights. No torch."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.bounded_files import load_json
from probe_kit.errors import ProbeKitError
from probe_kit.hooks.checkpoints.checkpoint import (
    ADAPTER_FILE,
    NotCachedError,
    cached_folder,
    is_on_hub,
    missing_bytes,
    missing_weights,
    without_network,
)
from probe_kit.hooks.checkpoints.folders import ADAPTER_WEIGHTS, file_state, has_configuration
from probe_kit.hooks.checkpoints.third_party import in_words

if TYPE_CHECKING:
    from probe_kit.hooks.contract.model import Model

_OUTLINES: dict[tuple[object, ...], "Outline"] = {}


@dataclass(frozen=True)
class Outline:
    """A model on the meta device, with streams, roles and units but without numbers.

    Attributes:
        model: The model; None where it could not be built.
        reason: The reason why it could not; "" for a model that was built.
        complete: Whether its weights are here too, so that no file of statistics can be missing.
    """

    model: "Model | None"
    reason: str = ""
    complete: bool = True

    @property
    def checkpoint(self) -> str:
        """Folder or hub id, as the model's card has it."""
        return "" if self.model is None else self.model.card.checkpoint

    def misfit(self) -> str | None:
        """Return why a policy cannot move an arm here, as far as the files that are here say; None if it can."""
        from probe_kit.hooks.contract.model import Policy

        if not isinstance(self.model, Policy):
            return None
        return self.model.embodiment_mismatch() if self.complete else self.model.configured_mismatch()


def outline_of(
    name: str, load: Any, location: str, folder: Path, dtype: str | None, options: Mapping[str, Any]
) -> Outline:
    """The outline of the checkpoint at `location`, whose configuration lies in `folder`.

    No network is asked and no weights are read. Raises what loading raises for a checkpoint in a folder.

    Args:
        name: Name of the family.
        load: Loader of the family.
        location: Folder or hub id, as the loader gets it.
        folder: The folder of the configuration, whose state is part of the key of the cache.
        dtype: The dtype asked for; None leaves the choice to the loader.
        options: The options as the loader gets them.
    """
    complete = is_complete(location)
    key = (name, location, dtype, repr(sorted(options.items())), complete, file_state(folder))
    if key in _OUTLINES:
        return _OUTLINES[key]
    outline = _build_outline(load, location, dtype, options, complete)
    if outline.model is not None:  # what another repository lacks may arrive
        _OUTLINES[key] = outline
    return outline


def _build_outline(
    load: Any, location: str, dtype: str | None, options: Mapping[str, Any], complete: bool
) -> Outline:
    from probe_kit.models.building import sizes_only

    try:
        with without_network(), sizes_only():
            return Outline(load(location, "meta", dtype, True, **options), complete=complete)
    except ProbeKitError as error:
        if not is_on_hub(location) and not _lacks_repository(error):
            raise
        return Outline(None, str(error), complete)
    except Exception as error:  # noqa: BLE001 - a network may need numbers while it is built
        return Outline(None, in_words(error), complete)


def _lacks_repository(error: BaseException | None) -> bool:
    """Whether another repository of the hub that the checkpoint names is not in the cache."""
    while error is not None:
        if isinstance(error, NotCachedError):
            return True
        error = error.__cause__
    return False


def configuration_folder(location: str | None) -> Path | None:
    """The folder, or that of the hub's cache, with the configuration of a checkpoint; None where it is not here.

    Asks no network.
    """
    folder = None if location is None else _local(location)
    if location is None or folder is None:
        return None
    if not is_on_hub(location):
        return folder if folder.exists() else None
    return folder if has_configuration(folder) or (folder / ADAPTER_FILE).is_file() else None


def _local(location: str) -> Path | None:
    """The folder that a path names, or that the hub's cache has of a hub id; None where it has nothing."""
    return cached_folder(location) if is_on_hub(location) else Path(location).expanduser()


def is_complete(location: str) -> bool:
    """Whether a checkpoint with its weights, and those of an adapter's base, is here; asks no network."""
    folder = _local(location)
    if folder is None:
        return False
    if (base := _base(folder)) is None:
        return _has_weights(location)
    return any((folder / name).is_file() for name in ADAPTER_WEIGHTS) and _has_weights(base)


def _has_weights(location: str) -> bool:
    """Whether the hub's cache has the weights of a hub id; those of a path are left to its loading."""
    if not is_on_hub(location):
        return True
    folder = cached_folder(location)
    return folder is not None and not missing_weights(folder)


def bytes_to_fetch(location: str) -> int | None:
    """Return the bytes of weights that the cache lacks, of an adapter its base's; None where no index says it."""
    folder = _local(location)
    if folder is not None and (base := _base(folder)) is not None:
        folder = _local(base)
    return None if folder is None else missing_bytes(folder)


def _base(folder: Path) -> str | None:
    """The base of the adapter in a folder, as path or hub id; None where there is no adapter.

    It is never an adapter itself: loading refuses such a base.
    """
    try:
        base = str(load_json(folder / ADAPTER_FILE)["base_model_name_or_path"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sibling = folder / base
    return str(sibling) if sibling.is_dir() else base
