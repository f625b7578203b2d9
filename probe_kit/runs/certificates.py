"""Certificates: the checks and loaded parts of each process, recorded by that process.

certificate.json               the first process's record, with its provenance
certificates/<digits>.json     a record per process, named by the sha256 of its content
"""

import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

from probe_kit.errors import RunDamagedError
from probe_kit.hashing import sha256_json
from probe_kit.runs.layout import CERTIFICATE_FILE, CERTIFICATES
from probe_kit.runs.location import Location
from probe_kit.runs.provenance import Provenance, name_of
from probe_kit.runs.records import NAME_DIGITS, RESTORE, Record, is_hash_name, named_by_hash
from probe_kit.runs.root import Root

INPUT_CHECK = "input_check"
"""Entry of a certificate: by input, the last thing that changed with it at the first inference of a process."""


class Certificate(Record):
    """The record of one process. provenance: name of its record in `provenance/`."""

    model_config = ConfigDict(extra="allow")
    kind: ClassVar[str] = "certificate"
    run: str
    provenance: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    capture_check: dict[str, Any] | None = None


def input_notes(certificate: Mapping[str, Any]) -> list[str]:
    """Return a sentence for every input whose change did not change the first output of some process."""
    checks = [record.get(INPUT_CHECK) or {} for record in certificate.get("processes", [certificate])]
    notes = []
    for name in dict.fromkeys(name for check in checks for name in check):
        reaches = {check.get(name) for check in checks}
        if "last layer" in reaches:
            notes.append(f"another {name} changes the last layer and no number of the first output")
        elif "nothing" in reaches:
            notes.append(f"another {name} changes no number of the first output, nor the last layer before it")
        elif "not the output" in reaches:
            notes.append(f"another {name} changes no number of the first output")
    return notes


def write_certificate(root: Root, parts: Mapping[str, Any], provenance: Provenance) -> None:
    """Record the checks and loaded parts of one process; `certificate.json` stays from the first one."""
    # Through JSON, so that the hash is of what a reader will parse: tuples become lists, keys become texts.
    record = json.loads(
        json.dumps({**parts, "provenance": name_of(provenance), "run": root.identity}, default=list)
    )
    key = f"{CERTIFICATES}/{sha256_json(record)[:NAME_DIGITS]}.json"
    root.location.create(key, Certificate.model_validate(record).to_bytes())
    # `create` never writes over: of several processes that begin at once, the first one's stays.
    if not root.location.exists(CERTIFICATE_FILE):
        root.location.create(CERTIFICATE_FILE, Certificate.model_validate({**record, **provenance}).to_bytes())


def read_certificate(root: Root) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Contents of the first process's record, and of the records of all.

    Raises RunDamagedError if one is missing, was changed, or is another run's.
    """
    first = Certificate.read(root.location, CERTIFICATE_FILE, RESTORE, run=root.identity).content
    records = []
    for digits, key, raw in named_by_hash(root.location, CERTIFICATES):
        name = f"{root.location}/{key}"
        record = Certificate.parse(raw, name, RESTORE, run=root.identity).content
        if sha256_json(record)[:NAME_DIGITS] != digits:
            raise RunDamagedError(f"{name} is another process's. {RESTORE}")
        records.append(record)
    if not records:
        raise RunDamagedError(f"{root.location}/{CERTIFICATES} holds no record of who played. {RESTORE}")
    if not any(_repeats(first, record) for record in records):
        raise RunDamagedError(
            f"{root.location}/{CERTIFICATE_FILE} says what none of the records in {CERTIFICATES} says. {RESTORE}"
        )
    return first, records


def _repeats(first: dict[str, Any], record: dict[str, Any]) -> bool:
    """Whether the certificate is this process's record, and the provenance that the record names."""
    provenance = {part: value for part, value in first.items() if part not in record}
    same = all(first.get(part) == value for part, value in record.items())
    return same and name_of(provenance) == record["provenance"]


def certificate_keys(location: Location) -> list[str]:
    """Keys of all certificates."""
    records = [key for key in location.keys(CERTIFICATES) if is_hash_name(key.rpartition("/")[2])]
    return [CERTIFICATE_FILE, *records]
