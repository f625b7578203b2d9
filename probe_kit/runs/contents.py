"""The contents of a run: every object that its records lead to, with the hash that a record holds of it.

Verification compares these with the stored objects, `run copy` copies them without activations, and any other
object is a stray.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from probe_kit._system.drafts import draft_of, full_disk_in_words, move_draft
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.runs.columns import Columns, seal_key
from probe_kit.runs.commits import Commit, commit_key, numbered_objects, redo, redo_picture, seconds_key, stamp_of
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import (
    DATA,
    FAILED,
    ILLUSTRATIONS,
    LABEL_FILE,
    LEFT_OUT_FILE,
    PROBE_DIRECTIONS,
    PROBES,
    PROVENANCE,
    RUN_FILE,
    TRAJECTORY,
)
from probe_kit.runs.plan import plan_key
from probe_kit.runs.provenance import certificate_keys
from probe_kit.runs.records import Checksum
from probe_kit.runs.results import BUNDLES, HEAD, PARTIAL, TIMES, advice_for, bundle_keys, read_bundle
from probe_kit.runs.root import LeftOut, Root, is_left_out
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.store import Location, locate


@dataclass(frozen=True)
class StoredObject:
    """An object with a known hash.

    Attributes:
        key: Its key in the run.
        advice: The remedy if it is damaged.
        owner: The episode it belongs to, as messages name it; empty for none.
        optional: Whether it may be missing, as in a copy without activations.
    """

    key: str
    stored_sum: Checksum
    advice: str
    owner: str = ""
    optional: bool = False

    def problem(self, size: int | None) -> str | None:
        """Return the fault in the object of size `size` (None if it is missing), and None if there is no fault."""
        if size is None and self.optional:
            return None
        words = self.stored_sum.size_problem(size)
        return f"{self.key}{self.owner} {words}. {self.advice}" if words else None


def record_keys(root: Root, commits: Mapping[int, Commit], columns: Columns | None) -> Iterator[str]:
    """Yield the keys of the records of a run, which carry their own hash, and of the arrays' metadata."""
    yield from (RUN_FILE, LABEL_FILE, LEFT_OUT_FILE, *root.card.objects)
    yield from (plan_key(record) for record in range(len(root.stored_plan.extents)))
    for number, commit in commits.items():
        yield commit_key(number)
        yield seconds_key(number)
        yield f"{PROVENANCE}/{commit.provenance}.json"
    yield from certificate_keys(root.location)
    yield from (key for _, key, _ in numbered_objects(root.location, FAILED))
    if columns is not None:
        yield seal_key(stamp_of(commits))
    for home in BUNDLES:
        for key in bundle_keys(root.location, home):
            yield from (f"{home}/{key}/{HEAD}", f"{home}/{key}/{TIMES}")


def stored_objects(root: Root, commits: Mapping[int, Commit], columns: Columns | None) -> Iterator[StoredObject]:
    """Yield all objects whose hash a record holds, without metadata. Results with a damaged head are left out."""
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
            yield from _objects_of_result(root, home, key)


def _objects_of_result(root: Root, home: str, key: str) -> Iterator[StoredObject]:
    try:
        bundle = read_bundle(root.location, home, key)
    except RunDamagedError:  # verification reads every head by itself
        return
    for name, (actual, expected) in bundle.files.items():
        yield StoredObject(
            f"{bundle.folder}/{actual}", expected, advice_for(bundle.folder), "", name in root.left_out
        )


def sizes_of(location: Location, objects: Iterable[StoredObject]) -> dict[str, int]:
    """Return the bytes of the objects that exist, with one listing per folder of the run."""
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
    """Return the keys of all objects that no record leads to, such as copies made by hand; nothing reads them.

    The `objects` are those of `stored_objects`.
    """
    expected = {*record_keys(root, commits, columns), *(stored.key for stored in objects)}
    return [key for key in root.location.keys("") if key not in expected and not _is_expected(key)]


def _is_expected(key: str) -> bool:
    """Whether an object is a picture, or unfinished work: episodes without a commit, sweeps that still run."""
    top, _, below = key.partition("/")
    return (
        top in ILLUSTRATIONS
        or (top == DATA and "/c/" in below)
        or (top in BUNDLES and below.partition("/")[0].endswith(PARTIAL))
        or key.endswith(".tmp")
    )


# -- copies without activations ----------------------------------------------------------------------------------


def copy_run(
    path: Path | str | Location,
    out: Path | str | Location,
    pictures: bool = False,
    allow_partial: bool = False,
    directions: bool = True,
    trajectories: bool = True,
) -> Run:
    """Copy the run at `path` to `out` without its activations, and open the copy.

    The copy holds plan, outcomes, trajectories, probes, interventions and certificates, byte for byte: every table
    can be made of it. Its identity, stamp and settings are those of the run. `column` and `tokens` raise
    ActivationsLeftOutError, and nothing can be added to it. The copy appears whole or not at all.

    Args:
        path: The folder or address of the run.
        out: The folder or address of the copy.
        pictures: Copy frames and videos too.
        allow_partial: Accept an unfinished run.
        directions: Copy the weights of probes, without which `ProbeResults.direction` raises RunDamagedError.
        trajectories: Copy what happened step by step, without which only the rule `disc` judges the last step.

    Raises:
        UsageError: If anything lies at `out`.
        DiskSpaceError: If the disk of `out` takes no more.
        ProbeKitError: For a run that `open_run` refuses.
    """
    run, target = open_run(path, allow_partial), locate(out)
    # `root.arrays` has the inputs of recordings besides the streams: states and small pictures are left out too.
    arrays = {*run.root.arrays, *(() if trajectories else (TRAJECTORY,))}
    left_out = {*arrays, *(() if directions else (PROBE_DIRECTIONS,))}
    keys = [key for key in _copied_keys(run, arrays, pictures, directions) if run.location.exists(key)]
    present = set(target.keys(""))
    if present - {*keys, LEFT_OUT_FILE} or (isinstance(target, Folder) and present):
        raise UsageError(f"{target} is not empty; give a new or empty folder for the copy")
    if isinstance(target, Folder):
        folder = Path(target.address)
        with full_disk_in_words(target.path), draft_of(folder) as draft:
            draft.mkdir()
            _write_copy(run, Folder(draft), keys, left_out)
            move_draft(draft, folder)
    else:  # a killed copy leaves objects and no root, and the next one writes them again
        with target.explained_errors():
            _write_copy(run, target, keys, left_out)
    return open_run(target, allow_partial)


def _copied_keys(run: Run, arrays: Collection[str], pictures: bool, directions: bool) -> Iterator[str]:
    """Yield the keys of all objects of a copy but its root, in order; `arrays` are those that are left out."""
    commits = {commit.episode: commit for commit in run.commits()}
    objects = (stored.key for stored in stored_objects(run.root, commits, None))
    for key in sorted({*record_keys(run.root, commits, None), *objects} - {RUN_FILE, LEFT_OUT_FILE}):
        inside = key.removeprefix(f"{DATA}/")
        left_out = inside != key and is_left_out(inside, arrays)
        if left_out or (not pictures and key.partition("/")[0] in ILLUSTRATIONS):
            continue
        if not directions and key.startswith(f"{PROBES}/") and key.rpartition("/")[2] == PROBE_DIRECTIONS:
            continue
        yield key


def _write_copy(run: Run, target: Location, keys: Sequence[str], left_out: Collection[str]) -> None:
    for key in keys:
        target.write(key, run.location.read(key))
    target.write(LEFT_OUT_FILE, LeftOut(run=run.root.identity, arrays=sorted(left_out)).to_bytes())
    target.write(RUN_FILE, run.location.read(RUN_FILE))  # last: without it there is no run
