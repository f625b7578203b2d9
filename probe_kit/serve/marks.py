"""Marks: what a client says of its episodes, in one optional key of an observation."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from probe_kit._system.escaping import UNSAFE
from probe_kit.errors import ObservationError

KEY = "probe_kit/episode"
"""The key of a mark, beside those of an observation."""
LONGEST = 200
"""The most characters of an id, a group or a fact's name."""
MOST_FACTS = 64
LARGEST_STEP = 10**9
SUCCESS = "success"
"""The fact that becomes the outcome."""
_PARTS = frozenset({"id", "group", "step", "condition", "end", "facts"})

Facts = Mapping[str, float | bool]


@dataclass(frozen=True)
class Mark:
    """The statement of a client on the episode of an observation, or on its end.

    Attributes:
        id: The name of the episode; empty for an end without one.
        group: What folds keep together; None for the episode alone.
        step: The number of actions that were executed before the observation; None where that is not said.
        condition: The condition of the episode; None for one that is drawn.
        columns: Further columns of the episode's row, such as the name of its task.
        end: Whether the episode is over.
        facts: Numbers and truth values of the whole episode, by name.
    """

    id: str = ""
    group: str | None = None
    step: int | None = None
    condition: str | None = None
    end: bool = False
    facts: Facts = field(default_factory=lambda: MappingProxyType({}))
    columns: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


def read_mark(value: Any) -> Mark:
    """Return the mark that a client sent. Raises ObservationError for what is none."""
    if not isinstance(value, Mapping):
        raise ObservationError(f"{KEY} is a {type(value).__name__}; expected a map such as {{'id': 'task3/7'}}")
    if strange := sorted(str(name) for name in value.keys() - _PARTS):
        raise ObservationError(f"{KEY} has the entry {strange[0]!r:.80}; expected {', '.join(sorted(_PARTS))}")
    end = value.get("end", False)
    if not isinstance(end, bool):
        raise ObservationError(f"{KEY}: end is {end!r:.80}; expected true")
    if not end and ("facts" in value or "id" not in value):
        what = "facts come with end" if "facts" in value else "it has no id"
        raise ObservationError(f"{KEY}: {what}; expected an id with an observation, and {{'end': true}} alone")
    name = plain_name(value["id"], "id") if "id" in value else ""
    group = plain_name(value["group"], "group") if value.get("group") is not None else None
    condition = plain_name(value["condition"], "condition") if value.get("condition") is not None else None
    return Mark(name, group, _step(value.get("step")), condition, end, read_facts(value.get("facts") or {}))


def plain_name(value: Any, what: str) -> str:
    """Return an id, a group or a condition as text. Raises ObservationError for anything but plain characters."""
    text = str(value) if isinstance(value, int) and not isinstance(value, bool) else value
    if not isinstance(text, str) or not text.strip() or len(text) > LONGEST or UNSAFE.search(text):
        raise ObservationError(f"{KEY}: the {what} is {value!r:.80}; expected 1 to {LONGEST} plain characters")
    return text


def _step(value: Any) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST_STEP:
        raise ObservationError(f"{KEY}: step is {value!r:.80}; expected the number of actions executed before")
    return int(value)


def read_facts(value: Any) -> Facts:
    """Return facts of an episode. Raises ObservationError for what is no number or truth value."""
    if not isinstance(value, Mapping) or len(value) > MOST_FACTS:
        raise ObservationError(f"{KEY}: facts are {value!r:.80}; expected at most {MOST_FACTS} numbers by name")
    facts: dict[str, float | bool] = {}
    for name, number in value.items():
        plain = number.item() if isinstance(number, np.generic) else number
        plain_name(name, "name of a fact")
        if not isinstance(plain, bool | int | float) or not np.isfinite(plain):
            raise ObservationError(
                f"{KEY}: the fact {name!r} is {plain!r:.80}; expected a finite number or a truth value"
            )
        if name == SUCCESS and plain not in (0, 1):
            raise ObservationError(
                f"{KEY}: the fact {SUCCESS!r} is {plain!r:.80}; expected a truth value. Give a score another name"
            )
        facts[name] = bool(plain) if name == SUCCESS else plain
    return facts
