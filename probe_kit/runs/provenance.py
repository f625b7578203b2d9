"""Provenance and certificates: where each process computed, and what it loaded and checked.

    provenance/<digits>.json      device and library versions, named by their sha256; commits name it
    certificate.json              the first process's record, with its provenance
    certificates/<digits>.json    a record per process, named by the sha256 of its content

In a run of one process, each of the three can be made from the others. A missing one that can be made is read as
if it were there, and written again by commands that may write.

Settings say what was requested; provenance says which machine and libraries computed it. Another kind of device or
other libraries give other numbers. So a run continues there only on request, and records it.
"""

import json
import platform
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

import probe_kit.version
from probe_kit.errors import RunDamagedError, SettingsMismatchError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.runs.layout import CERTIFICATE_FILE, CERTIFICATES, PROVENANCE
from probe_kit.runs.records import NAME_DIGITS, RESTORE, Record, is_hash_name, named_by_hash
from probe_kit.runs.root import Root
from probe_kit.runs.store import Location

Provenance = Mapping[str, Any]

_LIBRARIES = ("torch", "lerobot", "transformers", "timm", "pybullet", "zarr", "numcodecs", "numpy", "pillow")
DECISIVE = (
    "device",
    "dtype",
    "decoder",
    *(f"versions.{name}" for name in ("probe-kit", *_LIBRARIES[:3], "pybullet")),  # torch, lerobot, transformers
)
"""The parts that change numbers. Cores, workers and threads, the interpreter and the writer's libraries do not."""

_PARTS = frozenset(("device", "device_name", "dtype", "python", "machine", "versions", "code_sha256", "decoder"))
"""The parts of a provenance, as `provenance_here` and extractions make it."""


def provenance_here(device: str = "cpu", dtype: str | None = None) -> dict[str, Any]:
    """Return the provenance of this process when it computes on `device` in `dtype`."""
    kind = device.partition(":")[0]
    return {
        "device": kind,
        "device_name": _gpu_name(device) if kind == "cuda" else platform.machine(),
        "dtype": dtype,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "versions": {"probe-kit": probe_kit.version.__version__, **{name: _version(name) for name in _LIBRARIES}},
        "code_sha256": code_sha256(),
    }


def _gpu_name(device: str) -> str | None:
    """Return the GPU's name; None in a planning process without a GPU, whose workers name their own."""
    import torch

    return torch.cuda.get_device_name(device) if torch.cuda.is_available() else None


def _version(library: str) -> str | None:
    try:
        return version(library)
    except PackageNotFoundError:
        return None


@cache
def code_sha256() -> str:
    """Return the hash of probe_kit's own source files."""
    root = Path(probe_kit.version.__file__).parent
    files = sorted(root.rglob("*.py"))
    return sha256_json(
        [[f.relative_to(root).as_posix(), sha256_text(f.read_text(encoding="utf-8"))] for f in files]
    )


class ProvenanceRecord(Record):
    """The provenance of one process, see `provenance_here`."""

    model_config = ConfigDict(extra="allow")
    kind: ClassVar[str] = "provenance"
    device: str
    versions: dict[str, str | None]


def name_of(provenance: Provenance) -> str:
    """Return the name by which commits refer to a provenance."""
    return sha256_json(provenance)[:NAME_DIGITS]


def keep_provenance(location: Location, provenance: Provenance) -> None:
    """Store a provenance in the run, unless another process did."""
    location.create(provenance_key(name_of(provenance)), _provenance_bytes(provenance))


def _provenance_bytes(provenance: Provenance) -> bytes:
    return ProvenanceRecord.model_validate(dict(provenance)).to_bytes()


def read_provenances(root: Root) -> dict[str, Provenance]:
    """Return every provenance of a run by its name. Raises RunDamagedError for one of another content."""
    provenances: dict[str, Provenance] = {}
    for name, key, raw in named_by_hash(root.location, PROVENANCE):
        where = f"{root.location}/{key}"
        content = ProvenanceRecord.parse(raw, where, RESTORE).content
        if name_of(content) != name:
            raise RunDamagedError(f"{where} was changed after it was written. {RESTORE}")
        provenances[name] = content
    return provenances


def provenance_key(name: str) -> str:
    """Return the key of the provenance of this name."""
    return f"{PROVENANCE}/{name}.json"


def differences(provenances: Iterable[Provenance]) -> tuple[str, ...]:
    """Return the decisive parts that are not the same in all provenances, such as `versions.torch`."""
    decisive = [_decisive(provenance) for provenance in provenances]
    return tuple(part for part in DECISIVE if len({parts[part] for parts in decisive}) > 1)


def _decisive(provenance: Provenance) -> dict[str, Any]:
    versions = {f"versions.{name}": version for name, version in provenance.get("versions", {}).items()}
    return {part: {**provenance, **versions}.get(part) for part in DECISIVE}


def check_other_provenance(stored: Iterable[Provenance], current: Provenance, where: str) -> None:
    """Raise SettingsMismatchError naming the decisive parts here that differ from those of stored episodes."""
    for former in stored:
        if different := differences([former, current]):
            was, now = _decisive(former), _decisive(current)
            lines = [f"  {part}: stored {was[part]!r}, here {now[part]!r}" for part in different]
            raise SettingsMismatchError(
                f"{where} holds episodes that were made elsewhere, and this changes numbers:\n"
                + "\n".join(lines)
                + "\n"
                "Continue it where it was begun, choose another --out, or accept a mixed run with --allow-mixed, "
                "which its certificate and every table will say"
            )


# -- certificates ------------------------------------------------------------------------------------------------


INPUT_CHECK = "input_check"
"""An entry of a certificate: by input, the last thing that changed with it at the first inference of a process."""


INPUT_CONTENT = "input_content"
"""An entry of a certificate: inputs without content, in the frames at which a process looked before it played."""


class Certificate(Record):
    """The record of one process.

    Attributes:
        provenance: The name of its provenance in `provenance/`.
    """

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
    root.location.create(_record_key(record), Certificate.model_validate(record).to_bytes())
    # `create` never writes over: of several processes that begin at once, the first one's stays.
    if not root.location.exists(CERTIFICATE_FILE):
        root.location.create(CERTIFICATE_FILE, Certificate.model_validate({**record, **provenance}).to_bytes())


def _record_key(record: Mapping[str, Any]) -> str:
    return f"{CERTIFICATES}/{sha256_json(record)[:NAME_DIGITS]}.json"


@dataclass(frozen=True)
class Processes:
    """The records of the processes that played a run.

    Attributes:
        provenances: The provenances by name.
        first: The content of the first process's certificate; empty for a run without episodes.
        records: The contents of the records of all processes.
        remade: The records that are not stored and follow from the others, as they were written, by key.
    """

    provenances: Mapping[str, Provenance]
    first: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    remade: Mapping[str, bytes]


def read_processes(root: Root, names: Collection[str]) -> Processes:
    """Read who played a run. A record that is missing and follows from the others is made again in memory.

    Args:
        root: The root of the run.
        names: The names of the provenances that commits name; without any, the run has no certificate yet.

    Raises:
        RunDamagedError: If a record was changed or is another run's, or is missing and does not follow.
    """
    provenances, remade = read_provenances(root), dict[str, bytes]()
    if not names:
        return Processes(provenances, {}, (), remade)
    first, records = _read_first(root), _read_records(root)
    if first and first["provenance"] not in provenances and (lost := _provenance_in(first, records)):
        provenances[name_of(lost)] = lost
        remade[provenance_key(name_of(lost))] = _provenance_bytes(lost)
    if missing := sorted({*names} - {*provenances}):
        raise RunDamagedError(
            f"{root.location}/{provenance_key(missing[0])} is missing, though episodes name it; it was there when "
            "they were committed. Restore it from a copy, or run the same `probe-kit extract` again where they "
            "were played: it writes the record again"
        )
    if not first and records:
        complete = [{**record, **provenances.get(record["provenance"], {})} for record in records]
        first = next((certificate for certificate in complete if "versions" in certificate), {})
        if first:
            remade[CERTIFICATE_FILE] = Certificate.model_validate(first).to_bytes()
    if not first:
        raise RunDamagedError(f"{root.location}/{CERTIFICATE_FILE} is missing. {RESTORE}")
    if not records:
        parts = provenances.get(first["provenance"], {})
        record = {part: value for part, value in first.items() if part not in parts}
        records = [record]
        remade[_record_key(record)] = Certificate.model_validate(record).to_bytes()
    if not any(_repeats(first, record) for record in records):
        raise RunDamagedError(
            f"{root.location}/{CERTIFICATE_FILE} says what none of the records in {CERTIFICATES} says. {RESTORE}"
        )
    return Processes(provenances, first, records, remade)


def _read_first(root: Root) -> dict[str, Any]:
    """Return the content of the first process's certificate; empty if it is missing."""
    try:
        raw = root.location.read(CERTIFICATE_FILE)
    except FileNotFoundError:
        return {}
    name = f"{root.location}/{CERTIFICATE_FILE}"
    return Certificate.parse(raw, name, RESTORE, run=root.identity).content


def _read_records(root: Root) -> list[dict[str, Any]]:
    records = []
    for _, key, raw in named_by_hash(root.location, CERTIFICATES):
        name = f"{root.location}/{key}"
        record = Certificate.parse(raw, name, RESTORE, run=root.identity).content
        if _record_key(record) != key:
            raise RunDamagedError(f"{name} is another process's. {RESTORE}")
        records.append(record)
    return records


def _provenance_in(first: Mapping[str, Any], records: Iterable[Mapping[str, Any]]) -> Provenance | None:
    """Return the provenance that the first process's certificate repeats, if its hash shows that it is whole."""
    of_records = ({part: first[part] for part in first if part not in record} for record in records)
    for parts in (*of_records, {part: first[part] for part in first if part in _PARTS}):
        if name_of(parts) == first["provenance"]:
            return parts
    return None


def _repeats(first: Mapping[str, Any], record: Mapping[str, Any]) -> bool:
    """Whether the certificate is this process's record with the provenance that the record names."""
    provenance = {part: value for part, value in first.items() if part not in record}
    same = all(first.get(part) == value for part, value in record.items())
    return same and name_of(provenance) == record["provenance"]


def certificate_keys(location: Location) -> list[str]:
    """Return the keys of all certificates."""
    records = [key for key in location.keys(CERTIFICATES) if is_hash_name(key.rpartition("/")[2])]
    return [CERTIFICATE_FILE, *records]
