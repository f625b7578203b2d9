"""Provenance and certificates: where each process computed, and what it loaded and checked.

    provenance/<digits>.json      device and library versions, named by their sha256; commits name it
    certificate.json              the first process's record, with its provenance
    certificates/<digits>.json    a record per process, named by the sha256 of its content

Settings say what was requested; provenance says which machine and libraries computed it. Numbers of another kind
of device or of other libraries are not the same numbers. So a run is continued there only on request, and says so.
"""

import json
import platform
from collections.abc import Iterable, Mapping
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
    record = ProvenanceRecord.model_validate(dict(provenance))
    location.create(f"{PROVENANCE}/{name_of(provenance)}.json", record.to_bytes())


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


def check_provenances(stored: Mapping[str, Provenance], names: Iterable[str], location: Location) -> None:
    """Raise RunDamagedError unless all provenances that commits name are stored."""
    if missing := sorted({*names} - {*stored}):
        raise RunDamagedError(
            f"{location}/{PROVENANCE}/{missing[0]}.json is missing, though episodes name it; it was there when "
            f"they were committed. {RESTORE}"
        )


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
    key = f"{CERTIFICATES}/{sha256_json(record)[:NAME_DIGITS]}.json"
    root.location.create(key, Certificate.model_validate(record).to_bytes())
    # `create` never writes over: of several processes that begin at once, the first one's stays.
    if not root.location.exists(CERTIFICATE_FILE):
        root.location.create(CERTIFICATE_FILE, Certificate.model_validate({**record, **provenance}).to_bytes())


def read_certificate(root: Root) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the content of the first process's record, and those of the records of all processes.

    Raises:
        RunDamagedError: If one is missing, was changed, or is another run's.
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
    """Whether the certificate is this process's record with the provenance that the record names."""
    provenance = {part: value for part, value in first.items() if part not in record}
    same = all(first.get(part) == value for part, value in record.items())
    return same and name_of(provenance) == record["provenance"]


def certificate_keys(location: Location) -> list[str]:
    """Return the keys of all certificates."""
    records = [key for key in location.keys(CERTIFICATES) if is_hash_name(key.rpartition("/")[2])]
    return [CERTIFICATE_FILE, *records]
