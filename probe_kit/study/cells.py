"""Cells: one model in one condition, or asked in one way, with one seed. Known without loading a model."""

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from probe_kit.extract.settings import Settings
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.study.planned_suite import PlannedSuite

KEY_DIGITS = 8
"""Of a key in a folder's name; `matching` finds out if two settings ever share them."""


@dataclass(frozen=True)
class Selection:
    """Categories, and items of each."""

    categories: tuple[str, ...]
    items: int | None = None

    def counts(self, suite: PlannedSuite) -> dict[str, int]:
        """Items by category."""
        every = {name: suite.items.get(name, 0) for name in self.categories}
        return {name: count if self.items is None else min(count, self.items) for name, count in every.items()}


def joined(selections: Iterable[Selection]) -> Selection:
    """Return the smallest selection that holds all of these."""
    every = list(selections)
    categories = tuple(dict.fromkeys(name for selection in every for name in selection.categories))
    counts = [selection.items for selection in every]
    return Selection(categories, None if None in counts else max(count or 0 for count in counts))


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
    def selection(self) -> Selection:
        """The selection that all blocks together need."""
        return joined(self.selections.values())

    def selected(self, blocks: Collection[str]) -> Selection | None:
        """Return the selection that these blocks need together, None if none of them uses the run."""
        selections = [selection for name, selection in self.selections.items() if name in blocks]
        return joined(selections) if selections else None

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
        """The most inferences of an episode, in which conditions differ; 1 for what has no policy that acts."""
        return self.inferences / self.episodes if self.inferences else 1.0

    @property
    def work(self) -> str:
        """The kind of work that shares one rate: a model that acts, is captured without acting, or is asked."""
        return f"{self.model}, {'asked' if self.asks else 'captured' if self.captured else 'acting'}"

    @cached_property
    def key(self) -> str:
        """The hash of all that the settings decide but the selection, by which the run's folder is named."""
        if self.packed_key:
            return self.packed_key
        settings = self.settings
        decided = {
            **settings.identity(),
            "checkpoint": checkpoint_stamp(settings.model.checkpoint),
            "options": {name: str(value) for name, value in settings.model.options.items()},  # some are paths
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
        return f"{self.name.replace('/seed ', '-seed')}-{self.key}"

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


def checkpoint_stamp(checkpoint: str | None) -> Any:
    """Return what tells checkpoints apart without reading gigabytes for every plan.

    Of a folder or file, name, size and time of every file; else the hub id.
    """
    if checkpoint is None or not (folder := Path(checkpoint).expanduser()).exists():
        return checkpoint
    files = sorted(folder.rglob("*")) if folder.is_dir() else [folder]
    stats = [(file, file.stat()) for file in files if file.is_file()]
    return [[file.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns] for file, stat in stats]
