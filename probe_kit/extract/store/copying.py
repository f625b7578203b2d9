"""Copies of runs without their activations, to be published or sent."""

from pathlib import Path

from probe_kit.errors import UsageError
from probe_kit.extract.run_layout import (
    DATA,
    ILLUSTRATIONS,
    LEFT_OUT_FILE,
    PROBE_DIRECTIONS,
    PROBES,
    RUN_FILE,
    TRAJECTORY,
)
from probe_kit.extract.store.format.left_out import is_left_out, left_out_record
from probe_kit.extract.store.integrity.orphans import known_keys
from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.locations.location import Location
from probe_kit.extract.store.run import Run, open_run


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
    Raises UsageError if anything lies at `out`, and what `open_run` raises.
    """
    run, there = open_run(path, allow_partial), locate(out)
    if there.keys(""):
        raise UsageError(f"{there} is not empty; choose another place for the copy")
    arrays = {*run.root.arrays, *(() if trajectories else (TRAJECTORY,))}
    commits = {commit["episode"]: commit for commit in run.commits()}
    for key in sorted({*known_keys(run.root, commits, None, run.stamp)} - {RUN_FILE}):
        inside = key.removeprefix(f"{DATA}/")
        unwanted = inside != key and is_left_out(inside, arrays)
        if unwanted or (not pictures and key.partition("/")[0] in ILLUSTRATIONS):
            continue
        if not directions and key.startswith(f"{PROBES}/") and key.rpartition("/")[2] == PROBE_DIRECTIONS:
            continue
        if run.location.exists(key):
            there.write_record(key, run.location.read(key))
    there.write_record(LEFT_OUT_FILE, left_out_record(run.root.identity, arrays))
    there.write_record(RUN_FILE, run.location.read(RUN_FILE))  # last: without it there is no run
    return open_run(there, allow_partial)
