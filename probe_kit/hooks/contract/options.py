"""Options of single families: declared by the family, given as `-M key=value`, checked before loading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from probe_kit.errors import UsageError

_WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_EXPECTED = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}

LARGEST = 1 << 31
"""Of a number that is an option; larger ones, and NaN, are mistakes."""

Kind = type[bool] | type[int] | type[float] | type[str]


@dataclass(frozen=True)
class Option:
    """One option of a family.

    kind: bool, int, float or str. help: one line for `probe-kit models NAME`. default: as people read it.
    choices: the admissible values; empty for any of the kind.
    """

    name: str
    kind: Kind
    help: str
    default: str = ""
    choices: tuple[Any, ...] = ()

    def value(self, given: Any) -> Any:
        """`given`, text or already of the kind, as the loader gets it. Raises UsageError."""
        value = self._read(given)
        if self.choices and value not in self.choices:
            allowed = ", ".join(map(str, self.choices))
            raise UsageError(f"model option {self.name} is {given!r}; expected one of {allowed}")
        return value

    def _read(self, given: Any) -> Any:
        if self.kind is float and type(given) is int:
            return float(given)
        if type(given) is self.kind:
            return given
        try:
            if not isinstance(given, str):
                raise ValueError
            value = _WORDS[given.lower()] if self.kind is bool else self.kind(given)
            if isinstance(value, int | float) and not abs(value) <= LARGEST:
                raise ValueError
            return value
        except (ValueError, KeyError, OverflowError):
            raise UsageError(f"model option {self.name} is {given!r}; expected {_EXPECTED[self.kind]}") from None


def read_pairs(pairs: Sequence[str]) -> dict[str, str]:
    """`key=value` texts as a dict. Raises UsageError for another form and for a key given twice."""
    found: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"model option {pair!r} is not KEY=VALUE, such as -M unnorm_key=bridge_orig")
        name = key.strip().replace("-", "_")
        if name in found:
            raise UsageError(f"model option {name} is given twice: {found[name]!r} and {value!r}")
        found[name] = value
    return found


def check_options(family: str, declared: Sequence[Option], given: Mapping[str, Any]) -> dict[str, Any]:
    """The given options as the loader gets them. Raises UsageError for one that the family does not declare."""
    known = {option.name: option for option in declared}
    for name in sorted(given):
        if name not in known:
            near = get_close_matches(name, known, n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            there = f"it has {', '.join(sorted(known))}" if known else "it has none"
            raise UsageError(f"{family} has no model option {name}; {there}.{hint}")
    return {name: known[name].value(value) for name, value in given.items()}
