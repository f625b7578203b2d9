"""Cells: one model in one condition, or asked in one way, with one seed. Known without loading a model.

The module also holds the suite as far as a plan needs it, and the failures of cells. Each failure is a file
`OUT/failures/<run>.json` of its own, until the run or its probes are made. Runs describe themselves, so that a
study notes nothing else. No number of a table comes from a failure. Two processes that play different models of a
study need no lock between them.
"""

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

from probe_kit.errors import SuiteError
from probe_kit.extract.settings import Settings
from probe_kit.extract.sources.player import traceback_of
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.runs.records import Record
from probe_kit.runs.store import locate
from probe_kit.study.schema import Mistake, SuiteTable
from probe_kit.suite.categories import in_order


@dataclass(frozen=True)
class PlannedSuite:
    """A suite as far as a plan needs it.

    Attributes:
        identity: `name@version`; when a run grows, items are compared by content.
        items: Number of items by category.
        folder: None for the embedded suite.
        source: Origin of the numbers of items.
        contents: Hash of every item's content by its id, of a suite in a folder; empty for others.
    """

    identity: str
    items: Mapping[str, int]
    folder: Path | None
    source: str
    contents: Mapping[str, str] = field(default_factory=dict)


def planned_suite(table: SuiteTable) -> tuple[PlannedSuite, list[Mistake]]:
    """Return the suite that a file names, and the mistakes in it."""
    from probe_kit.suite import load_suite
    from probe_kit.suite.build import ITEMS, default_identity
    from probe_kit.suite.generators import GENERATORS
    from probe_kit.suite.suite import count_by_category

    if table.path is None:
        drawn = dict.fromkeys(in_order(GENERATORS), ITEMS)
        return PlannedSuite(default_identity(), drawn, None, "the embedded suite"), []
    folder = Path(table.path)
    counts = {slug(name): count for name, count in table.counts.items()}
    if counts and not folder.is_dir():
        ordered = {name: counts[name] for name in in_order(counts)}
        return PlannedSuite(f"not here: {table.path}", ordered, folder, "suite.counts"), []
    why = f"there is no folder {folder}. Make the suite, or give items per category in [suite.counts] for a plan"
    try:
        suite = load_suite(folder) if folder.is_dir() else None
    except SuiteError as error:
        suite, why = None, str(error)
    if suite is None:
        unknown_suite = PlannedSuite(f"not here: {table.path}", {}, folder, "nothing")
        return unknown_suite, [Mistake(("suite", "path"), why)]
    items = count_by_category(suite.items)
    wrong = [
        Mistake(
            ("suite", "counts", name),
            f"{slug(name)} has {items.get(slug(name), 0)} items in {folder}, not {count}",
        )
        for name, count in table.counts.items()
        if items.get(slug(name)) != count
    ]
    contents = {item.item_id: item.content_sha256 for item in suite.items}
    return PlannedSuite(f"{suite.name}@{suite.version}", items, folder, str(folder), contents), wrong


# -- cells -------------------------------------------------------------------------------------------------------


def slug(name: str) -> str:
    """Return the slug of a category that was named by slug or title, in any case."""
    return "-".join(name.lower().split())


def slugs(names: Sequence[str]) -> tuple[str, ...]:
    """Return the slugs of several categories, each once, in order."""
    return tuple(dict.fromkeys(map(slug, names)))


KEY_DIGITS = 8
"""Digits of a key in a folder's name; `stored` detects two settings that share them."""
CHECKPOINT = "checkpoint"


@dataclass(frozen=True)
class ItemSelection:
    """Categories, and the number of items of each.

    Attributes:
        items: Largest number of items per category; None for all.
    """

    categories: tuple[str, ...]
    items: int | None = None

    def counts(self, suite: PlannedSuite) -> dict[str, int]:
        """Return the number of items by category."""
        every = {name: suite.items.get(name, 0) for name in self.categories}
        return {name: count if self.items is None else min(count, self.items) for name, count in every.items()}


def join_selections(selections: Iterable[ItemSelection]) -> ItemSelection:
    """Return the smallest selection that holds all of these."""
    every = list(selections)
    categories = tuple(dict.fromkeys(name for selection in every for name in selection.categories))
    counts = [selection.items for selection in every]
    return ItemSelection(categories, None if None in counts else max(count or 0 for count in counts))


@dataclass(frozen=True)
class PlannedRun:
    """A run of the study.

    Attributes:
        model: Name of the model in the file.
        way: Name of the condition or the ask in the file.
        settings: Settings of the run without its selection.
        selections: Selections of the blocks that use the run, by their names.
        suite: The suite of all cells.
        unavailable: Reason why it is not played, empty if it is.
        packed_key: In an archive, the key of the run that was packed.
        find_key: Finds the key of the stored run, see `StudyFolder.key`; None names files by their paths.
    """

    model: str
    way: str
    seed: int
    settings: Settings
    selections: Mapping[str, ItemSelection]
    suite: PlannedSuite
    unavailable: str = ""
    packed_key: str = ""
    find_key: "Callable[[PlannedRun], str] | None" = field(default=None, compare=False, repr=False)

    @property
    def name(self) -> str:
        """The name in tables of the plan, such as `base/plain`."""
        return f"{self.model}/{self.way}" + (f"/seed {self.seed}" if self.seed else "")

    @property
    def asks(self) -> bool:
        """Whether a VLM is asked."""
        return self.settings.asks

    @property
    def captured(self) -> bool:
        """Whether a policy is only captured."""
        return self.settings.task.capture_only

    @cached_property
    def selection(self) -> ItemSelection:
        """The selection that all blocks together need."""
        return join_selections(self.selections.values())

    def selected(self, blocks: Collection[str]) -> ItemSelection | None:
        """Return the selection that these blocks need together, None if none of them uses the run."""
        selections = [selection for name, selection in self.selections.items() if name in blocks]
        return join_selections(selections) if selections else None

    @property
    def n_items(self) -> int:
        """Items of all categories."""
        return sum(self.selection.counts(self.suite).values())

    @property
    def episodes(self) -> int:
        """Episodes: both layouts in every wording, of which some items may lack one."""
        return 2 * self.n_items * len(self.settings.wordings or (None,))

    @property
    def inferences(self) -> int:
        """Inferences of a policy at most, where episodes may end early; a VLM has none."""
        if self.asks:
            return 0
        if self.captured:
            return self.episodes
        return self.episodes * self.settings.most_inferences(self.settings.task.execute or 1)

    @property
    def units(self) -> float:
        """The most inferences of an episode, in which conditions differ; 1 without a policy that acts."""
        return self.inferences / self.episodes if self.inferences else 1.0

    @property
    def work(self) -> str:
        """The kind of work that shares one rate: a model that acts, is captured without acting, or is asked."""
        return f"{self.model}, {'asked' if self.asks else 'captured' if self.captured else 'acting'}"

    @cached_property
    def key(self) -> str:
        """The key in the name of the run's folder."""
        if self.packed_key:
            return self.packed_key
        return self.key_with({}) if self.find_key is None else self.find_key(self)

    @property
    def paths(self) -> dict[str, str]:
        """The texts that may name files of this machine: the checkpoint, and options by `option NAME`."""
        model = self.settings.model
        checkpoint = {} if model.checkpoint is None else {CHECKPOINT: model.checkpoint}
        return checkpoint | {f"option {name}": str(value) for name, value in model.options.items()}

    def key_with(self, contents: Mapping[str, Any]) -> str:
        """Return the hash of everything that the settings decide except the selection.

        Args:
            contents: What stands for the files that `paths` names; the others are named by their texts.
        """
        settings, files = self.settings, {**self.paths, **contents}
        decided = {
            **settings.identity(),
            "checkpoint": files.get(CHECKPOINT),
            "options": {name: files[f"option {name}"] for name in settings.model.options},
            "weights_seed": settings.model.weights_seed,
            "protocol": settings.task.protocol,
            "wordings": settings.wordings,
            "scene": settings.scene.to_json(),
            "suite": self.suite.identity,  # its items are compared one by one when the run is opened
        }
        return sha256_json(json.loads(canonical_json(decided)))[:KEY_DIGITS]

    @property
    def folder(self) -> str:
        """The run's folder below `out`, such as `base/plain-seed1-0123abcd`."""
        return self.folder_of(self.key)

    def folder_of(self, key: str) -> str:
        """Return the folder below `out` of a run of this key."""
        return f"{self.name.replace('/seed ', '-seed')}-{key}"

    def location(self, out: str) -> str:
        """Return the location of the run below `out`."""
        return f"{out.rstrip('/')}/{self.folder}"

    @property
    def settings_to_play(self) -> Settings:
        """The settings with suite and selection."""
        folder = self.suite.folder
        return self.settings.changed(
            suite=folder, categories=self.selection.categories, items=self.selection.items
        )


# -- failures ----------------------------------------------------------------------------------------------------


FOLDER = "failures"
Stage = Literal["checking", "playing", "episodes", "probes", "waiting"]
_ADVICE = "Delete it; no number comes from it, and `probe-kit study run` then tries again"
NOT_TRIED_AGAIN: tuple[Stage, ...] = ("playing", "episodes")
"""The failures that take long, and so are tried again only on request."""


class StudyFailure(Record):
    """The reason why runs of a model, or probes of a run, were not made.

    Attributes:
        stage: `checking` before anything was loaded, `playing` for the whole model, `episodes` for single ones
            that were given up, `probes`, or `waiting` for a run that is not whole.
        run: Name of the run in the plan.
        error: Class of the error.
        when: UTC, ISO 8601.
    """

    kind: ClassVar[str] = "record of a failure"
    stage: Stage
    model: str
    run: str
    reason: str
    error: str = ""
    traceback: str = ""
    when: str = ""

    @classmethod
    def of(cls, stage: Stage, model: str, run: str, error: BaseException) -> "StudyFailure":
        """Return the failure of an error, with its traceback and the time."""
        reason = str(error) or type(error).__name__
        return cls(
            stage=stage, model=model, run=run, reason=reason, error=type(error).__name__,
            traceback=traceback_of(error), when=datetime.now(UTC).isoformat(timespec="seconds"),
        )  # fmt: skip

    def __str__(self) -> str:
        if self.stage in ("probes", "waiting"):
            return f"probes of {self.run}: {self.reason}"
        return f"{self.model} failed at {self.run}: {self.reason}"

    def same(self, other: "StudyFailure | None") -> bool:
        """Whether both have the same stage, run, error and reason, at whatever time."""
        key = (self.stage, self.run, self.error, self.reason)
        return other is not None and key == (other.stage, other.run, other.error, other.reason)


class Failures:
    """The failures of the study whose runs lie in `out`, a folder or URL; of probes by their table's name."""

    def __init__(self, out: str) -> None:
        self._location = locate(out)

    def check_place(self) -> None:
        """Check that failures can be written, and remove drafts of killed processes.

        Raises:
            DiskSpaceError: For a folder that cannot be written.
            StoreError: For an object store that cannot be written.
        """
        with self._location.explained_errors(), self._location.take_turns(FOLDER):
            pass

    def of(self, cell: PlannedRun, probes: str = "") -> StudyFailure | None:
        """Return the failure of a run, or of its probes; None without one.

        Args:
            cell: The cell of the run.
            probes: Name of a table of probes; empty for the run itself.

        Raises:
            RunDamagedError: If the record was changed.
        """
        key = _key(cell, probes)
        if not self._location.exists(key):
            return None
        return StudyFailure.read(self._location, key, _ADVICE, run=cell.name)

    def note(self, cell: PlannedRun, failure: StudyFailure, probes: str = "") -> None:
        """Write a failure, unless the same one is there."""
        if not failure.same(self.of(cell, probes)):
            with self._location.explained_errors():
                self._location.write(_key(cell, probes), failure.to_bytes())

    def clear(self, cell: PlannedRun, probes: str = "") -> None:
        """Remove the failure of a run or of probes that are made now."""
        self._location.delete(_key(cell, probes))


def _key(cell: PlannedRun, probes: str) -> str:
    # The folder holds the key of the settings: a failure of other settings is none of this cell.
    name = "+".join([*cell.folder.split("/"), *([probes] if probes else [])])
    return f"{FOLDER}/{name}.json"
