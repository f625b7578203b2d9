"""The contents of a run: every object that its records lead to, with the hash that a record holds of it.

Verification compares these with the stored objects, `run copy` copies them, and any other object is a stray.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from probe_kit.errors import RunDamagedError
from probe_kit.runs.certificates import certificate_keys
from probe_kit.runs.columns import Columns, seal_key
from probe_kit.runs.commits import Commit, commit_key, numbered, redo, redo_picture, stamp_of
from probe_kit.runs.layout import DATA, FAILED, ILLUSTRATIONS, LABEL_FILE, LEFT_OUT_FILE, PROVENANCE, RUN_FILE
from probe_kit.runs.location import Location
from probe_kit.runs.plans import plan_key
from probe_kit.runs.records import RESTORE, Sum
from probe_kit.runs.results import BUNDLES, HEAD, PARTIAL, TIMES, advice_for, bundle_keys, read_bundle
from probe_kit.runs.root import Root, is_left_out
from probe_kit.runs.seconds import seconds_key


@dataclass(frozen=True)
class StoredObject:
    """An object with a known hash.

    owner: the episode it belongs to, for messages. advice: the remedy if it is damaged. optional: whether it may
    be missing, as in a copy without activations.
    """

    key: str
    stored_sum: Sum
    advice: str
    owner: str = ""
    optional: bool = False

    def problem(self, size: int | None) -> str | None:
        """The fault in an object of this size, None for one that is missing."""
        if size is None and self.optional:
            return None
        words = self.stored_sum.size_problem(size)
        return f"{self.key}{self.owner} {words}. {self.advice}" if words else None


def record_keys(root: Root, commits: Mapping[int, Commit], columns: Columns | None) -> Iterator[str]:
    """Keys of the records of a run, which carry their own hash."""
    yield from (RUN_FILE, LABEL_FILE, LEFT_OUT_FILE)
    yield from (plan_key(record) for record in range(len(root.stored_plan.extents)))
    for number, commit in commits.items():
        yield commit_key(number)
        yield seconds_key(number)
        yield f"{PROVENANCE}/{commit.provenance}.json"
    yield from certificate_keys(root.location)
    yield from (key for _, key, _ in numbered(root.location, FAILED))
    if columns is not None:
        yield seal_key(stamp_of(commits))
    for home in BUNDLES:
        for key in bundle_keys(root.location, home):
            yield from (f"{home}/{key}/{HEAD}", f"{home}/{key}/{TIMES}")


def stored_objects(root: Root, commits: Mapping[int, Commit], columns: Columns | None) -> Iterator[StoredObject]:
    """All objects whose hash a record holds. Results with a damaged head are left out."""
    for key, expected in root.sums.items():
        yield StoredObject(key, expected, RESTORE)
    pictures = {folder for folder in ILLUSTRATIONS if root.location.keys(folder)}
    for number, commit in commits.items():
        owner = f" of episode {commit.episode_id}"
        for key, expected in commit.objects.items():
            yield StoredObject(f"{DATA}/{key}", expected, redo(number), owner, is_left_out(key, root.left_out))
        for key, expected in commit.pictures.items():
            lost = key.partition("/")[0] not in pictures  # a user may delete the folder of all pictures
            yield StoredObject(key, expected, redo_picture(number), owner, lost)
    if columns is not None:
        for key, expected in columns.sums.items():
            yield StoredObject(f"{columns.folder}/{key}", expected, columns.advice)
    for home in BUNDLES:
        for key in bundle_keys(root.location, home):
            yield from _of_result(root, home, key)


def _of_result(root: Root, home: str, key: str) -> Iterator[StoredObject]:
    try:
        bundle = read_bundle(root.location, home, key)
    except RunDamagedError:  # verification reads every head by itself
        return
    for name, (actual, expected) in bundle.files.items():
        yield StoredObject(
            f"{bundle.folder}/{actual}", expected, advice_for(bundle.folder), "", name in root.left_out
        )


def sizes_of(location: Location, objects: Iterable[StoredObject]) -> dict[str, int]:
    """Bytes of the objects that exist, with one listing per folder of the run."""
    folders: dict[str, list[str]] = {}
    for stored in objects:
        folder, _, key = stored.key.partition("/")
        folders.setdefault(folder, []).append(key)
    return {
        f"{folder}/{key}": size
        for folder, keys in folders.items()
        for key, size in location.sizes(folder, keys).items()
    }


def stray_keys(
    root: Root, commits: Mapping[int, Commit], columns: Columns | None, objects: Iterable[StoredObject]
) -> list[str]:
    """Keys of all objects that no record leads to, such as copies made by hand; nothing reads them.

    objects: those of `stored_objects`.
    """
    expected = {*record_keys(root, commits, columns), *(stored.key for stored in objects)}
    return [key for key in root.location.keys("") if key not in expected and not _expected(key)]


def _expected(key: str) -> bool:
    """Whether it is a picture, or work in progress: episodes without a commit, sweeps that are not finished."""
    top, _, below = key.partition("/")
    return (
        top in ILLUSTRATIONS
        or (top == DATA and "/c/" in below)
        or (top in BUNDLES and below.partition("/")[0].endswith(PARTIAL))
        or key.endswith((".tmp", ".partial"))
    )
