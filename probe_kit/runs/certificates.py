"""Certificates: what each process loaded and checked, recorded by that process.

certificate.json               the first process's record, with its provenance
certificates/<digits>.json     a record per process, named by its sha256
"""

import json
import re
from collections.abc import Mapping
from typing import Any

from probe_kit.errors import RunDamagedError
from probe_kit.hashing import sha256_json
from probe_kit.runs.commits import create_once
from probe_kit.runs.layout import CERTIFICATE_FILE, CERTIFICATES
from probe_kit.runs.plans import RESTORE
from probe_kit.runs.provenance import Provenance, name_of
from probe_kit.runs.records import HASH, expect, read_record
from probe_kit.runs.root import Root
from probe_kit.runs.store import Location

Record = dict[str, Any]
DIGITS = 16
_NAMED = re.compile(rf"[0-9a-f]{{{DIGITS}}}\.json")


def write_certificate(root: Root, found: Mapping[str, Any], provenance: Provenance) -> None:
    """Record what one process loaded and checked; the whole of it stays from the first one."""
    own = json.loads(json.dumps({**found, "provenance": name_of(provenance), "run": root.identity}, default=list))
    create_once(root.location, f"{CERTIFICATES}/{sha256_json(own)[:DIGITS]}.json", own)
    if not root.location.exists(CERTIFICATE_FILE):
        create_once(root.location, CERTIFICATE_FILE, {**own, **provenance})


def read_certificate(root: Root) -> tuple[Record, list[Record]]:
    """What the first process wrote, and the records of all.

    Raises RunDamagedError if one is missing, was changed, or is another run's.
    """
    try:
        first = _read(root, CERTIFICATE_FILE, root.location.read(CERTIFICATE_FILE))
    except FileNotFoundError:
        raise RunDamagedError(f"{root.location}/{CERTIFICATE_FILE} is missing. {RESTORE}") from None
    records = []
    for name, raw in root.location.read_all(CERTIFICATES, ".json").items():
        if not _NAMED.fullmatch(name):
            continue  # not referenced, such as a copy
        record = _read(root, f"{CERTIFICATES}/{name}", raw)
        if sha256_json(record)[:DIGITS] != name.removesuffix(".json"):
            raise RunDamagedError(f"{root.location}/{CERTIFICATES}/{name} is another process's. {RESTORE}")
        records.append(record)
    if not records:
        raise RunDamagedError(f"{root.location}/{CERTIFICATES} holds no record of who played. {RESTORE}")
    if not any(_says(first, record) for record in records):
        raise RunDamagedError(
            f"{root.location}/{CERTIFICATE_FILE} says what none of the records in {CERTIFICATES} says. {RESTORE}"
        )
    return first, records


def _says(first: Record, record: Record) -> bool:
    """Whether the certificate is this process's record, and the provenance that the record names."""
    provenance = {part: value for part, value in first.items() if part not in record}
    same = all(first.get(part) == value for part, value in record.items())
    return same and name_of(provenance) == record["provenance"]


def certificate_keys(location: Location) -> list[str]:
    """Where certificates lie."""
    records = [key for key in location.keys(CERTIFICATES) if _NAMED.fullmatch(key.rpartition("/")[2])]
    return [CERTIFICATE_FILE, *records]


def _read(root: Root, key: str, raw: bytes) -> Record:
    name = f"{root.location}/{key}"
    record = read_record(raw, name, RESTORE)
    expect(record, {"run": str, "provenance": str}, name, RESTORE)
    if record["run"] != root.identity:
        raise RunDamagedError(f"{name} is the certificate of another run. {RESTORE}")
    if record.get("capture_check") is not None:
        expect(record, {"capture_check": dict}, name, RESTORE)
    del record[HASH]
    return record
