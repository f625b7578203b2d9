"""Comparison of a stored run with the cell in whose folder it lies: settings, weights, wordings and suite.

A folder's name says which run should lie in it. No number is taken before the content says the same.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

from probe_kit.errors import SettingsMismatchError
from probe_kit.hashing import canonical_json
from probe_kit.hooks.checkpoints.checkpoint import COMMIT_DIGITS, is_on_hub, without_revision
from probe_kit.runs.growth import flat_settings
from probe_kit.study.cells import Cell, checkpoint_stamp

if TYPE_CHECKING:
    from probe_kit.runs import Run

_OF_LOADED_MODEL = {"dtype", "weights_sha256", "execute", "captured_calls", "policy", "begun", "zeros_for"}
"""Settings of a run that the loaded model decides where the file leaves them open."""
_MOST_PRINTED = 3
Change = tuple[str, Any, Any]
"""Path of a setting, its stored value, and the value that the cell has."""


def check_run_of_cell(
    run: "Run", cell: Cell, cells: Sequence[Cell], settings_sha256: str | None, file: object
) -> None:
    """Raise SettingsMismatchError unless `run` is the run of `cell`.

    cells: of the study, to name the one that the run belongs to. settings_sha256: hash of the run's settings by
    the record of an archive, which holds the weights' hash; None without one. file: of the study, for the message.
    """
    problems = list(differences(run, cell))
    if not problems and settings_sha256 not in (None, run.settings_sha256):
        problems = [f"settings and weights hash {run.settings_sha256[:12]}, noted {str(settings_sha256)[:12]}"]
    if not problems:
        return
    other = next((each for each in cells if each.name != cell.name and not any(differences(run, each))), None)
    owner = "" if other is None else f" It is a run of {other.name}."
    more = f" and {len(problems) - _MOST_PRINTED} more" if len(problems) > _MOST_PRINTED else ""
    raise SettingsMismatchError(
        f"{run.location} should hold the run of {cell.name}, and holds another one: "
        f"{'; '.join(problems[:_MOST_PRINTED])}{more}.{owner} Move each folder back to its own name, or remove "
        f"this one and run `probe-kit study run {file}`"
    )


def check_same_items(runs: Sequence["Run"]) -> None:
    """Raise SettingsMismatchError for two runs that hold different items under one id, naming both runs."""
    contents = [dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True)) for run in runs]
    for (run, items), (other, other_items) in combinations(zip(runs, contents, strict=True), 2):
        changed = [name for name in items if name in other_items and items[name] != other_items[name]]
        if changed and run.suite.partition("#")[0] == other.suite.partition("#")[0]:
            raise SettingsMismatchError(
                f"{run.location} and {other.location} hold different items as {changed[0]!r} "
                f"({len(changed)} in all): their suites have one name and version and other content. Play both "
                "with one suite, or give the changed suite another version"
            )


def check_same_weights(runs: Sequence[tuple[Cell, "Run"]]) -> None:
    """Raise SettingsMismatchError for two runs of one model that were played with different weights.

    A model that acts and answers may load other parts of its checkpoint for either.
    """
    first: dict[tuple[str, bool], Run] = {}
    for cell, run in runs:
        other = first.setdefault((cell.model, cell.asks), run)
        if other.weights_sha256 != run.weights_sha256:
            raise SettingsMismatchError(
                f"{other.location} and {run.location} are runs of {cell.model!r} with different weights "
                f"({str(other.weights_sha256)[:12]} and {str(run.weights_sha256)[:12]}). The checkpoint was "
                "changed in between, or a folder was moved: remove one of them, and run the study again"
            )


def differences(run: "Run", cell: Cell) -> Iterator[str]:
    """Yield the settings in which a run is not one of `cell`, in words, stored value first."""
    for change in changed_settings(run.root.own_settings, cell):
        yield _in_words(*change)
    yield from _different("wordings", list(run.wordings), list(cell.settings.wordings or ()))
    yield from _other_weights(run, cell)
    yield from _other_items(run, cell.suite.contents)


def changed_settings(own_settings: Mapping[str, Any], cell: Cell) -> Iterator[Change]:
    """Yield the settings of a stored run that `cell` has otherwise."""
    stored, expected = flat_settings(own_settings), flat_settings(_expected(cell))
    for name in sorted(stored | expected):
        is_open = name.partition(".")[0] in _OF_LOADED_MODEL
        if (name in expected or not is_open) and stored.get(name) != expected.get(name):
            yield name, stored.get(name), expected.get(name)


def _expected(cell: Cell) -> dict[str, Any]:
    """Return the settings that a run of the cell has whatever model is loaded, as plain values.

    What the file leaves to the model is absent.
    """
    settings = cell.settings
    decided = {
        name: value
        for name, value in settings.identity().items()
        if name != "dtype" and not (name in _OF_LOADED_MODEL and value in (None, "all"))
    }
    name, _, version = cell.suite.identity.rpartition("@")
    expected = {**decided, "scene": settings.scene.to_json(), "suite": {"name": name, "version": version}}
    plain: dict[str, Any] = json.loads(canonical_json(expected))
    return plain


def _different(name: str, stored: Any, expected: Any) -> Iterator[str]:
    if stored != expected:
        yield _in_words(name, stored, expected)


def _in_words(name: str, stored: Any, expected: Any) -> str:
    return f"{name}: stored {_short(stored)}, expected {_short(expected)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _other_weights(run: "Run", cell: Cell) -> Iterator[str]:
    """Yield the seed of random weights, or the checkpoint, as the process that loaded them recorded it.

    A card has the commit of a hub id. A file may name a branch or nothing: then repository and folder count. The
    folder of a local checkpoint may have been moved since. If it is still at its old path, and is another one than
    the file's by name, size and time of its files, the run is another checkpoint's.
    """
    if not run.commits():
        return
    card: Mapping[str, Any] = run.certificate.get("policy") or {}
    if cell.settings.model.random_weights and "weights_seed" in card:
        yield from _different("weights_seed", card["weights_seed"], cell.settings.model.weights_seed)
    stored, expected = str(card.get("checkpoint")), str(cell.settings.model.checkpoint)
    if is_on_hub(stored) and is_on_hub(expected):
        has_commit = len(expected.partition("@")[2]) == COMMIT_DIGITS
        names = (name if has_commit else without_revision(name) for name in (stored, expected))
        yield from _different("checkpoint", *names)
    stamps = [checkpoint_stamp(stored), checkpoint_stamp(expected)]
    if all(isinstance(stamp, list) for stamp in stamps) and stamps[0] != stamps[1]:
        yield _in_words("checkpoint", stored, expected)


def _other_items(run: "Run", contents: Mapping[str, str]) -> Iterator[str]:
    """Yield the items that the suite has with other content, or lacks. contents: hash by id; empty if unknown."""
    if not contents:
        return
    hashes = dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True))
    changed = [name for name, content in hashes.items() if contents.get(name) != content]
    if changed:
        state = "changed" if changed[0] in contents else "is not in the suite"
        yield f"item {changed[0]!r} {state} since it was played ({len(changed)} of {len(hashes)} items)"
