"""Provenance: device and library versions of a process, stored once and named in its commits.

    provenance/<first digits of its sha256>.json

Settings say what was asked for; provenance says what answered. Numbers made on another kind of device or by other
libraries are not the same numbers, so a run is not continued there unless that is asked for, and then says so.
"""

import platform
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar

from pydantic import ConfigDict

import probe_kit.version
from probe_kit.errors import RunDamagedError, SettingsMismatchError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.runs.layout import PROVENANCE
from probe_kit.runs.location import Location
from probe_kit.runs.records import NAME_DIGITS, RESTORE, Record, named_by_hash
from probe_kit.runs.root import Root

Provenance = Mapping[str, Any]

_LIBRARIES = ("torch", "lerobot", "transformers", "timm", "pybullet", "zarr", "numcodecs", "numpy", "pillow")
DECISIVE = (
    "device",
    "dtype",
    "decoder",
    *(f"versions.{name}" for name in ("probe-kit", *_LIBRARIES[:3], "pybullet")),  # torch, lerobot, transformers
)
"""What changes numbers. Cores, workers and threads, the interpreter and the writer's libraries do not."""


def provenance_here(device: str = "cpu", dtype: str | None = None) -> dict[str, Any]:
    """Return the provenance of this process when it computes on `device` in `dtype`."""
    kind = device.partition(":")[0]
    return {
        "device": kind,
        "device_name": _gpu_name(device) if kind == "cuda" else platform.machine(),
        "dtype": dtype,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "versions": {"probe-kit": probe_kit.version.__version__, **_versions()},
        "code_sha256": code_sha256(),
    }


def _gpu_name(device: str) -> str | None:
    """None where the GPUs are elsewhere: the planning process has none, and each worker names its own."""
    import torch

    return torch.cuda.get_device_name(device) if torch.cuda.is_available() else None


def _versions() -> dict[str, str | None]:
    versions: dict[str, str | None] = {}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return versions


@cache
def code_sha256() -> str:
    """Hash of probe_kit's own source files."""
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
    """The name by which commits refer to it."""
    return sha256_json(provenance)[:NAME_DIGITS]


def keep_provenance(location: Location, provenance: Provenance) -> None:
    """Store it in the run, unless another process did."""
    record = ProvenanceRecord.model_validate(dict(provenance))
    location.create(f"{PROVENANCE}/{name_of(provenance)}.json", record.to_bytes())


def read_provenances(root: Root) -> dict[str, Provenance]:
    """Every provenance of a run by its name. Raises RunDamagedError for one of another content."""
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
    """The decisive parts that are not the same in all of them, such as `versions.torch`."""
    decisive = [dict(_decisive(provenance)) for provenance in provenances]
    return tuple(part for part in DECISIVE if len({parts[part] for parts in decisive}) > 1)


def _decisive(provenance: Provenance) -> Iterable[tuple[str, Any]]:
    for part in DECISIVE:
        outer, _, inner = part.partition(".")
        yield part, provenance.get(outer, {}).get(inner) if inner else provenance.get(outer)


def check_other_provenance(stored: Iterable[Provenance], current: Provenance, where: str) -> None:
    """Raise SettingsMismatchError naming what differs here from what made the episodes of a run so far."""
    for former in stored:
        if different := differences([former, current]):
            was, now = dict(_decisive(former)), dict(_decisive(current))
            lines = [f"  {part}: stored {was[part]!r}, here {now[part]!r}" for part in different]
            raise SettingsMismatchError(
                f"{where} holds episodes that were made elsewhere, and this changes numbers:\n"
                + "\n".join(lines)
                + "\n"
                "Continue it where it was begun, choose another --out, or accept a mixed run with --allow-mixed, "
                "which its certificate and every table will say"
            )
