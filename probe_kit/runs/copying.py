"""Copies of runs without their activations, to be published or sent."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from probe_kit._system.drafts import draft_of, full_disk_in_words, move_draft
from probe_kit.errors import UsageError
from probe_kit.runs.contents import record_keys, stored_objects
from probe_kit.runs.folder import Folder
from probe_kit.runs.layout import (
    DATA,
    ILLUSTRATIONS,
    LEFT_OUT_FILE,
    PROBE_DIRECTIONS,
    PROBES,
    RUN_FILE,
    TRAJECTORY,
)
from probe_kit.runs.root import LeftOut, is_left_out
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.store import Location, locate


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
    ActivationsLeftOutError, and nothing can be added to it. pictures: copy frames and videos too. directions: copy
    the weights of probes, without which `ProbeResults.direction` raises RunDamagedError. trajectories: copy what
    happened step by step, without which only the rule `disc` judges the last step.
    The copy appears whole or not at all. Raises UsageError if anything lies at `out`, DiskSpaceError, and what
    `open_run` raises.
    """
    run, target = open_run(path, allow_partial), locate(out)
    # `root.arrays` has the inputs of recordings besides the streams: states and small pictures are left out too.
    arrays = {*run.root.arrays, *(() if trajectories else (TRAJECTORY,))}
    left_out = {*arrays, *(() if directions else (PROBE_DIRECTIONS,))}
    keys = [key for key in _copied_keys(run, arrays, pictures, directions) if run.location.exists(key)]
    present = set(target.keys(""))
    if present - {*keys, LEFT_OUT_FILE} or (isinstance(target, Folder) and present):
        raise UsageError(f"{target} is not empty; choose another place for the copy")
    if isinstance(target, Folder):
        folder = Path(target.address)
        with full_disk_in_words(target.path), draft_of(folder) as draft:
            draft.mkdir()
            _write_copy(run, Folder(draft), keys, left_out)
            move_draft(draft, folder)
    else:  # a killed copy leaves objects and no root, and the next one writes them again
        with target.in_words():
            _write_copy(run, target, keys, left_out)
    return open_run(target, allow_partial)


def _copied_keys(run: Run, arrays: Collection[str], pictures: bool, directions: bool) -> Iterator[str]:
    """The keys of all objects of a copy but its root, in order. arrays: those that are left out."""
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
