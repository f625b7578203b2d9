"""Copies of runs without their activations: what they left out, and that it is missing on purpose.

left-out.json    a record of its own: the run, and the arrays of `data.zarr` whose objects were not copied; also
                 `directions.npz` where the weights of probes were not

Commits still hold the hash of every object that was left out.
"""

from collections.abc import Collection, Iterable

from probe_kit.errors import RunDamagedError
from probe_kit.runs.layout import LEFT_OUT_FILE
from probe_kit.runs.records import as_record, expect, read_record
from probe_kit.runs.store import Location

_CHUNKS = "/c/"


def left_out_record(identity: str, arrays: Iterable[str]) -> bytes:
    """`left-out.json` of a copy of the run with this identity."""
    return as_record({"run": identity, "arrays": sorted(arrays)})


def read_left_out(location: Location, identity: str) -> frozenset[str]:
    """The arrays that a run was copied without; none for a run that is no such copy.

    Raises RunDamagedError if the record was changed or is of another run.
    """
    try:
        raw = location.read(LEFT_OUT_FILE)
    except FileNotFoundError:
        return frozenset()
    name, advice = f"{location}/{LEFT_OUT_FILE}", "Make the copy again, with `probe-kit run copy`"
    record = read_record(raw, name, advice)
    expect(record, {"run": str, "arrays": list}, name, advice)
    if record["run"] != identity:
        raise RunDamagedError(f"{name} is of another run. {advice}")
    return frozenset(map(str, record["arrays"]))


def is_left_out(key: str, arrays: Collection[str]) -> bool:
    """Whether an object of `data.zarr` belongs to one of these arrays; their metadata is always there."""
    array, chunks, _ = key.partition(_CHUNKS)
    return bool(chunks) and array in arrays
