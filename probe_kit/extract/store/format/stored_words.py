"""Stored words: what runs of former schemas call something, and what it is called now.

Records are translated after their hashes were checked, so that a stored run keeps its bytes. To rename a stored
word, add a line to the table of its kind of record; nothing else has to know the old one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

RecordKind = Literal["settings", "stream", "plan", "outcome", "probes", "intervention"]


@dataclass(frozen=True)
class Words:
    """Old words of one kind of record, each with the one that is used now.

    keys: names of parts, at any depth. values: by the current name of a part, what its texts are called; a part
    may hold one text or a list of them.
    """

    keys: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


STORED_WORDS: Mapping[RecordKind, Words] = {
    "settings": Words(keys={"listen": "capture_only"}),
    "stream": Words(),
    "plan": Words(),
    "outcome": Words(values={"outcome": {"listened": "capture_only"}}),
    "probes": Words(),
    "intervention": Words(),
}
"""By kind of record: `settings` and `stream` of `run.json`, a row of `plan.json`, the outcome in a commit, and the
settings of stored probes and interventions."""


def in_current_words(record: Mapping[str, Any], kind: RecordKind) -> dict[str, Any]:
    """A record of `kind` in the words of now; of one that uses them already, an equal copy."""
    words = STORED_WORDS[kind]
    return {name: _translated(value, name, words) for name, value in _renamed(record, words).items()}


def _renamed(record: Mapping[str, Any], words: Words) -> dict[str, Any]:
    return {words.keys.get(name, name): value for name, value in record.items()}


def _translated(value: Any, part: str, words: Words) -> Any:
    if isinstance(value, Mapping):
        return {name: _translated(inner, name, words) for name, inner in _renamed(value, words).items()}
    if isinstance(value, list):
        return [_translated(inner, part, words) for inner in value]
    return words.values.get(part, {}).get(value, value) if isinstance(value, str) else value
