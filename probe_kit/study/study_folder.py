"""The folder of a study: which run in it is that of a cell, and what its model was when it was played.

A run's folder is named by settings and by the content of the checkpoint. Each run of a network leaves a record
`OUT/_checkpoints/<run>+<paths>.json`: path and content of its files, and the weights that it was played with. So a
study can be read without the files, and a run in the folder of another one is noticed wherever files lie.

Studies of earlier versions have no records, and their folders are named by name, size and time of files. They are
looked up by that name, or, without the files, by the settings and the path of the checkpoint in the runs.
"""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from probe_kit.errors import ProbeKitError, SettingsMismatchError
from probe_kit.extract.parts import is_here
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.hooks.checkpoints.checkpoint import is_on_hub
from probe_kit.runs import open_run
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.records import Record
from probe_kit.runs.root import read_root
from probe_kit.runs.store import Location, locate
from probe_kit.runs.writer import flat_settings
from probe_kit.study.cells import CHECKPOINT, KEY_DIGITS, PlannedRun
from probe_kit.study.file_contents import content_of, former_stamp

RECORDS = "_checkpoints"
"""The folder of the records, which has the name of no model."""
_ADVICE = "Restore it from a copy; or delete it, and the run is not compared with what was played"
_OF_LOADED_MODEL = {"dtype", "weights_sha256", "execute", "captured_calls", "policy", "begun", "zeros_for"}
"""Settings of a run that the loaded model decides where the file leaves them open."""
Change = tuple[str, Any, Any]
"""Path of a setting, its stored value, and the value that the cell has."""


class PlayedModel(Record):
    """A model as it was when a run of it was played.

    Attributes:
        run: The folder of the run below that of the study.
        model: Name of the model in the file.
        asks: Whether it was asked: a model that acts and answers may load other parts for either.
        paths: Texts of settings that may name files, as `PlannedRun.paths`.
        contents: Hash of the content of those that were files here, by the same names.
        weights_sha256: Hash of the loaded weights.
        policy: Everything else that its numbers depend on, as in the run's settings.
        when: UTC, ISO 8601 with microseconds.
    """

    kind: ClassVar[str] = "record of a played model"
    run: str
    model: str
    asks: bool
    paths: dict[str, str]
    contents: dict[str, str]
    weights_sha256: str
    policy: dict[str, Any]
    when: str

    def same(self, other: "PlayedModel | None") -> bool:
        """Whether both say the same, at whatever time."""
        return other is not None and {**self.content, "when": ""} == {**other.content, "when": ""}


class StudyFolder:
    """The folder or URL in which the runs of a study lie; nothing is read before it is asked for."""

    def __init__(self, out: str) -> None:
        self._out = out.rstrip("/")
        self._contents: dict[str, str | None] = {}
        self._problems: dict[str, str] = {}

    @cached_property
    def _location(self) -> Location:
        return locate(self._out)

    @cached_property
    def _models(self) -> dict[str, PlayedModel]:
        """The records by the names of their files."""
        stored = self._location.read_all(RECORDS, ".json")
        name = f"{self._out}/{RECORDS}"
        return {key: PlayedModel.parse(raw, f"{name}/{key}", _ADVICE) for key, raw in stored.items()}

    def _newest(self, is_meant: Callable[[PlayedModel], bool]) -> PlayedModel | None:
        models = filter(is_meant, self._models.values())
        return max(models, key=lambda model: model.when, default=None)

    # -- content -------------------------------------------------------------------------------------------------

    def contents(self, cell: PlannedRun) -> dict[str, str]:
        """Return the content of the files that settings name, by the names of `PlannedRun.paths`.

        Of files that are not here it is what the last run of the model had under the same path, if that is known.
        """
        contents = self._contents_here(cell)
        for name, text in cell.paths.items():
            if (
                name not in contents
                and (model := self._newest(self._with_path(cell.model, name, text))) is not None
            ):
                contents[name] = model.contents[name]
        return contents

    @staticmethod
    def _with_path(model_name: str, name: str, text: str) -> Callable[[PlayedModel], bool]:
        """Return whether a model was loaded from the file of this text."""
        return lambda model: model.model == model_name and model.paths.get(name) == text and name in model.contents

    def _contents_here(self, cell: PlannedRun, again: bool = False) -> dict[str, str]:
        options = {f"option {name}" for name in cell.settings.model.files()}
        contents = {}
        for name, text in cell.paths.items():
            if name not in {CHECKPOINT, *options} or not is_here(text):
                continue
            if text not in self._contents:
                self._contents[text] = content_of(text)
            content = content_of(text) if again else self._contents[text]
            if content is not None:
                contents[name] = content
        return contents

    # -- keys ----------------------------------------------------------------------------------------------------

    def key(self, cell: PlannedRun) -> str:
        """Return the key of the stored run of a cell, or that of a new run."""
        contents = self.contents(cell)
        key = cell.key_with(contents)
        checkpoint = cell.settings.model.checkpoint
        if not contents and (checkpoint is None or ("://" in self._out and is_on_hub(checkpoint))):
            return key  # which is that of every version; and a bucket is listed object by object
        if not self._has_run(cell, key):
            return self._former_key(cell, contents) or key
        return key

    def _has_run(self, cell: PlannedRun, key: str) -> bool:
        return self._location.exists(f"{cell.folder_of(key)}/{RUN_FILE}")

    def _former_key(self, cell: PlannedRun, contents: Mapping[str, str]) -> str | None:
        """Return the key of a run that an earlier version named; None without one."""
        checkpoint = cell.settings.model.checkpoint
        stamp = former_stamp(checkpoint) if checkpoint is not None and is_here(checkpoint) else None
        if contents and self._has_run(cell, key := cell.key_with({} if stamp is None else {CHECKPOINT: stamp})):
            return key
        keys = self._keys_of_content(cell, contents) if contents else self.keys_of_name(cell)
        runs = defaultdict[str, list[tuple[int, str]]](list)
        for key in keys:
            location = locate(f"{self._out}/{cell.folder_of(key)}")
            try:
                if any(changed_settings(read_root(location).own_settings, cell)):
                    continue
                run = open_run(location, allow_partial=True)
                card = run.certificate.get("policy") or {} if run.commits() else {}
            except ProbeKitError:
                continue
            if not contents and card.get("checkpoint") != checkpoint:
                continue
            if list(run.wordings) == list(cell.settings.wordings or ()):
                runs[str(run.weights_sha256)].append((len(run.commits()), key))
        if len(runs) > 1:
            names = ", ".join(sorted(cell.folder_of(key) for of_weights in runs.values() for _, key in of_weights))
            self._problems[cell.name] = (
                f"{self._out} holds runs of {cell.name} with {len(runs)} different weights, all loaded from "
                f"{checkpoint}, which is not here: {names}. Move all but one of them away"
            )
            return None
        return max((run for of_weights in runs.values() for run in of_weights), default=(0, None))[1]

    def _keys_of_content(self, cell: PlannedRun, contents: Mapping[str, str]) -> list[str]:
        """Return the keys of the cell's name under which runs of these files are recorded."""
        return _keys_in((model.run for model in self._models.values() if self._is_of(model, cell, contents)), cell)

    @staticmethod
    def _is_of(model: PlayedModel, cell: PlannedRun, contents: Mapping[str, str]) -> bool:
        """Whether a model was loaded from files of these contents, with the cell's other options."""
        options = [
            {name: text for name, text in paths.items() if name not in contents}
            for paths in (model.paths, cell.paths)
        ]
        of_cell = (model.model, model.asks, model.contents) == (cell.model, cell.asks, contents)
        return of_cell and options[0] == options[1]

    def keys_of_name(self, cell: PlannedRun) -> list[str]:
        """Return the keys of all stored runs of the cell's name, whatever they hold."""
        if "://" in self._out:
            runs = [key.removesuffix(f"/{RUN_FILE}") for key in self._location.keys(cell.model)]
        else:
            files = Path(self._out).glob(f"{cell.folder_of('')}*/{RUN_FILE}")
            runs = [file.parent.relative_to(self._out).as_posix() for file in files]
        return _keys_in(runs, cell)

    def check_unambiguous(self, cell: PlannedRun) -> None:
        """Raise SettingsMismatchError if several stored runs may be that of a cell."""
        _ = cell.key
        if problem := self._problems.get(cell.name):
            raise SettingsMismatchError(problem)

    def hint(self, cell: PlannedRun) -> str:
        """Return why no run is known to be that of a cell whose checkpoint is not here; empty if it is here."""
        checkpoint = cell.settings.model.checkpoint
        if checkpoint is None or is_on_hub(checkpoint) or CHECKPOINT in self.contents(cell):
            return ""
        models = [model for model in self._models.values() if model.model == cell.model]
        paths = sorted({model.paths[CHECKPOINT] for model in models if CHECKPOINT in model.contents})
        played = f"; runs of {cell.model} were played from {', '.join(paths)}" if paths else ""
        return f"the checkpoint {checkpoint} is not here, and no run is known to be played from it{played}"

    # -- records -------------------------------------------------------------------------------------------------

    def played_model(self, cell: PlannedRun) -> PlayedModel | None:
        """Return the model as the run of a cell, or another run of the same files, was played; None if unknown."""
        contents = self.contents(cell)
        model = self._newest(lambda model: model.run == cell.folder)
        return model or (self._newest(lambda model: self._is_of(model, cell, contents)) if contents else None)

    def note_played(self, cell: PlannedRun) -> None:
        """Write the record of a run that this process, or a worker of it, has just played.

        Raises:
            SettingsMismatchError: If files of the model were changed since the run was named.
        """
        former, contents = self._contents_here(cell), self._contents_here(cell, again=True)
        if changed := [cell.paths[name] for name, content in former.items() if contents.get(name) != content]:
            raise SettingsMismatchError(
                f"{changed[0]} was changed while {cell.name} was played; it is not known which state was loaded. "
                f"Remove {cell.location(self._out)}, and run the study again"
            )
        settings = read_root(locate(cell.location(self._out))).own_settings
        if settings.get("weights_sha256") is not None:
            self._note(cell, settings["weights_sha256"], settings.get("policy") or {})

    def note_stored(self, cell: PlannedRun) -> None:
        """Complete the records of a whole run.

        They then tell which of several contents of a path was there last. A run of an earlier version has none: it
        is believed if its checkpoint still lies where it was loaded from.
        """
        contents = self._contents_here(cell)
        if not contents:
            return
        if (model := self._newest(lambda model: model.run == cell.folder)) is not None:
            self._note(cell, model.weights_sha256, model.policy)
            return
        run = open_run(locate(cell.location(self._out)), allow_partial=True)
        card: Mapping[str, Any] = run.certificate.get("policy") or {}
        checkpoint = str(card.get("checkpoint"))
        if is_here(checkpoint) and content_of(checkpoint) == contents.get(CHECKPOINT):
            self._note(cell, str(run.weights_sha256), run.root.own_settings.get("policy") or {})

    def _note(self, cell: PlannedRun, weights_sha256: str, policy: Mapping[str, Any]) -> None:
        when, contents = datetime.now(UTC).isoformat(timespec="microseconds"), self._contents_here(cell)
        model = PlayedModel(
            run=cell.folder, model=cell.model, asks=cell.asks, paths=cell.paths, contents=contents,
            weights_sha256=weights_sha256, policy=dict(policy), when=when,
        )  # fmt: skip
        name = f"{cell.folder.replace('/', '+')}+{sha256_json(cell.paths)[:KEY_DIGITS]}.json"
        newest = self._newest(lambda other: (other.model, other.paths) == (cell.model, cell.paths))
        if model.same(self._models.get(name)) and (newest is None or newest.contents == contents):
            return
        with self._location.explained_errors(), self._location.take_turns(RECORDS):
            self._location.write(f"{RECORDS}/{name}", model.to_bytes())
        self._models[name] = model


def _keys_in(runs: Iterable[str], cell: PlannedRun) -> list[str]:
    """Return the keys in the names of folders that are named as those of the cell, each once."""
    pattern = re.compile(rf"{re.escape(cell.folder_of(''))}([0-9a-f]{{{KEY_DIGITS}}})")
    return sorted({match[1] for run in runs if (match := pattern.fullmatch(run))})


# -- settings ----------------------------------------------------------------------------------------------------


def changed_settings(own_settings: Mapping[str, Any], cell: PlannedRun) -> Iterator[Change]:
    """Yield the settings of a stored run that differ from those of `cell`."""
    stored, expected = flat_settings(own_settings), flat_settings(_expected_settings(cell))
    for name in sorted(stored | expected):
        is_open = name.partition(".")[0] in _OF_LOADED_MODEL
        if (name in expected or not is_open) and stored.get(name) != expected.get(name):
            yield name, stored.get(name), expected.get(name)


def _expected_settings(cell: PlannedRun) -> dict[str, Any]:
    """Return the settings that a run of the cell has whatever model is loaded, as plain values.

    Settings that the file leaves to the model are absent.
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
