"""The source of a run, the files and choices of the processes that played it, and its first items."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from probe_kit.errors import UsageError
from probe_kit.runs.layout import DATASET, ENVIRONMENT
from probe_kit.suite.categories import check_categories

if TYPE_CHECKING:
    import pandas as pd


ORIGIN = "origin"
"""The entry of a certificate that holds the origin of its process."""
SUITE = "suite"
SCENE = "scene"
SERVED = "served"
"""The kind of a run whose observations clients sent to a policy server."""
OF_SCENE = "scene."
"""The beginning of the name of a file that a field of the scene gives."""


@dataclass(frozen=True)
class Origin:
    """The files and choices of one process that played episodes of a run; none is part of the run's identity.

    Attributes:
        files: Absolute paths by field of the source's settings, such as `suite`, `folder` or `scene.background`.
        checkpoint: An absolute folder, a hub id, or a word of the family; empty if unknown.
        options: The options of the family as they were passed, files and folders absolute.
        random_weights: Whether random weights were requested. A file that calls its weights random is no request.
        weights_seed: The seed of requested random weights.
        repositories: The commits of further repositories of the hub, by name, which a repetition reads again.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    random_weights: bool = False
    weights_seed: int = 0
    repositories: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the origin in the record of a process; an empty one where it has none."""
        return cls(**record.get(ORIGIN, {}))

    @property
    def suite(self) -> str | None:
        """The suite's folder; None for the embedded suite and for runs without one."""
        return self.files.get(SUITE)

    @property
    def scene_files(self) -> dict[str, Path]:
        """The files of the scene by its fields."""
        return {
            name.removeprefix(OF_SCENE): Path(path)
            for name, path in self.files.items()
            if name.startswith(OF_SCENE)
        }

    def to_json(self) -> dict[str, Any]:
        """Return the origin as plain values."""
        return asdict(self)


@dataclass(frozen=True)
class RunSource:
    """The observations that a run is made of.

    Attributes:
        kind: The kind of the source's settings, such as `scene` or `lerobot`; `arrays` for a run that probe_kit
            did not play.
        name: The name with what identifies it, such as `NAME@VERSION#HASH` of a suite.
        words: A clause that says what the run did with the source.
    """

    kind: str
    name: str
    words: str

    @property
    def is_scene(self) -> bool:
        """Whether these are scenes, whose questions have a correct picture on a side."""
        return self.kind == SCENE

    @property
    def subject(self) -> str:
        """The things that its model was shown, in a word; for a source of your own its kind."""
        words = {SCENE: "scenes", "lerobot": "recordings", "env": "environments", SERVED: "served observations"}
        return words.get(self.kind, self.kind)

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "RunSource":
        """Return the source that the settings of a stored run name."""
        if DATASET in settings:
            name = f"{settings['recording']['name']}#{settings[DATASET]['meta_blake2b'][:12]}"
            kind = str(settings[DATASET].get("kind", "lerobot"))
            if kind == SERVED:
                return cls(kind, name, f"its model was served to clients ({name}), which acted elsewhere")
            subject = "recordings" if kind == "lerobot" else kind
            return cls(kind, name, f"it shows {subject} ({name}), and its model did not act")
        if ENVIRONMENT in settings:
            name = f"{settings['played']['name']}@{settings[ENVIRONMENT]['revision']}"
            return cls("env", name, f"it plays an environment of your own ({name})")
        name = str(settings["suite"]["identity"])
        return cls(SCENE, name, f"it plays {name}")


def select_items(
    items: "pd.DataFrame", categories: Sequence[str] | None, per_category: int | None, where: str
) -> list[str]:
    """Return the ids of the first items of some categories, in the order of the plan.

    Args:
        items: The table `Run.items`.
        categories: Slugs of categories; None for all.
        per_category: The number of items per category; None for all.
        where: The run, for messages.

    Raises:
        UnknownCategoryError: For a category the run lacks.
        UsageError: For no category. Also for a number that is not positive, exceeds what a category has, or would
            separate role-exchanged twins.
    """
    categories_of_run = list(dict.fromkeys(items["category"].astype(str)))
    selected = categories_of_run if categories is None else check_categories(categories, categories_of_run)
    if not selected:
        raise UsageError("no category selected. Name at least one, or leave `categories` out for all.")
    item_ids: list[str] = []
    for category in selected:
        planned = items[items["category"] == category]
        count = len(planned) if per_category is None else per_category
        if not 0 < count <= len(planned):
            raise UsageError(
                f"items is {count}, but {where} plans {len(planned)} items of {category!r}; give a number from 1 "
                f"to {len(planned)}, or play more with `probe-kit extract`"
            )
        _check_twins(planned, count, category)
        item_ids += planned["item_id"].iloc[:count].tolist()
    return item_ids


def _check_twins(items: "pd.DataFrame", count: int, category: str) -> None:
    """Raise UsageError if the first items hold one of two role-exchanged twins, and the others the other one."""
    pairs = items["pair_id"]
    separated = set(pairs.iloc[:count].dropna()) & set(pairs.iloc[count:].dropna())
    if separated:
        raise UsageError(
            f"items is {count}, which would keep one of the role-exchanged twins {min(separated)!r} of "
            f"{category!r} and drop the other. Give an even number."
        )
