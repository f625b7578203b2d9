"""Records: the JSON objects of a run, each a pydantic model with a hash over its values.

    run.json ── zarr.json of every array
       └── plan ── commits ── the objects of their episode
                      └── stamp ── columns, probes

The hash is that of the canonical JSON of the parsed content: another spelling of the same values is the same
record to every reader; `run verify --deep` compares the bytes too. Any other value, a key that is named twice, and
a part that the model does not know are damage. A record names the run it belongs to by the hash of `run.json`, so
none counts in another run. Hashes detect accidents. They are no protection against an attacker who recomputes
them: see `docs/storage.md`.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from hashlib import blake2b
from typing import Annotated, Any, ClassVar, NamedTuple, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, PrivateAttr, ValidationError

from probe_kit._system.bounded_files import parse_strict_json
from probe_kit._system.complaints import in_words
from probe_kit.errors import RunDamagedError
from probe_kit.runs.store import Location

HASH = "blake2b"
"""The part of a record that holds its hash, named as the hash is computed."""
DIGEST_BYTES, BLOCK_BYTES = 32, 8
"""The bytes of the hash of a record or object, and of one inner chunk.

A commit has one hash of a chunk per layer and 128 tokens.
"""
_HEX, _BLOCK_HEX = 2 * DIGEST_BYTES, 2 * BLOCK_BYTES
_HEXADECIMAL = frozenset("0123456789abcdef")
NAME_DIGITS = 16
"""The digits of a hash by which a record or a derived folder is named."""
_HASH_NAME = re.compile(rf"[0-9a-f]{{{NAME_DIGITS}}}\.json")
RESTORE = "Restore it from a copy, or extract the run again"


class Checksum(NamedTuple):
    """The length of an object in bytes, and the blake2b of these bytes as 64 hex digits.

    Attributes:
        blocks: For a shard, 16 hex digits per inner chunk in the order of its index, then those of the index. So a
            part can be checked without reading the others. Empty for everything else.
    """

    length: int
    digest: str
    blocks: str = ""

    @classmethod
    def of(cls, content: bytes) -> "Checksum":
        """Return the sum of an object that is always read at once."""
        return cls(len(content), digest(content))

    def to_json(self) -> list[int | str]:
        """Return the sum as stored: blocks only where there are any."""
        return list(self) if self.blocks else [self.length, self.digest]

    def size_problem(self, size: int | None) -> str | None:
        """Return the fault in an object of `size` bytes (None if it is missing), in words; None without one."""
        if size is None:
            return "is missing"
        return None if size == self.length else f"has {size} bytes; {self.length} were written"

    def problem(self, content: bytes) -> str | None:
        """Return the difference between this sum and that of `content`, in words; None if there is none."""
        if problem := self.size_problem(len(content)):
            return problem
        return None if digest(content) == self.digest else "has other bytes than were written"


def parse_sum(values: Any) -> Checksum:
    """Return the sum that `Checksum.to_json` stored. Raises ValueError for anything else."""
    match values:
        case [int(length), str(known)] | [int(length), str(known), str()] if type(length) is int and length >= 0:
            blocks = "".join(values[2:])
            digits = _HEXADECIMAL.issuperset(known + blocks)
            if digits and len(known) == _HEX and len(blocks) % _BLOCK_HEX == 0:
                return Checksum(length, known, blocks)
    raise ValueError(f"expected a number of bytes and {_HEX} hex digits")


Sums = dict[str, Annotated[Checksum, BeforeValidator(parse_sum), PlainSerializer(Checksum.to_json)]]
"""The lengths and hashes of objects by key, as a record holds them."""


class Record(BaseModel):
    """A JSON object of a run. Reading checks type and value of its parts, and refuses unknown ones."""

    # strict: pydantic would otherwise read "3" as 3 and 1 as True.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, ser_json_inf_nan="constants")
    kind: ClassVar[str] = "record"
    _hash: str = PrivateAttr("")

    @property
    def hash(self) -> str:
        """The hash over the values, 64 hex digits."""
        return self._hash or digest(canonical(self.content))

    @property
    def content(self) -> dict[str, Any]:
        """The values as stored, without their hash."""
        # Unset parts are left out: with their defaults, a record would not have the hash that it was written with.
        return self.model_dump(mode="json", exclude_unset=True)

    def to_bytes(self) -> bytes:
        """Return the record as it is stored."""
        return as_record(self.content)

    @classmethod
    def parse(cls, raw: bytes, name: str, advice: str, /, **expected: object) -> Self:
        """Return the record in these bytes.

        Args:
            raw: The stored bytes.
            name: The place of the record, for the message.
            advice: The remedy, for the message.
            **expected: Values by part, such as the run's identity.

        Raises:
            RunDamagedError: If the record was changed, or belongs elsewhere.
        """
        content = read_record(raw, name, advice)
        carried = content.pop(HASH)
        try:
            record = cls.model_validate(content)
        except ValidationError as error:
            raise RunDamagedError(
                f"{name} is no {cls.kind} as probe_kit writes it: {in_words(error)}. {advice}"
            ) from None
        if other := [part for part, value in expected.items() if content.get(part) != value]:
            stored, right = (
                ", ".join(f"{part} {values.get(part)}" for part in other) for values in (content, expected)
            )
            raise RunDamagedError(f"{name} is the {cls.kind} of {stored}; here belongs that of {right}. {advice}")
        record._hash = carried
        return record

    @classmethod
    def read(cls, location: Location, key: str, advice: str, /, **expected: object) -> Self:
        """Return the record at `key`. Raises RunDamagedError if it is missing, changed, or belongs elsewhere."""
        name = f"{location}/{key}"
        try:
            raw = location.read(key)
        except FileNotFoundError:
            raise RunDamagedError(f"{name} is missing. {advice}") from None
        return cls.parse(raw, name, advice, **expected)


def is_hash_name(name: str) -> bool:
    """Whether an object is named by the first digits of a hash, as `<digits>.json`; copies have other names."""
    return bool(_HASH_NAME.fullmatch(name))


def named_by_hash(location: Location, folder: str) -> Iterator[tuple[str, str, bytes]]:
    """Yield digits, key and content of the objects in `folder` that are named by the first digits of a hash."""
    for name, raw in location.read_all(folder, ".json").items():
        if is_hash_name(name):
            yield name.removesuffix(".json"), f"{folder}/{name}", raw


def digest(content: bytes) -> str:
    """Return the blake2b of `content` as 64 hex digits; `b2sum --length 256` prints the same."""
    return blake2b(content, digest_size=DIGEST_BYTES).hexdigest()


def digest_of(pieces: Iterable[bytes | memoryview], most: int | None = None) -> tuple[int, str]:
    """Return length and blake2b of these pieces together, or of their beginning beyond `most` bytes."""
    running, length = blake2b(digest_size=DIGEST_BYTES), 0
    for piece in pieces:
        running.update(piece)
        length += len(piece)
        if most is not None and length > most:  # reading a sparse file takes hours
            break
    return length, running.hexdigest()


def block_digest(content: bytes) -> str:
    """Return a short blake2b, 16 hex digits, for parts of an object."""
    return blake2b(content, digest_size=BLOCK_BYTES).hexdigest()


def canonical(content: Mapping[str, Any]) -> bytes:
    """Return the spelling of a JSON object that is hashed: keys sorted, no spaces, ASCII."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def as_json(content: Mapping[str, Any]) -> bytes:
    """Return JSON as it is written in a run: keys sorted, a line each."""
    return json.dumps(content, sort_keys=True, indent=1, allow_nan=False).encode()


def as_record(content: Mapping[str, Any]) -> bytes:
    """Return JSON that carries the hash of its other values."""
    return as_json({**content, HASH: digest(canonical(content))})


_EXACT: ContextVar[bool] = ContextVar("exact", default=False)


@contextmanager
def exact_records(exact: bool = True) -> Iterator[None]:
    """A context in which `read_record` takes a record only in the bytes that probe_kit writes."""
    token = _EXACT.set(exact)
    try:
        yield
    finally:
        _EXACT.reset(token)


def read_record(raw: bytes, name: str, advice: str) -> dict[str, Any]:
    """Return the content of a record, with its hash.

    Args:
        raw: The stored bytes.
        name: The place of the record, for the message.
        advice: The remedy, for the message.

    Raises:
        RunDamagedError: Unless the hash is that of the values, and within `exact_records` the bytes are ours.
    """
    content = read_plain(raw, name, advice)
    carried = content.pop(HASH, None)
    try:
        computed = digest(canonical(content))
    except RecursionError:
        raise RunDamagedError(f"{name} was changed after it was written: it nests too deeply. {advice}") from None
    if carried != computed:
        raise RunDamagedError(f"{name} was changed after it was written: its hash is another one. {advice}")
    if _EXACT.get() and raw != as_json({**content, HASH: computed}):
        raise RunDamagedError(
            f"{name} was changed after it was written: it holds the same values in other bytes (white space, "
            f"order or escapes). {advice}"
        )
    return {HASH: computed, **content}


def read_plain(raw: bytes, name: str, advice: str) -> dict[str, Any]:
    """Return the JSON object in these bytes. Raises RunDamagedError if it is none, or names a key twice.

    The bytes carry no hash; their sum is stored elsewhere.
    """
    try:
        content = parse_strict_json(raw)
    except ValueError as error:
        raise RunDamagedError(f"{name} was changed after it was written: {error}. {advice}") from error
    if not isinstance(content, dict):
        raise RunDamagedError(f"{name} holds a {type(content).__name__}, not an object. {advice}")
    return content
