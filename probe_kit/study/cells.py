"""Cells: one model in one condition, or asked in one way, with one seed. Known without loading a model."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any

from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.study.planned_suite import PlannedSuite

KEY_DIGITS = 8


@dataclass(frozen=True)
class Selection:
    """Categories, and items of each."""

    categories: tuple[str, ...]
    items: int | None = None

    def counts(self, suite: PlannedSuite) -> dict[str, int]:
        """Items by category."""
        every = {name: suite.items.get(name, 0) for name in self.categories}
        return {name: count if self.items is None else min(count, self.items) for name, count in every.items()}

    def joined(self, other: "Selection") -> "Selection":
        """The smallest selection that holds both."""
        categories = tuple(dict.fromkeys((*self.categories, *other.categories)))
        items = None if None in (self.items, other.items) else max(self.items or 0, other.items or 0)
        return Selection(categories, items)


@dataclass(frozen=True)
class Cell:
    """A run of the study. settings: what it is played with, without its selection.

    model, way: names in the file; way is the condition or the ask. selections: of the blocks that use the run, by
    their names. unavailable: why it is not played, empty if it is. suite: of all cells. packed_key: in an archive,
    the key of the run that was packed.
    """

    model: str
    way: str
    seed: int
    settings: Settings
    selections: Mapping[str, Selection]
    suite: PlannedSuite
    unavailable: str = ""
    packed_key: str = ""

    @property
    def name(self) -> str:
        """As tables of the plan name it, such as `base/plain`."""
        return f"{self.model}/{self.way}" + (f"/seed {self.seed}" if self.seed else "")

    @property
    def asks(self) -> bool:
        """Whether a VLM is asked."""
        return isinstance(self.settings, AskSettings)

    @property
    def captured(self) -> bool:
        """Whether a policy is only captured."""
        return isinstance(self.settings, ExtractSettings) and self.settings.task.capture_only

    @cached_property
    def selection(self) -> Selection:
        """What all blocks together need."""
        first, *others = self.selections.values()
        for other in others:
            first = first.joined(other)
        return first

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
        if not isinstance(self.settings, ExtractSettings):
            return 0
        if self.captured:
            return self.episodes
        return self.episodes * ceil(self.settings.scene.max_steps / (self.settings.task.execute or 1))

    @cached_property
    def known(self) -> dict[str, Any]:
        """All that the settings decide but the selection, as plain values."""
        settings = self.settings
        known = {
            **settings.identity(),
            "checkpoint": checkpoint_stamp(settings.model.checkpoint),
            "options": {name: str(value) for name, value in settings.model.options.items()},
            "weights_seed": settings.model.weights_seed,
            "protocol": settings.task.protocol,
            "wordings": settings.wordings,
            "scene": settings.scene.to_json(),
            "suite": self.suite.identity,
        }
        plain: dict[str, Any] = json.loads(canonical_json(known))
        return plain

    @cached_property
    def key(self) -> str:
        """Hash of `known`: what the run's folder is named by."""
        return self.packed_key or key_of(self.known)

    @property
    def folder(self) -> str:
        """The run's folder below `out`."""
        return folder_of(self.name, self.key)

    def location(self, out: str) -> str:
        """Where the run lies below `out`."""
        return f"{out.rstrip('/')}/{self.folder}"

    @property
    def settings_to_play(self) -> Settings:
        """The settings with suite and selection."""
        folder = self.suite.folder
        return self.settings.changed(
            suite=folder, categories=self.selection.categories, items=self.selection.items
        )


def key_of(known: Mapping[str, Any]) -> str:
    """The key of a cell with these settings, see `Cell.known`."""
    return sha256_json(known)[:KEY_DIGITS]


def folder_of(name: str, key: str) -> str:
    """The folder below `out` of the run of the cell `name`, such as `base/plain/seed 1`."""
    return f"{name.replace('/seed ', '-seed')}-{key}"


def checkpoint_stamp(checkpoint: str | None) -> Any:
    """What names a checkpoint without reading it: its hub id, or name, size and time of every file of a folder."""
    if checkpoint is None or not (folder := Path(checkpoint).expanduser()).exists():
        return checkpoint
    files = sorted(folder.rglob("*")) if folder.is_dir() else [folder]
    stats = [(file, file.stat()) for file in files if file.is_file()]
    return [[file.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns] for file, stat in stats]
