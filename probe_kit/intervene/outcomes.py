"""The outcomes of an intervention's conditions: per episode where the action goes, and how far it changed."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import open_arrays
from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.intervene.edited_cells import COLUMNS, NO_CELL, EditedCell, read_former_name
from probe_kit.intervene.exchange import Exchange

CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE = "clean", "image_swap", "instruction_swap", "noise"
"""Conditions: as in the run, the two pictures swapped, the counterpart's instruction, the noise drawn anew."""
RECORDED = "recorded"
"""The condition with recorded attention weights."""
DONOR, CONTROL_INPUT = "frame_swap", "control_input"
"""Conditions without sides: all inputs of the donor, and a meaningless change of the input."""
UNCHANGED = frozenset({CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE, RECORDED, DONOR, CONTROL_INPUT})
"""Conditions in which nothing inside the network is changed."""


def arrays_of(record: object, without: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Return the attributes of an object that are not None, as arrays by name."""
    return {
        name: np.asarray(value)
        for name, value in vars(record).items()
        if value is not None and name not in without
    }


def arrays_to_bytes(record: object, without: Sequence[str] = ()) -> bytes:
    """Return `arrays_of` an object as a `.npz`; the same numbers give the same bytes."""
    file = BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays_of(record, without))
    return file.getvalue()


def arrays_from_bytes(content: bytes) -> dict[str, Any]:
    """Return the arrays of a `.npz` by name."""
    with open_arrays(content) as arrays:
        return dict(arrays)


_FLAT = 1e-6
"""Share of a number's size below which its spread is rounding."""


def spread_of(clean: NDArray[np.float32]) -> Matrix:
    """Return (N,) 1 / variance of every number of the clean actions (E, N); 0 for numbers without spread."""
    values = np.ascontiguousarray(clean, np.float64)
    variance = values.var(axis=0)
    varies = np.sqrt(variance) > _FLAT * np.maximum(np.abs(values).max(axis=0, initial=0.0), _FLAT)
    return np.where(varies, 1 / np.where(varies, variance, 1.0), 0.0)


def directions_of(clean: Matrix, source: Matrix, weights: Matrix) -> tuple[Matrix, Matrix]:
    """Return the directions (E, N) along which displacements are measured, and the sources' own (E,).

    A displacement of x is (x − clean) · direction: its component toward the source, in root mean squares of
    spreads. It is zero where the source changes nothing.

    Args:
        clean: (E, N) clean actions.
        source: (E, N) actions of the sources.
        weights: (N,) weights of the numbers, see `spread_of`.
    """
    apart = source - clean
    count = max(int((weights > 0).sum()), 1)
    squares = (apart**2 * weights).sum(axis=1) / count
    lengths = np.sqrt(squares)
    scale = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1.0), 0.0)
    return apart * weights / count * scale[:, None], lengths


def displacements_toward(chunks: NDArray[np.float32], source: int) -> Matrix:
    """Return the displacements (K, E) toward the source's action of K conditions.

    Args:
        chunks: (K, E, N) actions, clean ones first.
        source: Row of the source's condition.
    """
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    directions, _ = directions_of(values[0], values[source], spread_of(chunks[0]))
    return np.asarray(((values - values[0]) * directions).sum(axis=2))


def sizes(chunks: NDArray[np.float32]) -> Matrix:
    """Return (K, E) the distance of K conditions' actions from clean ones, in root mean squares of spreads."""
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    weights = spread_of(chunks[0])
    count = max(int((weights > 0).sum()), 1)
    return np.asarray(np.sqrt(((values - values[0]) ** 2 * weights).sum(axis=2) / count))


BY_CONDITION = (
    "displacement", "max_action_change", "edit_log", "episode_outcomes", "toward", "size", "chunks",
    "token_counts",
)  # fmt: skip
"""Arrays with conditions along their first axis."""
UNSTORED = ("seed_text", "chunks", "mass", "inferences", "patches")
"""Fields that a stored intervention does not have, or has in a file of its kind's own."""


@dataclass(frozen=True)
class ConditionOutcomes:
    """The numbers of K conditions in E episodes of a run.

    `chunks`, `mass`, `inferences` and `patches` are there while an intervention is made.

    Attributes:
        conditions: Names of the K conditions, the clean one first.
        episodes: (E,) ids of the episodes.
        items: (E,) item of every episode.
        groups: (E,) group of items of every episode.
        categories: (E,) category of every episode.
        sides: (E,) side of the correct picture; empty without sides.
        displacement: (K, E) metres from the middle, left positive; without sides toward the source's action.
        max_action_change: (K, E) largest difference of any action from the clean one's.
        edit_log: (K, E, 5) logs of the edits, see `LOG_FIELDS`.
        replay_error: (E,) difference of the clean inference from the stored one; NaN where the run has none.
        episode_outcomes: (K, E) zone where the cube ended, correct, wrong or oob, for episodes that were played to
            their end; in an environment success or failure. None where nothing was executed. With it,
            `displacement` is the cube's, or 1 for success and 0 without, and `max_action_change` and
            `replay_error` are of the trajectory.
        toward: (K, E) displacement toward the source's action, in spreads of clean actions; None where whole
            episodes were played.
        size: (K, E) size of the change, in spreads of clean actions; None where whole episodes were played.
        token_counts: (K, E, 2) numbers of tokens that are cut, and of the others, of cuts of attention; 0 where
            nothing is cut. None for other kinds, and in outcomes of earlier versions.
        seed_text: Text of the run by which random draws are made.
        chunks: (K, E, N) all numbers of the actions of first inferences; None where whole episodes were played,
            and in stored outcomes.
        mass: (N, B, I, H, R) attention of N inferences; None where it was not recorded.
        inferences: (N, 2) rows of these inferences in the run's episodes, and their calls; None likewise.
        patches: (N, B, P) attention on single patches; None where it is not known.
        sites: (K,) place that each condition edits, empty for a condition that edits no single cell; so are all
            columns of `EditedCell`. None, as in outcomes of earlier versions, reads them from the names.
        roles: (K,) role of the edited tokens.
        directions: (K,) name of the direction.
        coefficients: (K,) coefficient of steering, as text.
        parts: (K,) what is done with the cell.
    """

    AXES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("episodes", "items", "groups", "categories", "sides"), "U E"),
        **dict.fromkeys(("displacement", "max_action_change", "toward", "size"), "f KE"),
        **dict.fromkeys(("conditions", *COLUMNS), "U K"),
        "edit_log": "f KEL",
        "replay_error": "f E",
        "episode_outcomes": "U KE",
        "token_counts": "iu KE2",
    }

    conditions: tuple[str, ...]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    categories: NDArray[np.str_]
    sides: NDArray[np.str_]
    displacement: NDArray[np.float64]
    max_action_change: NDArray[np.float64]
    edit_log: NDArray[np.float64]
    replay_error: NDArray[np.float64]
    episode_outcomes: NDArray[np.str_] | None = None
    toward: NDArray[np.float64] | None = None
    size: NDArray[np.float64] | None = None
    token_counts: NDArray[np.int64] | None = None
    seed_text: str = ""
    chunks: NDArray[np.float32] | None = None
    mass: NDArray[np.float32] | None = None
    inferences: NDArray[np.int64] | None = None
    patches: NDArray[np.float32] | None = None
    sites: tuple[str, ...] | None = None
    roles: tuple[str, ...] | None = None
    directions: tuple[str, ...] | None = None
    coefficients: tuple[str, ...] | None = None
    parts: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("conditions", *COLUMNS):
            if (texts := getattr(self, name)) is not None:
                # Stored texts are an array, and comparisons with one are element by element.
                object.__setattr__(self, name, tuple(map(str, texts)))

    @property
    def cells(self) -> tuple[EditedCell, ...]:
        """The cell that each of the K conditions edits."""
        if self.sites is None:
            return tuple(NO_CELL if name in UNCHANGED else read_former_name(name) for name in self.conditions)
        return tuple(EditedCell(*cell) for cell in zip(*(getattr(self, name) for name in COLUMNS), strict=True))

    @property
    def is_scene(self) -> bool:
        """Whether the correct picture lies on a side; else displacements are toward the source's action."""
        return bool(self.sides.size) and bool(self.sides[0])

    def of(self, condition: str) -> NDArray[np.float64]:
        """Return the displacement (E,) of one condition."""
        return np.asarray(self.displacement[self.conditions.index(condition)])

    @property
    def correct_sign(self) -> NDArray[np.float64]:
        """The side of the correct picture (E,): +1 for left, −1 for right, or where nothing has a side."""
        return np.where(self.sides == "left", 1.0, -1.0)

    def exchange(self, source: str = IMAGE_SWAP) -> Exchange | None:
        """Return the effect of a condition with other inputs, in one category; None if it was not played."""
        if source not in self.conditions:
            return None
        flips = derive_seed("sign flips", self.seed_text, str(self.categories[0]))
        pair = self.of(CLEAN), self.of(source)
        return Exchange(*pair, -self.correct_sign, self.groups, self.items, self.seed_text, flips)

    @property
    def counts(self) -> dict[str, Any]:
        """The category, and numbers of episodes, items and groups, as columns of a row; of one category."""
        sizes = {"n_items": np.unique(self.items).size, "n_groups": np.unique(self.groups).size}
        return {"category": str(self.categories[0]), "n_episodes": self.episodes.size, **sizes}

    def of_episodes(self, selected: NDArray[np.bool_]) -> "ConditionOutcomes":
        """Return some of the episodes, those where `selected` (E,) is true."""
        cut: dict[str, Any] = {
            name: np.compress(selected, value, int(name in BY_CONDITION))
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(self, **cut)

    def by_category(self) -> "list[tuple[str, ConditionOutcomes]]":
        """Return every category with its episodes, in the order of the episodes."""
        names = dict.fromkeys(map(str, self.categories))
        return [(name, self.of_episodes(self.categories == name)) for name in names]

    def in_spreads(self) -> "ConditionOutcomes":
        """Return the outcomes with displacements toward the source's action, and sizes; of first inferences."""
        if self.chunks is None:
            return self
        # Toward the source's action, of all its inputs if they were played.
        references = [name for name in (DONOR, IMAGE_SWAP) if name in self.conditions]
        toward = displacements_toward(self.chunks, self.conditions.index(references[0])) if references else None
        displacement = self.displacement
        if toward is not None and not self.is_scene:
            # Where no inference gave another action, a displacement is none, or was estimated.
            displacement = np.where(self.max_action_change > 0, toward, displacement)
        return replace(self, displacement=displacement, toward=toward, size=sizes(self.chunks))

    @classmethod
    def joined(cls, parts: "Sequence[ConditionOutcomes]") -> "ConditionOutcomes":
        """Return the episodes of all parts, one after the other."""
        parts = [part for part in parts if part.episodes.size] or parts[:1]
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts], axis=int(name in BY_CONDITION))
            for name, value in vars(parts[0]).items()
            if isinstance(value, np.ndarray)
        }
        return replace(parts[0], **arrays)

    def to_bytes(self) -> bytes:
        """Return a `.npz`; the same numbers give the same bytes."""
        return arrays_to_bytes(self, UNSTORED)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One row of effects, made from outcomes; every kind adds columns."""

    category: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values by column."""
        return asdict(self)
