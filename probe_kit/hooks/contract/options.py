"""Options of single families: declared by the family, given as `-M key=value`, checked before loading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from probe_kit.errors import UsageError

# For text options of kind bool; Python's own `bool("false")` is True.
_WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_EXPECTED = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}

LARGEST = 1 << 31
"""Of a number that is an option; larger ones, and NaN, are mistakes."""

Kind = type[bool] | type[int] | type[float] | type[str]


@dataclass(frozen=True)
class Option:
    """One option of a family.

    kind: bool, int, float or str. help: one line for `probe-kit models NAME`. default: as people read it.
    choices: the admissible values; empty for any of the kind. is_path: whether it may name a file or folder, which
    a run finds again wherever its command was typed.
    """

    name: str
    kind: Kind
    help: str
    default: str = ""
    choices: tuple[Any, ...] = ()
    is_path: bool = False

    def value(self, raw: Any) -> Any:
        """Return `raw`, text or already of the kind, as the loader gets it. Raises UsageError."""
        value = self._read(raw)
        if self.choices and value not in self.choices:
            allowed = ", ".join(map(str, self.choices))
            raise UsageError(f"model option {self.name} is {raw!r}; expected one of {allowed}")
        return value

    def _read(self, raw: Any) -> Any:
        if self.kind is float and type(raw) is int:
            return float(raw)
        if type(raw) is self.kind:
            return raw
        try:
            if not isinstance(raw, str):
                raise ValueError
            value = _WORDS[raw.lower()] if self.kind is bool else self.kind(raw)
            if isinstance(value, int | float) and not abs(value) <= LARGEST:  # `not <=` also catches NaN
                raise ValueError
            return value
        except (ValueError, KeyError, OverflowError):
            raise UsageError(f"model option {self.name} is {raw!r}; expected {_EXPECTED[self.kind]}") from None


def read_pairs(pairs: Sequence[str]) -> dict[str, str]:
    """`key=value` texts as a dict. Raises UsageError for another form and for a key given twice."""
    options: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"model option {pair!r} is not KEY=VALUE, such as -M unnorm_key=bridge_orig")
        name = key.strip().replace("-", "_")
        if name in options:
            raise UsageError(f"model option {name} is given twice: {options[name]!r} and {value!r}")
        options[name] = value
    return options


def check_options(family: str, declared: Sequence[Option], options: Mapping[str, Any]) -> dict[str, Any]:
    """The given options as the loader gets them. Raises UsageError for one that the family does not declare."""
    by_name = {option.name: option for option in declared}
    for name in sorted(options):
        if name not in by_name:
            near = get_close_matches(name, by_name, n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            available = f"it has {', '.join(sorted(by_name))}" if by_name else "it has none"
            raise UsageError(f"{family} has no model option {name}; {available}.{hint}")
    return {name: by_name[name].value(value) for name, value in options.items()}
