"""Attention shares by block, iteration, head and role. Reads stored numbers; needs no model.

Descriptive: nothing of it enters a verdict.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_arrays import open_arrays
from probe_kit.errors import UsageError
from probe_kit.intervene.edits.sites import ALL, TILE_ROLES
from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.store.answers import ATTENTION, ATTENTION_FILE
from probe_kit.intervene.store.selection import StoredResult, stored_results
from probe_kit.statistics.bootstrap import GAINS, units_seed
from probe_kit.statistics.student import student_interval
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

Axis = Literal["block", "iteration", "head", "call"]
_AXES: Mapping[str, int] = {"block": 1, "iteration": 2, "head": 3}
CORRECT, OTHER, ACTION = "image.correct", "image.other", "action"
"""Made of what is stored: the tile of the correct picture, the other one, and the acting stream itself."""
Shares = NDArray[np.float64]


@dataclass(frozen=True)
class AttentionShares:
    """Attention of N inferences. roles: names of R, the first one `all`.

    episodes, groups, categories, sides: (N,), `sides` those of the correct picture. calls: (N,) inference of the
    episode, counted from 0. mass: (N, B, I, H, R) float32 shares; NaN where a block is not read in an iteration
    and of roles that no token of an inference plays, such as a tile behind the arm.
    """

    roles: tuple[str, ...]
    episodes: NDArray[np.str_]
    groups: NDArray[np.str_]
    categories: NDArray[np.str_]
    sides: NDArray[np.str_]
    calls: NDArray[np.int64]
    mass: NDArray[np.float32]

    def to_bytes(self) -> bytes:
        """As a `.npz`; the same numbers give the same bytes."""
        file = BytesIO()
        np.savez_compressed(file, allow_pickle=False, **{**vars(self), "roles": np.array(self.roles)})
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Load what `to_bytes` made."""
        with open_arrays(content) as arrays:
            found: dict[str, Any] = {own.name: arrays[own.name] for own in fields(cls)}
        return cls(**{**found, "roles": tuple(map(str, found["roles"]))})

    @classmethod
    def of(cls, measurement: Measurement) -> Self:
        """Of a stored intervention of the kind `attention`. Raises RunDamagedError if it was changed."""
        return cls.from_bytes(measurement.read(ATTENTION_FILE))

    def only(self, chosen: NDArray[np.bool_]) -> Self:
        """Some of the inferences. chosen: (N,)."""
        return type(self)(
            self.roles, *(getattr(self, own.name)[chosen] for own in fields(self) if own.name != "roles")
        )

    def by_category(self) -> list[tuple[str, Self]]:
        """Every category with its inferences, in the order of the episodes."""
        return [(name, self.only(self.categories == name)) for name in dict.fromkeys(map(str, self.categories))]

    def shares(self) -> dict[str, Shares]:
        """By role (N, B, I, H): those that are stored, tiles also by where the answer lies, and the rest of 1."""
        found = {role: self.mass[..., at].astype(np.float64) for at, role in enumerate(self.roles)}
        if set(TILE_ROLES) <= found.keys():
            left, right = (found[role] for role in TILE_ROLES)
            is_left = (self.sides == "left")[:, None, None, None]
            found |= {CORRECT: np.where(is_left, left, right), OTHER: np.where(is_left, right, left)}
        return {**found, ACTION: 1 - found[ALL]} if ALL in found else found

    def rows(self, by: Sequence[Axis] = ("block", "iteration", "head")) -> "list[AttentionRow]":
        """One per category, role and place along the axes `by`; means over the others, every episode alike.

        Raises UsageError for an axis that does not exist.
        """
        if unknown := set(by) - set(get_args(Axis)):
            raise UsageError(f"attention has no axis {min(unknown)!r}; it has {', '.join(get_args(Axis))}")
        found = []
        for category, own in self.by_category():
            calls = np.unique(own.calls).tolist() if "call" in by else [None]
            for call in calls:
                part = own if call is None else own.only(own.calls == call)
                found += part._rows(category, call, by)
        return found

    def frame(self, by: Sequence[Axis] = ("block", "iteration", "head")) -> "pd.DataFrame":
        """`rows` as a data frame, with the columns of the axes that are asked for."""
        import pandas as pd

        unused = [axis for axis in get_args(Axis) if axis not in by]
        columns = [own.name for own in fields(AttentionRow)]
        return pd.DataFrame([asdict(row) for row in self.rows(by)], columns=columns).drop(columns=unused)

    def correct_minus_other(self, seed_text: str) -> "dict[int, tuple[float, tuple[float, float]]]":
        """By block, the share on the correct picture's tile minus the other's, with its 95 % interval by groups.

        Of one category; a mean over iterations, heads and calls. Empty without tiles.
        """
        shares = self.shares()
        if CORRECT not in shares:
            return {}
        episodes, groups = self._episodes()
        found = {}
        for block in range(self.mass.shape[1]):
            apart = (shares[CORRECT] - shares[OTHER])[:, block : block + 1]
            if np.isnan(apart).all():
                continue
            every = _mean(_per_episode(apart, episodes), (1, 2, 3))
            seen = ~np.isnan(every)
            values, units = every[seen], groups[seen]
            limits = student_interval(values, units, units_seed(units, seed_text), GAINS)
            found[block] = float(values.mean()), limits
        return found

    def _rows(self, category: str, call: int | None, by: Sequence[Axis]) -> "list[AttentionRow]":
        episodes, _ = self._episodes()
        over = tuple(at for axis, at in _AXES.items() if axis not in by)
        found = []
        for role, values in self.shares().items():
            every = _per_episode(values, episodes)
            means = _mean(every, (0, *over))
            for place, share in np.ndenumerate(means):
                if not np.isnan(share):
                    at: dict[str, Any] = dict(
                        zip((axis for axis in _AXES if axis in by), map(int, place), strict=True)
                    )
                    named: dict[str, Any] = {"category": category, "role": role, "call": call}
                    found.append(AttentionRow(**named, **at, share=float(share), n_episodes=len(every)))
        return found

    def _episodes(self) -> tuple[NDArray[np.int64], NDArray[np.str_]]:
        """(N,) which of the E episodes an inference is of, and the (E,) groups of these."""
        _, first, which = np.unique(self.episodes, return_index=True, return_inverse=True)
        return which, self.groups[first]


@dataclass(frozen=True, kw_only=True)
class AttentionRow:
    """How much attention lies on one role's tokens, in one category: a share, of 1 in all.

    block, iteration, head, call: of which; None for the mean over all.
    """

    category: str
    role: str
    block: int | None = None
    iteration: int | None = None
    head: int | None = None
    call: int | None = None
    share: float
    n_episodes: int

    def to_json(self) -> dict[str, Any]:
        """Plain values, without the axes that it is a mean over."""
        axes = get_args(Axis)
        return {name: value for name, value in asdict(self).items() if value is not None or name not in axes}


def measured_attention(measurement: Measurement) -> list[AttentionRow]:
    """Shares by block, iteration, head and role. Raises RunDamagedError."""
    return AttentionShares.of(measurement).rows()


def attention_notes(rows: Sequence[AttentionRow], measurement: Measurement) -> list[str]:
    """What a reader must know."""
    del rows, measurement
    return [
        "Attention is descriptive, not causal, and does not enter the verdict. To test what is read, run --kind "
        "interchange --sites kv.*"
    ]


def attention_in_use(run: RunReader) -> set[str]:
    """Keys of the stored interventions that tables and figures read. Raises RunDamagedError."""
    return {result.stored.key for result, _ in preferred_attention(run).values()}


def stored_attention(run: RunReader) -> dict[str, AttentionShares]:
    """By category, the one of most episodes, and of these of most roles; empty if there is none.

    Raises RunDamagedError.
    """
    return {category: category_shares for category, (_, category_shares) in preferred_attention(run).items()}


def preferred_attention(run: RunReader) -> dict[str, tuple[StoredResult, AttentionShares]]:
    """`stored_attention`, and of which stored intervention each is."""
    found: dict[str, tuple[StoredResult, AttentionShares]] = {}
    read: dict[str, AttentionShares] = {}
    for result in stored_results(run, ATTENTION):
        key, before = result.stored.key, found.get(result.category)
        if key not in read:
            read[key] = AttentionShares.from_bytes(result.stored.bundle.read(ATTENTION_FILE))
        category_shares = read[key].only(read[key].categories == result.category)
        if before is None or (before[0].rank, len(before[1].roles)) <= (result.rank, len(category_shares.roles)):
            found[result.category] = result, category_shares
    return found


def _per_episode(values: Shares, episodes: NDArray[np.int64]) -> Shares:
    """(E, …) means over the inferences of every episode, of those that are not NaN."""
    sums, counts = (np.zeros((episodes.max() + 1, *values.shape[1:])) for _ in range(2))
    known = ~np.isnan(values)
    np.add.at(sums, episodes, np.where(known, values, 0.0))
    np.add.at(counts, episodes, known)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _mean(values: Shares, axes: tuple[int, ...]) -> Shares:
    """Mean over some axes of what is not NaN; NaN where nothing is."""
    known = ~np.isnan(values)
    counts = known.sum(axis=axes)
    sums = np.where(known, values, 0.0).sum(axis=axes)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
