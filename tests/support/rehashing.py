"""What no accident does: change a stored run and compute all hashes anew, so that it is whole again.

For tests that need a run with other numbers than a model gave, and for the ones that show what hashes cannot find.
"""

import json
import shutil
from pathlib import Path
from typing import Any

from probe_kit.hashing import sha256_json
from probe_kit.runs.array_lengths import without_length
from probe_kit.runs.arrays import inner_chunks
from probe_kit.runs.records import BLOCK_BYTES, HASH, Checksum, as_record, block_digest


def rehash(run: Path) -> None:
    """Make every hash of a run that of what lies there now; columns go, and what is missing is not named."""
    shutil.rmtree(run / "columns.zarr", ignore_errors=True)
    shutil.rmtree(run / "sealed", ignore_errors=True)
    root = _content(run / "run.json")
    metadata = sorted((run / "data.zarr").rglob("zarr.json"))
    # As the run began: the length that other tools see is no part of its identity.
    begun = {path.relative_to(run).as_posix(): without_length(path.read_bytes()) for path in metadata}
    root["objects"] = {key: Checksum.of(content).to_json() for key, content in begun.items()}
    identity = _write(run / "run.json", root)
    plans: dict[int, str] = {}
    for path in sorted((run / "plan").glob("*.json")):
        plan = {**_content(path), "run": identity}
        plans |= dict.fromkeys((row["episode"] for row in plan["episodes"]), _write(path, plan))
    for path in [run / "label.json", *sorted((run / "times").glob("*.json"))]:
        _write(path, {**_content(path), "run": identity})
    for path in sorted((run / "commits").glob("*.json")):
        commit = _content(path)
        commit["objects"] = {
            key: _sum(run / "data.zarr" / key, *object_record[2:]).to_json()
            for key, object_record in commit["objects"].items()
            if (run / "data.zarr" / key).is_file()
        }
        _write(path, {**commit, "run": identity, "plan": plans[commit["episode"]]})
    for path in [run / "certificate.json", *sorted((run / "certificates").glob("*.json"))]:
        certificate = {**_content(path), "run": identity}
        path.unlink()
        certificate_path = path if path.parent == run else path.with_name(f"{sha256_json(certificate)[:16]}.json")
        _write(certificate_path, certificate)


def write_record(path: Path, content: dict[str, Any]) -> None:
    """A record with a right hash, whatever it says."""
    _write(path, {key: value for key, value in content.items() if key != HASH})


def _content(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    content.pop(HASH, None)
    return content


def _write(path: Path, content: dict[str, Any]) -> str:
    path.write_bytes(as_record(content))
    return str(json.loads(path.read_text(encoding="utf-8"))[HASH])


def _sum(path: Path, blocks: str = "") -> Checksum:
    content = path.read_bytes()
    if not blocks:
        return Checksum.of(content)
    count = len(blocks) // (2 * BLOCK_BYTES) - 1
    parts = "".join(block_digest(content[part]) for part in inner_chunks(content, count))
    return Checksum.of(content)._replace(blocks=parts)
