"""What every kind of intervention is made of: names of conditions, effects, and their test against controls.

Loads neither torch nor a simulator.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edit_engine import LOG_FIELDS
from probe_kit.intervene.kinds.reach import TILES_APART
from probe_kit.intervene.store.answers import ConditionOutcomes
from probe_kit.intervene.store.settings import FIRST_CHUNK
from probe_kit.statistics.sign_flips import max_t

if TYPE_CHECKING:
    import pandas as pd

Values = NDArray[np.float64]
SEPARATOR = "|"
CONTROL = "control-"


# -- what a kind's functions are given and give ---------------------------------------------------------------


class EffectLike(Protocol):
    """One row of effects."""

    def to_json(self) -> dict[str, Any]:
        """Plain values by column."""


class CategoryVerdict(Protocol):
    """The verdict of a category, and what it rests on."""

    @property
    def verdict(self) -> str:
        """In a few words."""

    @property
    def explanation(self) -> str:
        """What it rests on, or why there is none."""


@dataclass(frozen=True)
class Measurement:
    """What effects are computed from.

    seed_text: of the run, by which random draws are made. read: a further stored file by its name.
    tiles_apart: metres between the tiles of the run's scene.
    """

    outcomes: ConditionOutcomes
    seed_text: str
    settings: Mapping[str, Any]
    certificate: Mapping[str, Any]
    read: Callable[[str], bytes]
    key: str = ""
    tiles_apart: float = TILES_APART

    @property
    def readout(self) -> str:
        """`first-chunk` or `per-step`."""
        return str(self.settings.get("readout", FIRST_CHUNK))


@dataclass(frozen=True)
class TableContext:
    """What a table says besides its rows. subject: model and suite. verdicts: by category.

    explains: whether the caption says what each verdict rests on, which sentences say too.
    """

    measurement: Measurement
    subject: str
    verdicts: Mapping[str, CategoryVerdict]
    explains: bool = True


# -- names of conditions -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConditionName:
    """The parts of a condition's stored name, `place|role|direction|coefficient`; the last ones may be missing."""

    place: str
    role: str = ""
    direction: str = ""
    coefficient: str = ""

    @classmethod
    def parse(cls, condition: str) -> "ConditionName":
        """Take a stored name apart."""
        return cls(*condition.split(SEPARATOR))

    def __str__(self) -> str:
        parts = (self.place, self.role, self.direction, self.coefficient)
        return SEPARATOR.join(filter(None, parts))

    @property
    def is_control(self) -> bool:
        """Whether its direction is a random one that another is compared with."""
        return self.direction.startswith(CONTROL)

    def is_control_of(self, other: "ConditionName") -> bool:
        """Whether `other`, no control itself, is compared with this one."""
        same = (self.place, self.role, self.coefficient) == (other.place, other.role, other.coefficient)
        return self.is_control and bool(other.direction) and not other.is_control and same


# -- effects -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EffectRow:
    """What one edit did in one category; the columns that all kinds of edits have.

    place: sites that were edited. role: of the tokens. direction: empty if they were edited in full. net, net_ci:
    the kind's share of episodes, with its 95 % interval by groups. max_action_change: largest difference in any
    action of any episode; 0 is bit for bit. fires, no_op_fires: of edited sites in all episodes, and those that
    changed nothing. relative_change: how far tokens were moved, in their own norms. key: of the intervention.
    """

    category: str
    place: str
    role: str
    direction: str
    is_control: bool
    n_episodes: int
    n_items: int
    net: float
    net_ci: tuple[float, float]
    max_action_change: float
    fires: int
    no_op_fires: int
    relative_change: float
    key: str = ""

    @property
    def name(self) -> str:
        """What was edited, in a few words."""
        return " ".join(filter(None, (self.place, self.role, self.direction)))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def common_columns(outcomes: ConditionOutcomes, row: int, name: ConditionName) -> dict[str, Any]:
    """The columns of `EffectRow` that need no statistics, of one condition. outcomes: of one category."""
    logged = dict(zip(LOG_FIELDS, outcomes.edit_log[row].T, strict=True))
    norm = float((logged["norm"] * logged["fires"]).sum())
    return {
        "place": name.place,
        "role": name.role,
        "direction": name.direction,
        "is_control": name.is_control,
        "n_episodes": outcomes.episodes.size,
        "n_items": np.unique(outcomes.items).size,
        "max_action_change": float(outcomes.max_action_change[row].max()),
        "fires": int(logged["fires"].sum()),
        "no_op_fires": int(logged["no_op_fires"].sum()),
        "relative_change": float((logged["change"] * logged["fires"]).sum()) / norm if norm else 0.0,
    }


class ControlTest(NamedTuple):
    """One condition against its controls. controls: their rows. beyond: (E,) what it does beyond their mean.

    t, p, p_fwe: one-sided, by sign flips of whole groups; p_fwe against the largest t of the category. All are
    None for a condition that is not tested.
    """

    controls: list[int]
    beyond: Values | None = None
    t: float | None = None
    p: float | None = None
    p_fwe: float | None = None


def test_against_controls(
    values: Values,
    names: Sequence[ConditionName],
    outcomes: ConditionOutcomes,
    seed_text: str,
    untested: Collection[int],
    no_controls: Collection[int],
) -> list[ControlTest]:
    """Every condition that is no control against its own controls, in the order of the conditions.

    values: (K, E) what is tested to be above zero. outcomes: of one category. seed_text: of the run, by which
    sign flips are drawn. untested: further rows that are not tested. no_controls: rows that are no controls.
    """
    controls = [
        [at for at, other in enumerate(names) if other.is_control_of(name) and at not in no_controls]
        for name in names
    ]
    found = [ControlTest(own) for own in controls]
    tested = [at for at, name in enumerate(names) if not name.is_control and at not in untested]
    if not tested:
        return found
    beyond = np.array(
        [values[at] - values[controls[at]].mean(axis=0) if controls[at] else values[at] for at in tested]
    )
    seed = derive_seed("sign flips", seed_text, str(outcomes.categories[0]))
    for at, own, *tests in zip(tested, beyond, *max_t(beyond, outcomes.items, outcomes.groups, seed), strict=True):
        found[at] = ControlTest(controls[at], own, *map(float, tests))
    return found


def count_edits(found: Sequence[str], tried: int, most: int = 3) -> str:
    """How many of the edits that were tried, and the first of them by name."""
    if not found:
        return f"none of {tried}"
    named, further = found[:most], len(found) - most
    return f"{len(found)} of {tried} ({', '.join(named)}{f' and {further} more' if further > 0 else ''})"


def by_category[Row: EffectRow](rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of edits by category, controls and clean conditions left out."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if not row.is_control:
            found.setdefault(row.category, []).append(row)
    return found


def frame_of(rows: Sequence[EffectLike]) -> "pd.DataFrame":
    """One line per row; intervals as two columns at the end."""
    import pandas as pd

    flat = []
    for row in rows:
        plain = row.to_json()
        limits = {name: plain.pop(name) or (None, None) for name in list(plain) if name.endswith("_ci")}
        ends = {
            f"{name}_{end}": pair[at] for name, pair in limits.items() for at, end in enumerate(("low", "high"))
        }
        flat.append({**plain, **ends})
    return pd.DataFrame(flat)
