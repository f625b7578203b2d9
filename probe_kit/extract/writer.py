"""Writing a run: created once, then one committed episode at a time."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.storage import LocalStore

from probe_kit.errors import SettingsMismatchError
from probe_kit.extract.commits import RecordingStore, commit_path, create_once, read_commits
from probe_kit.extract.controllers import Capture
from probe_kit.extract.layout import (
    CERTIFICATE_FILE,
    COMMITS,
    DATA,
    PLAN_FILE,
    RUN_FILE,
    SCHEMA_VERSION,
    StoredStream,
    create_arrays,
)
from probe_kit.extract.plan import Plan, PlannedEpisode
from probe_kit.extract.rollout import Rollout
from probe_kit.extract.settings import refuse_other_settings
from probe_kit.identity import canonical_json, sha256_json


class RunWriter:
    """Creates a run folder or continues the one that is there.

    Raises SettingsMismatchError if the folder holds a run with other settings, or anything else.
    """

    def __init__(self, path: Path, plan: Plan, settings: dict[str, Any]) -> None:
        self.path, self.plan = path, plan
        self.settings = json.loads(canonical_json(settings))
        if (path / RUN_FILE).is_file():
            self._continue()
        else:
            self._create()

    def _create(self) -> None:
        """Everything aside `run.json` first: a folder without it is no run and is never read as one."""
        if self.path.exists() and not _is_leftover(self.path):
            raise SettingsMismatchError(f"{self.path} exists and is not a run; choose another --out")
        if self.path.exists():
            shutil.rmtree(self.path)
        (self.path / COMMITS).mkdir(parents=True)
        create_once(self.path / PLAN_FILE, {"episodes": [e.to_json() for e in self.plan.episodes]})
        create_arrays(
            self.path / DATA,
            list(self.plan.streams),
            len(self.plan.episodes),
            self.settings["captured_calls"],
            self.settings["tokens"] == "all",
            self.settings["codec"],
        )
        run = {
            "schema_version": SCHEMA_VERSION,
            "settings": self.settings,
            "settings_sha256": sha256_json(self.settings),
            "streams": [stream.to_json() for stream in self.plan.streams],
        }
        create_once(self.path / RUN_FILE, run)

    def _continue(self) -> None:
        stored = json.loads((self.path / RUN_FILE).read_text())
        asked = {"schema_version": SCHEMA_VERSION, **self.settings}
        refuse_other_settings({"schema_version": stored["schema_version"], **stored["settings"]}, asked, self.path)

    def remaining(self) -> list[PlannedEpisode]:
        """Episodes of the plan that are not committed; objects of the committed ones are checked."""
        done = read_commits(self.path)
        return [episode for episode in self.plan.episodes if episode.index not in done]

    def write(self, planned: PlannedEpisode, rollout: Rollout) -> None:
        """Store one episode: first its arrays, then the commit that makes it count."""
        store = RecordingStore(LocalStore(self.path / DATA))
        for stored in self.plan.streams:
            self._write_stream(store, planned.index, stored, rollout.captured)
        commit = {
            "episode_id": planned.episode.episode_id,
            "outcome": rollout.outcome,
            "roles": [
                {name: [list(span) for span in stream.roles.spans] for name, stream in call.items()}
                for call in rollout.captured
            ],
            "objects": {key: list(record) for key, record in sorted(store.objects.items())},
        }
        create_once(commit_path(self.path, planned.index), commit)

    def _write_stream(self, store: RecordingStore, index: int, stored: StoredStream, calls: list[Capture]) -> None:
        pooled = zarr.open_array(store, path=f"{stored.name}/pooled", mode="r+")
        rows = np.full(pooled.shape[1:], np.nan, np.float32)
        for step, call in enumerate(calls):
            rows[step] = call[stored.name].pooled
        pooled[index] = rows
        if self.settings["tokens"] == "all":
            tokens = zarr.open_array(store, path=f"{stored.name}/tokens", mode="r+")
            bits = np.zeros(tokens.shape[1:], np.uint16)
            for step, call in enumerate(calls):
                captured = call[stored.name].tokens
                assert captured is not None
                bits[step, ..., : captured.shape[-2], :] = captured
            tokens[index] = bits

    def write_certificate(self, certificate: dict[str, Any]) -> None:
        """Record what was loaded and checked; the first one stays."""
        if not (self.path / CERTIFICATE_FILE).is_file():
            create_once(self.path / CERTIFICATE_FILE, json.loads(json.dumps(certificate, default=list)))


def _is_leftover(path: Path) -> bool:
    """Whether `path` holds nothing but what `_create` writes before `run.json`."""
    return path.is_dir() and {p.name for p in path.iterdir() if p.suffix != ".tmp"} <= {COMMITS, PLAN_FILE, DATA}
