"""Hashes that bind every object of a run to its place.

    run.json ── zarr.json of every array, at no episodes
       └── plan ── the plan record before it
              └── commits ── the objects of their episode, their provenance
                     └── stamp ── columns, probes

`run.json` hashes the metadata; a plan record says whose it is; a commit hashes its objects, and says whose it is
and which record planned it; what is derived says from which commits. A record is JSON that carries the hash of all
its other bytes, so that any change is seen.
Every content has one spelling: a record in other bytes than `as_record` writes is damaged, whatever its hash says.
Hashes detect accidents. They are no protection against an attacker who recomputes them: see `docs/storage.md`.
"""

import json
import re
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from typing import Any, NamedTuple

from probe_kit._system.bounded_json import parse_strict_json
from probe_kit.errors import RunDamagedError

HASH = "blake2b"
DIGEST_BYTES, BLOCK_BYTES = 32, 8
_HEX, _BLOCK_HEX = 2 * DIGEST_BYTES, 2 * BLOCK_BYTES
_HEXADECIMAL = re.compile(r"[0-9a-f]+")
_BEFORE, _AFTER = f'{{\n "{HASH}": "'.encode(), b'",'


class Sum(NamedTuple):
    """What is known of an object: its length in bytes, and the blake2b of them as 64 hex digits.

    blocks: of a shard, 16 hex digits per inner chunk in the order of its index, then those of the index; so
    that a part can be checked without reading the rest. Empty for everything else.
    """

    length: int
    digest: str
    blocks: str = ""

    @classmethod
    def of(cls, content: bytes) -> "Sum":
        """That of an object that is always read whole."""
        return cls(len(content), digest(content))

    def to_json(self) -> list[int | str]:
        """As stored: blocks only where there are any."""
        return list(self) if self.blocks else [self.length, self.digest]

    def problem(self, content: bytes) -> str | None:
        """What is wrong with an object that should have this sum, or None."""
        if len(content) != self.length:
            return f"has {len(content)} bytes; {self.length} were written"
        return None if digest(content) == self.digest else "has other bytes than were written"


def read_sums(stored: Mapping[str, Any]) -> dict[str, Sum]:
    """By key, as `Sum.to_json` stored them; of a record that `check_sums` looked at."""
    return {key: Sum(*values) for key, values in stored.items()}


def check_sums(stored: Mapping[str, Any], name: str, advice: str) -> None:
    """Raise RunDamagedError unless every value is what `Sum.to_json` gives."""
    for key, values in stored.items():
        if not is_sum(values):
            raise RunDamagedError(
                f"{name} has {str(values)[:40]!r} as length and hash of {key!r}; expected a number of bytes and "
                f"{_HEX} hex digits. {advice}"
            )


def is_sum(values: Any) -> bool:
    """Whether this is what `Sum.to_json` gives."""
    match values:
        case [length, str(known)]:
            return _is_length(length) and _are_digits(known, _HEX) and len(known) == _HEX
        case [length, str(known), str(blocks)]:
            return is_sum([length, known]) and _are_digits(blocks, _BLOCK_HEX)
    return False


def _is_length(value: Any) -> bool:
    return type(value) is int and value >= 0


def _are_digits(text: str, several: int) -> bool:
    return len(text) % several == 0 and bool(_HEXADECIMAL.fullmatch(text))


def digest(content: bytes) -> str:
    """blake2b of `content`, 64 hex digits; `b2sum --length 256` prints the same."""
    return blake2b(content, digest_size=DIGEST_BYTES).hexdigest()


def digest_of(pieces: Iterable[bytes | memoryview], most: int | None = None) -> tuple[int, str]:
    """Length and blake2b of what these pieces are together, or of their beginning beyond `most` bytes."""
    running, length = blake2b(digest_size=DIGEST_BYTES), 0
    for piece in pieces:
        running.update(piece)
        length += len(piece)
        if most is not None and length > most:  # reading a sparse file takes hours
            break
    return length, running.hexdigest()


def block_digest(content: bytes) -> str:
    """A short one, 16 hex digits, for parts of an object."""
    return blake2b(content, digest_size=BLOCK_BYTES).hexdigest()


def as_json(content: Mapping[str, Any]) -> bytes:
    """The one way JSON is written in a run: keys sorted, a line each."""
    return json.dumps(content, sort_keys=True, indent=1, allow_nan=False).encode()


def as_record(content: Mapping[str, Any]) -> bytes:
    """JSON that begins with the hash of the rest: of the same JSON without that line."""
    plain = as_json(content)
    return _BEFORE + digest(plain).encode() + _AFTER + plain[1:]


def record_hash(record: bytes) -> str:
    """The hash that bytes of `as_record` carry."""
    return record[len(_BEFORE) : len(_BEFORE) + _HEX].decode()


def is_record(raw: bytes) -> bool:
    """Whether these bytes claim to be a record."""
    return raw.startswith(_BEFORE)


def read_record(raw: bytes, name: str, advice: str) -> dict[str, Any]:
    """What a record says, with the hash that was computed of it. Raises RunDamagedError for any other bytes than
    `as_record` gives for that content.

    name, advice: what it is and what to do, for the message.
    """
    start = len(_BEFORE)
    carried, rest = raw[start : start + _HEX], raw[start + _HEX + len(_AFTER) :]
    if is_record(raw) and digest(b"{" + rest).encode() != carried:
        raise RunDamagedError(f"{name} was changed after it was written: its hash is another one. {advice}")
    content = read_plain(raw, name, advice)
    content.pop(HASH, None)
    try:
        written = as_record(content)
    except RecursionError:
        raise RunDamagedError(f"{name} was changed after it was written: it nests too deeply. {advice}") from None
    if raw != written:
        raise RunDamagedError(f"{name} was changed after it was written: {_difference(raw, written)}. {advice}")
    return {HASH: written[start : start + _HEX].decode(), **content}


def _difference(raw: bytes, written: bytes) -> str:
    """How bytes differ from the ones that probe_kit writes for their content."""
    place = next((at for at, pair in enumerate(zip(raw, written, strict=False)) if pair[0] != pair[1]), None)
    place = min(len(raw), len(written)) if place is None else place
    seen, expected = (content[place : place + 20] for content in (raw, written))
    return (
        f"from byte {place} on it has {seen!r}; probe_kit writes {expected!r} for that content (spaces, order of "
        "keys, spelling of numbers and the hash are part of a record)"
    )


def read_plain(raw: bytes, name: str, advice: str) -> dict[str, Any]:
    """What an object of JSON says. Raises RunDamagedError if it is none, or names a key twice.

    Of bytes that carry no hash; what they are compared with lies elsewhere.
    """
    try:
        content = parse_strict_json(raw)
    except ValueError as error:
        raise RunDamagedError(f"{name} was changed after it was written: {error}. {advice}") from error
    if not isinstance(content, dict):
        raise RunDamagedError(f"{name} holds a {type(content).__name__}, not an object. {advice}")
    return content


def expect(content: Mapping[str, Any], parts: Mapping[str, type], name: str, advice: str) -> None:
    """Raise RunDamagedError unless `content` has these parts, each of its type."""
    for part, kind in parts.items():
        if type(content.get(part)) is not kind:  # a boolean is no number
            seen = type(content[part]).__name__ if part in content else "nothing"
            raise RunDamagedError(f"{name} has {seen} as {part!r}; expected {kind.__name__}. {advice}")
