"""Writing a run: created once, then one committed episode at a time."""

import fcntl
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zarr
from zarr.core.array_spec import ArrayConfigLike
from zarr.storage import LocalStore

from probe_kit.errors import SettingsMismatchError
from probe_kit.extract.commits import RecordingStore, create_once, read_commits, write_commit
from probe_kit.extract.layout import (
    CERTIFICATE_FILE,
    COMMITS,
    DATA,
    FAILED,
    PLAN_FILE,
    RUN_FILE,
    SCHEMA_VERSION,
    create_arrays,
)
from probe_kit.extract.plan import Plan
from probe_kit.extract.settings import refuse_other_settings
from probe_kit.identity import canonical_json, sha256_json

if TYPE_CHECKING:
    from probe_kit.extract.rollout import Rollout

# Zarr's default leaves out chunks that equal the fill value (and compares every chunk with it to find out), but
# a reader must be able to tell an empty chunk from a lost one. Not stored in the array, so asked for here.
_WRITE_ALL: ArrayConfigLike = {"write_empty_chunks": True}
# What a killed process leaves: commits, objects and columns that never got their final name.
_ORPHANS = ("*.tmp", f"{COMMITS}/*.tmp", f"{DATA}/**/*.partial")


class RunWriter:
    """Creates a run folder or continues the one that is there; any number of processes may do so at once.

    Raises SettingsMismatchError if the folder holds a run with other settings, or anything else.
    """

    def __init__(self, path: Path, plan: Plan, settings: dict[str, Any]) -> None:
        self.path, self.plan = path, plan
        self.settings = json.loads(canonical_json(settings))
        if not (path / RUN_FILE).is_file():
            self._create()
        self._refuse_other_settings()

    def _create(self) -> None:
        """The folder appears whole or not at all: it is made aside and renamed, and the first one stays."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=self.path.parent, prefix=f".{self.path.name}.", suffix=".tmp"))
        aside.chmod(0o755)
        try:
            self._fill(aside)
            aside.rename(self.path)
        except OSError as error:
            if not (self.path / RUN_FILE).is_file():
                if not self.path.exists():
                    raise
                raise SettingsMismatchError(
                    f"{self.path} exists and is not a run; choose another --out"
                ) from error
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def _fill(self, folder: Path) -> None:
        (folder / COMMITS).mkdir()
        create_once(folder / PLAN_FILE, {"episodes": [e.to_json() for e in self.plan.episodes]})
        create_arrays(
            folder / DATA,
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
        create_once(folder / RUN_FILE, run)

    def _refuse_other_settings(self) -> None:
        stored = json.loads((self.path / RUN_FILE).read_text())
        asked = {"schema_version": SCHEMA_VERSION, **self.settings}
        refuse_other_settings({"schema_version": stored["schema_version"], **stored["settings"]}, asked, self.path)

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Work on the run while the body runs, and begin by clearing what killed processes left behind.

        Every process that works holds a shared lock, so only one that finds itself alone may clear: what looks
        like a leftover could be another's work in progress.
        """
        with (self.path / RUN_FILE).open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                pass
            else:
                self._clear_orphans()
            fcntl.flock(file, fcntl.LOCK_SH)
            yield

    def _clear_orphans(self) -> None:
        for pattern in _ORPHANS:
            for orphan in self.path.glob(pattern):
                if orphan.is_dir():
                    shutil.rmtree(orphan)
                else:
                    orphan.unlink()
        shutil.rmtree(self.path / FAILED, ignore_errors=True)

    def remaining(self) -> list[int]:
        """Numbers of the episodes that are not committed; objects of the committed ones are checked."""
        done = read_commits(self.path)
        return [episode.index for episode in self.plan.episodes if episode.index not in done]

    def write(self, rollout: "Rollout") -> None:
        """Store one episode: first its arrays, then the commit that makes it count."""
        planned, buffers = rollout.planned, rollout.buffers
        store = RecordingStore(LocalStore(self.path / DATA))
        for kind, arrays in (("pooled", buffers.pooled), ("tokens", buffers.tokens)):
            for stream, values in arrays.items():
                array = zarr.open_array(store, path=f"{stream}/{kind}", mode="r+", config=_WRITE_ALL)
                array[planned.index] = values
        commit = {
            "episode_id": planned.episode.episode_id,
            "outcome": rollout.outcome,
            "roles": buffers.roles,
            "objects": {key: list(record) for key, record in sorted(store.objects.items())},
        }
        write_commit(self.path, planned.index, commit)

    def write_certificate(self, certificate: dict[str, Any]) -> None:
        """Record what was loaded and checked; the first one stays."""
        if not (self.path / CERTIFICATE_FILE).is_file():
            create_once(self.path / CERTIFICATE_FILE, json.loads(json.dumps(certificate, default=list)))
