"""Comparison of a stored run with the cell in whose folder it lies: settings, weights, wordings and suite.

A folder's name says what should lie there. No number is taken before the content says the same.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

from probe_kit.errors import SettingsMismatchError
from probe_kit.hashing import canonical_json
from probe_kit.hooks.checkpoints.checkpoint import COMMIT_DIGITS, is_on_hub, without_revision
from probe_kit.runs.growth import flat_settings
from probe_kit.study.cells import Cell

if TYPE_CHECKING:
    from probe_kit.runs import Run

_OF_LOADED_MODEL = {"dtype", "weights_sha256", "execute", "captured_calls", "policy", "begun", "zeros_for"}
"""Settings of a run that the loaded model decides where the file leaves them open."""
_MOST_SHOWN = 3


def check_run_of_cell(
    run: "Run", cell: Cell, cells: Sequence[Cell], settings_sha256: str | None, file: object
) -> None:
    """Raise SettingsMismatchError unless `run` is the run of `cell`.

    cells: of the study, to name the one that the run belongs to. settings_sha256: hash of the settings that the
    ledger or the archive noted for the cell, which holds the weights' hash; None without such a record. file: of
    the study, for the message.
    """
    problems = list(differences(run, cell))
    if not problems and settings_sha256 not in (None, run.settings_sha256):
        problems = [f"settings and weights hash {run.settings_sha256[:12]}, noted {str(settings_sha256)[:12]}"]
    if not problems:
        return
    other = next((one for one in cells if one.name != cell.name and not any(differences(run, one))), None)
    whose = "" if other is None else f" It is a run of {other.name}."
    more = f" and {len(problems) - _MOST_SHOWN} more" if len(problems) > _MOST_SHOWN else ""
    raise SettingsMismatchError(
        f"{run.location} should hold the run of {cell.name}, and holds another one: "
        f"{'; '.join(problems[:_MOST_SHOWN])}{more}.{whose} Move each folder back to its own name, or remove this "
        f"one and run `probe-kit study run {file}`"
    )


def check_same_items(runs: Sequence["Run"]) -> None:
    """Raise SettingsMismatchError for two runs that hold different items under one id, naming both runs."""
    contents = [dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True)) for run in runs]
    for (one, first), (other, second) in combinations(zip(runs, contents, strict=True), 2):
        changed = [name for name in first if name in second and first[name] != second[name]]
        if changed and one.suite.partition("#")[0] == other.suite.partition("#")[0]:
            raise SettingsMismatchError(
                f"{one.location} and {other.location} hold different items as {changed[0]!r} "
                f"({len(changed)} in all): their suites have one name and version and other content. Play both "
                "with one suite, or give the changed suite another version"
            )


def differences(run: "Run", cell: Cell) -> Iterator[str]:
    """The settings in which a run is not one of `cell`, in words, stored value first."""
    stored, expected = flat_settings(run.root.own_settings), flat_settings(_expected(cell))
    for name in sorted(stored | expected):
        is_open = name.partition(".")[0] in _OF_LOADED_MODEL
        if name in expected or not is_open:
            yield from _different(name, stored.get(name), expected.get(name))
    yield from _different("wordings", list(run.wordings), list(cell.settings.wordings or ()))
    yield from _other_weights(run, cell)
    yield from _other_items(run, cell.suite.contents)


def _expected(cell: Cell) -> dict[str, Any]:
    """The settings that a run of the cell has whatever model is loaded, as plain values.

    What the file leaves to the model is absent. So is the suite where it is not here.
    """
    settings = cell.settings
    decided = {
        name: value
        for name, value in settings.identity().items()
        if name != "dtype" and not (name in _OF_LOADED_MODEL and value in (None, "all"))
    }
    name, _, version = cell.suite.identity.rpartition("@")
    expected = {
        **decided,
        "scene": settings.scene.to_json(),
        "suite": {"name": name, "version": version},
    }
    plain: dict[str, Any] = json.loads(canonical_json(expected))
    return plain


def _different(name: str, stored: Any, expected: Any) -> Iterator[str]:
    if stored != expected:
        yield f"{name}: stored {_short(stored)}, expected {_short(expected)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _other_weights(run: "Run", cell: Cell) -> Iterator[str]:
    """The seed of random weights, or the hub id, as the process that loaded them recorded it.

    A card has the commit of a hub id. A file may name a branch or nothing: then repository and folder count.
    """
    if not run.commits():
        return
    card: Mapping[str, Any] = run.certificate.get("policy") or {}
    if cell.settings.model.random_weights and "weights_seed" in card:
        yield from _different("weights_seed", card["weights_seed"], cell.settings.model.weights_seed)
    stored, expected = str(card.get("checkpoint")), str(cell.settings.model.checkpoint)
    if is_on_hub(stored) and is_on_hub(expected):  # a folder may have been moved, and is bound by its hash
        has_commit = len(expected.partition("@")[2]) == COMMIT_DIGITS
        names = (name if has_commit else without_revision(name) for name in (stored, expected))
        yield from _different("checkpoint", *names)


def _other_items(run: "Run", contents: Mapping[str, str]) -> Iterator[str]:
    """Items that the suite has with other content, or has not. contents: hash by id; empty where unknown."""
    if not contents:
        return
    hashes = dict(zip(run.items["item_id"], run.items["content_sha256"], strict=True))
    changed = [name for name, content in hashes.items() if contents.get(name) != content]
    if changed:
        state = "changed" if changed[0] in contents else "is not in the suite"
        yield f"item {changed[0]!r} {state} since it was played ({len(changed)} of {len(hashes)} items)"
