"""Orphaned objects of a run: those that the root does not lead to."""

from collections.abc import Iterator, Mapping

from probe_kit.errors import RunDamagedError
from probe_kit.runs.certificates import certificate_keys
from probe_kit.runs.columns import Columns, seal_key
from probe_kit.runs.commits import Commit, commit_key, numbered, pictures_of
from probe_kit.runs.layout import (
    DATA,
    FAILED,
    ILLUSTRATIONS,
    LABEL_FILE,
    LEFT_OUT_FILE,
    PROVENANCE,
    RUN_FILE,
)
from probe_kit.runs.plans import plan_key
from probe_kit.runs.results import BUNDLES, HEAD, PARTIAL, TIMES, bundle_keys, read_bundle
from probe_kit.runs.root import Root
from probe_kit.runs.seconds import seconds_key


def stray_keys(root: Root, commits: Mapping[int, Commit], columns: Columns | None, stamp: str) -> list[str]:
    """Keys of all objects that no hash covers, without pictures that no commit names."""
    known = set(known_keys(root, commits, columns, stamp))
    return [key for key in root.location.keys("") if key not in known and not _expected(key)]


def known_keys(root: Root, commits: Mapping[int, Commit], columns: Columns | None, stamp: str) -> Iterator[str]:
    """Keys of all that the root leads to: objects whose every changed byte is found."""
    yield RUN_FILE
    yield LABEL_FILE
    yield LEFT_OUT_FILE
    yield from root.sums
    yield from (plan_key(record) for record in range(len(root.stored_plan.extents)))
    for number, commit in commits.items():
        yield commit_key(number)
        yield seconds_key(number)
        yield f"{PROVENANCE}/{commit['provenance']}.json"
        yield from (f"{DATA}/{key}" for key in commit["objects"])
        yield from pictures_of(commit)
    yield from certificate_keys(root.location)
    yield from (key for _, key, _ in numbered(root.location, FAILED))
    if columns is not None:
        yield seal_key(stamp)
        yield from (f"{columns.folder}/{key}" for key in columns.sums)
    for home in BUNDLES:
        for key in bundle_keys(root.location, home):
            yield from _of_bundle(root, home, key)


def _of_bundle(root: Root, home: str, key: str) -> Iterator[str]:
    try:
        bundle = read_bundle(root.location, home, key)
    except RunDamagedError:  # said elsewhere
        return
    yield f"{bundle.folder}/{HEAD}"
    yield f"{bundle.folder}/{TIMES}"
    yield from (f"{bundle.folder}/{actual}" for actual, _ in bundle.files.values())


def _expected(key: str) -> bool:
    """Pictures, and what is being written: episodes that are not committed yet, sweeps that are not finished."""
    top, _, rest = key.partition("/")
    return (
        top in ILLUSTRATIONS
        or (top == DATA and "/c/" in rest)
        or (top in BUNDLES and rest.partition("/")[0].endswith(PARTIAL))
        or key.endswith((".tmp", ".partial"))
    )
