"""Writing of a run: it is created once, then gets one committed episode at a time. It may grow, never shrink."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from probe_kit.errors import RunDamagedError, SettingsMismatchError
from probe_kit.hashing import canonical_json
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.arrays import WRITE_ALL, create_arrays, create_inputs, write_row
from probe_kit.runs.commits import (
    Commit,
    Seconds,
    commit_key,
    read_commit,
    read_commits,
    write_commit,
    write_failure,
    write_seconds,
)
from probe_kit.runs.layout import (
    COMMITS,
    DATA,
    FAILED,
    INPUTS,
    LABEL_FILE,
    PLANS,
    ROOM,
    RUN_FILE,
    TRAJECTORY,
    StoredStream,
    source_settings_of,
)
from probe_kit.runs.plan import Plan, PlanRecord, Row, StoredRow, further_rows, plan_key, while_growing
from probe_kit.runs.provenance import (
    Provenance,
    check_other_provenance,
    keep_provenance,
    name_of,
    provenance_here,
    read_provenances,
    write_certificate,
)
from probe_kit.runs.records import Checksum
from probe_kit.runs.results import BUNDLES, bundle_keys
from probe_kit.runs.root import Label, Root, find_continuable, new_card, read_root
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.store import Location, begin
from probe_kit.runs.trajectories import create_trajectories


def growth_words(location: Location, plan: Plan) -> str:
    """Return how the run at `location` grows by a plan, in a line; empty for no run, and where nothing changes.

    The line names the probes and interventions that are then of former episodes.

    Raises:
        SettingsMismatchError: If the stored run cannot grow by this plan.
        ActivationsLeftOutError: For a copy without activations.
        RunDamagedError: If the stored run was changed.
    """
    root = find_continuable(location)
    if root is None or not root.plan:
        return ""
    stored, requested = len(root.plan), len(plan.episodes)
    if further_rows(root.plan, plan.columns, location):
        results = ", ".join(f"{home} {key}" for home in BUNDLES for key in bundle_keys(location, home))
        stale = f"; of the former episodes only: {results}" if results else ""
        return f"from {stored} to {requested} episodes; stored ones stay as they are{stale}"
    if requested < stored:
        return f"no: the run has {stored} episodes, these {requested} among them, and never shrinks"
    return ""


def check_other_settings(stored: dict[str, Any], requested: dict[str, Any], where: str) -> None:
    """Raise SettingsMismatchError naming the settings that differ between a stored run and this request."""
    was, now = flat_settings(stored), flat_settings(requested)
    different = [key for key in sorted(was | now) if was.get(key) != now.get(key)]
    if different:
        lines = [f"  {key}: stored {was.get(key)!r}, asked {now.get(key)!r}" for key in different]
        raise SettingsMismatchError(
            f"{where} holds a run with other settings:\n" + "\n".join(lines) + "\n"
            "Choose another --out, or repeat the stored settings to continue it"
        )


def flat_settings(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return settings by their path, such as `scene.light_level`."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    return {
        key: leaf
        for name, child in value.items()
        for key, leaf in flat_settings(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }


@dataclass(frozen=True)
class EpisodeRecord:
    """All that is stored of one episode.

    Attributes:
        arrays: Arrays by kind (`pooled`, `tokens`, `later`) and stream, each shaped like its row in the store.
        roles: Per captured inference and stream, the spans of roles.
        trajectory: (T + 1, C) float32 frames.
        instruction_ids: The token ids of the instruction as the policy received it.
        pictures: Encoded pictures, by key in the run.
        control_steps: For every inference, how many actions of the episode came before it; rising.
        seconds: The seconds that the episode took, which no hash of the run covers.
        frames: The number of frames in one of the pictures, if that holds all of the episode.
        inputs: The inputs of recordings that were shown, by kind.
        lens_margins: The logit lens of an answer by letter, left minus right at every layer.
    """

    planned: Row
    outcome: Mapping[str, Any]
    arrays: Mapping[str, Mapping[str, NDArray[Any]]]
    roles: Sequence[Mapping[str, Sequence[tuple[str, int, int]]]]
    trajectory: NDArray[np.float32] | None = None
    instruction_ids: Sequence[int] | None = None
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    control_steps: Sequence[int] = ()
    seconds: Seconds = field(default_factory=Seconds)
    frames: int | None = None
    inputs: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    lens_margins: Sequence[float] | None = None


class RunWriter:
    """A writer that creates a run, continues the one that is there, or lets it grow.

    Any number of processes may do so at once.

    Args:
        location: The place of the run.
        plan: The episodes to play. Those that the run lacks are appended to its plan; `self.plan` has the run's
            numbers. Without any, rows are added as they arrive, see `add`.
        settings: The settings without what a selection decides.
        provenance: The provenance of this process, by default of one that computes on the CPU.
        label: The name in tables of a run that begins here, by default the model's name. A run that is there keeps
            its own, see `label_run`.

    Attributes:
        is_certified: Whether this process has recorded what it loaded and checked, see `write_certificate`.

    Raises:
        SettingsMismatchError: If the location holds a run with other settings, episodes that `plan` lacks while
            the run lacks others, or anything else.
        RunDamagedError: If what the location holds was changed.
    """

    def __init__(
        self, location: Location, plan: Plan, settings: dict[str, Any], provenance: Provenance | None = None,
        label: str | None = None,
    ) -> None:  # fmt: skip
        self.location, self.plan = location, plan
        self.provenance = provenance or provenance_here()
        self._begun = self.is_certified = False
        self._ids: set[str] | None = None
        # As they will be read again: a tuple would differ from the stored list, and refuse to continue.
        self.settings = json.loads(canonical_json(settings))
        self._label = label or str(self.settings["model"])
        if not location.exists(RUN_FILE):
            begin(location, self._beginning(), last=RUN_FILE)
        self.root = while_growing(location, self._continue_root)
        self.plan = plan.numbered({row["episode_id"]: row["episode"] for row in self.root.plan})

    @property
    def streams(self) -> list[StoredStream]:
        """The storage of the streams in the run, which may have room for longer sequences than the plan needs."""
        return [self.root.streams[stream.name] for stream in self.plan.streams]

    @property
    def _with_tokens(self) -> bool:
        return bool(self.settings["tokens"] == "all")

    def _beginning(self) -> dict[str, bytes]:
        """Return every object that a run of these settings has before its first plan, whatever the selection."""
        arrays: dict[str, Buffer] = {}
        store = MemoryStore(arrays)
        create_arrays(
            store, list(self.plan.streams), self.settings["captured_calls"], self._with_tokens,
            self.settings["codec"], self.settings.get("later_views", "all"),
        )  # fmt: skip
        still = "ask" in self.settings or bool(self.settings.get("capture_only"))
        if "scene" in self.settings and not still:  # a model that is asked or only captured moves no arm
            frames = self.settings["scene"]["max_steps"] + 1
            create_trajectories(store, frames, self.settings["codec"])
        if source := source_settings_of(self.settings):
            create_inputs(store, self.settings["captured_calls"], source["inputs"], self.settings["codec"])
        objects = {f"{DATA}/{key}": value.to_bytes() for key, value in arrays.items()}
        card = new_card(self.settings, self.plan.streams, objects)
        label = Label(run=card.hash, label=self._label)
        return {**objects, LABEL_FILE: label.to_bytes(), RUN_FILE: card.to_bytes()}

    def _continue_root(self) -> Root:
        """Return the root of the run that is there, whose plan now holds the one of this writer."""
        root = read_root(self.location)
        root.check_continuable()
        check_other_settings(root.own_settings, self.settings, str(self.location))
        self._check_lengths(root)
        if self._lacks(root):
            with self.location.locked(lambda: None), self.location.take_turns(PLANS):
                root = self._grow_root()
        root.check()
        if root.plan:  # an array has no length before its first row arrives
            with self.location.locked(lambda: None):  # or another process would take a draft for a leftover
                root.set_lengths()
        return root

    def _lacks(self, root: Root) -> bool:
        """Whether the run does not plan all of this writer's episodes yet. Raises SettingsMismatchError."""
        if not self.plan.episodes:
            return False
        return not root.plan or bool(further_rows(root.plan, self.plan.columns, self.location))

    def _grow_root(self) -> Root:
        """Return the root, once the run plans all of this writer's episodes."""
        root = read_root(self.location)
        while self._lacks(root):
            self.location.create(plan_key(len(root.stored_plan.extents)), self._record(root).to_bytes())
            root = read_root(self.location)  # ours, or that of a process that was first
        return root

    def _check_lengths(self, root: Root) -> None:
        """Raise SettingsMismatchError for more episodes, or longer instructions, than the arrays have room for."""
        if len(self.plan.episodes) > ROOM:
            raise SettingsMismatchError(
                f"a run holds at most {ROOM:,} episodes; this command plans {len(self.plan.episodes):,}. Ask for "
                "fewer --items, or divide them between several runs"
            )
        for stream in self.plan.streams if self._with_tokens else ():
            room = root.own_streams[stream.name].tokens
            if stream.tokens > room:
                raise SettingsMismatchError(
                    f"{self.location} stores {room} tokens of {stream.name} per episode; the longest instruction "
                    f"of this command needs {stream.tokens}. A run with --tokens all takes no longer instructions "
                    "than it began with. Choose another --out"
                )

    def _record(self, root: Root) -> PlanRecord:
        """Return the plan record that adds to the run's plan those episodes of this writer's that it lacks."""
        rows, before = self.plan.columns, root.stored_plan
        numbers = {row["episode_id"]: row["episode"] for row in before.rows}
        added = [row for row in rows if row["episode_id"] not in numbers]
        numbers |= {row["episode_id"]: len(before.rows) + position for position, row in enumerate(added)}
        return PlanRecord(
            run=root.identity,
            record=len(before.extents),
            selection=json.loads(canonical_json(self.plan.selection)),
            suite_parent=self.plan.suite_parent,
            tokens=self._tokens(root, self.plan.streams),
            episodes=[cast("StoredRow", {**row, "episode": numbers[row["episode_id"]]}) for row in added],
            order=[numbers[row["episode_id"]] for row in rows],
        )

    def _tokens(self, root: Root, streams: Sequence[StoredStream]) -> dict[str, int]:
        """Return the sequence lengths that a plan record says; empty where arrays are as long as that."""
        # A later selection may have shorter instructions only; the arrays of before keep their length.
        before = root.stored_plan.tokens
        listed = () if self._with_tokens else streams
        return {stream.name: max(stream.tokens, before.get(stream.name, 0)) for stream in listed}

    def add(self, row: Row, streams: Sequence[StoredStream] = ()) -> Row:
        """Plan a row that arrived, and return it with its number in the run; `write` then stores it.

        Takes as long in a run of thousands of rows as in a short one: no earlier record is read again.

        Args:
            row: The row, with an id that the run does not plan yet.
            streams: The streams with the sequence lengths of this row; empty for those of the writer's plan.

        Raises:
            SettingsMismatchError: For an id that the run plans already, and for more rows than a run holds.
        """
        while True:
            root = self.root
            number = len(root.stored_plan.rows)
            if number >= ROOM:
                raise SettingsMismatchError(
                    f"{self.location} holds {ROOM:,} episodes, the most of a run. Choose another --out"
                )
            if self._ids is None:
                self._ids = {stored["episode_id"] for stored in root.plan}
            if row.episode_id in self._ids:
                raise SettingsMismatchError(
                    f"{self.location} has an episode {row.episode_id!r} already; give this one another id"
                )
            planned = replace(row, index=number)
            selection = json.loads(canonical_json(self.plan.selection))
            first = {} if root.stored_plan.extents else {"selection": selection, "suite_parent": None}
            record = PlanRecord(
                run=root.identity,
                record=len(root.stored_plan.extents),
                tokens=self._tokens(root, streams or self.plan.streams),
                episodes=[cast("StoredRow", json.loads(canonical_json(planned.to_json())))],
                **first,
            )
            if self.location.create(plan_key(record.record), record.to_bytes()):
                self.root = root.with_record(record)
                self._ids.add(row.episode_id)
                return planned
            self.root, self._ids = read_root(self.location), None  # another process was first

    @contextmanager
    def claim(self) -> Iterator[None]:
        """Work on the run while the body runs; failures of earlier attempts are removed."""
        with self.location.locked(lambda: self.location.remove(FAILED)):
            yield

    @contextmanager
    def take_part(self) -> Iterator[None]:
        """Work along while the body runs, in a process that the owner started, and may outlive it.

        No process then removes its drafts as leftovers. Failures that the owner recorded stay.
        """
        with self.location.locked(lambda: None):
            yield

    def begin(self, allow_mixed: bool = False) -> None:
        """Store in the run the provenance of this process, which will play in it.

        Raises:
            SettingsMismatchError: If episodes were played where numbers come out otherwise, unless `allow_mixed`.
        """
        if not allow_mixed:
            stored = read_provenances(self.root).values()
            check_other_provenance(stored, self.provenance, str(self.location))
        self._say_who_plays()

    def _say_who_plays(self) -> None:
        if not self._begun:
            keep_provenance(self.location, self.provenance)
            self._begun = True

    def opened(self) -> Run:
        """Return the finished run; records of processes that are missing are written again, as far as they can be.

        Raises:
            RunDamagedError: If one is missing that neither follows from the others nor is this process's.
        """
        try:
            run = open_run(self.location)
        except RunDamagedError:
            commits = read_commits(read_root(self.location)).values()
            if name_of(self.provenance) not in {commit.provenance for commit in commits}:
                raise
            keep_provenance(self.location, self.provenance)
            run = open_run(self.location)
        run.restore_records()
        return run

    def remaining(self) -> list[int]:
        """Return the numbers of the episodes that are not committed; objects of the committed ones are checked."""
        committed = while_growing(self.location, lambda: read_commits(read_root(self.location)))
        return [episode.index for episode in self.plan.episodes if episode.index not in committed]

    def write(self, episode: EpisodeRecord) -> None:
        """Store one episode: first its arrays, then the commit that makes it count.

        An episode that another process has committed meanwhile stays as it is.
        """
        number = episode.planned.index
        if self.location.exists(commit_key(number)):
            return
        self._say_who_plays()  # before any commit names it
        if not self.is_certified:
            self.write_certificate({})  # a run without any certificate is damaged
        commit = self._write_objects(episode)
        # Before the commit: an episode that counts has its seconds, or all were deleted.
        write_seconds(self.root, number, episode.seconds)
        if not write_commit(self.location, commit):
            self._settle(episode, commit)

    def _settle(self, episode: EpisodeRecord, commit: Commit) -> None:
        """Make objects and commit those of one process, where two have written the same episode at once.

        Equal numbers are equal bytes, and the first commit stays. Numbers of other batches or processors differ by
        rounding: some objects then are ours although the commit is not. All of them become ours, with the commit.
        """
        key = commit_key(episode.planned.index)
        with self.location.take_turns(COMMITS):
            theirs = read_commit(self.root, episode.planned.index, key, self.location.read(key))
            if (theirs.objects, theirs.pictures) != (commit.objects, commit.pictures):
                self.location.write(key, self._write_objects(episode).to_bytes())

    def _write_objects(self, episode: EpisodeRecord) -> Commit:
        """Write everything of an episode but its commit, and return the commit."""
        planned = episode.planned
        store = ArrayStore(self.location, DATA, self.root.metadata)
        for kind, by_stream in episode.arrays.items():
            for stream, values in by_stream.items():
                array = zarr.open_array(store, path=f"{stream}/{kind}", mode="r+", zarr_format=3, config=WRITE_ALL)
                if array.shards:
                    store.shards[f"{stream}/{kind}"] = prod(array.shards) // prod(array.chunks)
                array[planned.index] = values
        if episode.trajectory is not None and self.root.has_trajectories:
            write_row(store, TRAJECTORY, planned.index, episode.trajectory)
        for name, values in episode.inputs.items():
            write_row(store, f"{INPUTS}/{name}", planned.index, values)
        for key, content in episode.pictures.items():
            self.location.write(key, content)
        self.location.flush(f"{DATA}/{key}" for key in store.written)
        parts = {
            "run": self.root.identity,
            "episode": planned.index,
            "episode_id": planned.episode_id,
            "plan": self.root.stored_plan.hash_of(planned.index),
            "outcome": dict(episode.outcome),
            "roles": json.loads(json.dumps(episode.roles)),
            "provenance": name_of(self.provenance),
            "control_steps": [int(step) for step in episode.control_steps],
            "objects": store.written,
            "pictures": {key: Checksum.of(content) for key, content in episode.pictures.items()},
        }
        optional = {
            "instruction_ids": None if episode.instruction_ids is None else list(episode.instruction_ids),
            "lens_margins": None if episode.lens_margins is None else list(episode.lens_margins),
            "frames": episode.frames,
        }
        stored = {name: value for name, value in optional.items() if value is not None}
        return Commit.model_validate({**parts, **stored})

    def write_certificate(self, certificate: dict[str, Any]) -> None:
        """Record what this process loaded and checked; the certificate of the first process stays whole.

        A second call makes a further record, of what a process knows at its end alone.
        """
        write_certificate(self.root, certificate, self.provenance)
        self.is_certified = True

    def give_up(self, number: int, reason: str, traceback: str = "") -> None:
        """Record why episode `number` is not played, with the traceback of its error."""
        write_failure(self.root, number, reason, traceback)
