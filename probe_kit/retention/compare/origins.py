"""The origins of models: checkpoints of one training, and models of one origin, count as one model.

Sister checkpoints resemble each other. Counted one by one they make p over models too small.
"""

import re
from collections.abc import Mapping, Sequence

from probe_kit.errors import UsageError
from probe_kit.retention.compare.source_weights import card_of
from probe_kit.runs.reader import RunReader

_STEP = re.compile(r"(?:^|.*(?:step|checkpoint|ckpt|iter|iteration)s?[-_=]?)0*(\d+)$", re.IGNORECASE)
"""A folder of a training: `020000`, `checkpoint-500`, `step_20000`, `ckpt-3`."""
_INNER = ("pretrained_model", "model", "params", "weights")
"""Folders that trainers put below that of a step. Others are not skipped: a folder above may be a date."""


def checkpoint_of(run: RunReader) -> str:
    """Return the checkpoint that a run's certificate names; empty where it names none."""
    return str(card_of(run).get("checkpoint", ""))


def split_checkpoint(checkpoint: str) -> tuple[str, int] | None:
    """Return the folder of the training and the step of a checkpoint's path; None where it names no step."""
    folders = [name for name in re.split(r"[/\\]", checkpoint) if name]
    while folders and folders[-1] in _INNER:
        folders.pop()
    if folders and (match := _STEP.match(folders[-1])):
        return "/".join(folders[:-1]), int(match[1])
    return None


def origins_of(runs: Sequence[RunReader], declared: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return what the model of every run grew from, by location; runs of equal origin are of one model.

    declared: origins by location, such as `finetuned_from` of a study. Other runs have the folder of their
    training where their checkpoint is one of several steps, else their weights, else their own location. Raises
    UsageError for a declared location that is none of the runs.
    """
    places = {str(run.location): run for run in runs}
    if strange := [location for location in declared or {} if location not in places]:
        raise UsageError(f"an origin is declared of {strange[0]}; expected one of the runs {', '.join(places)}")
    return {location: (declared or {}).get(location) or _origin(run) for location, run in places.items()}


def _origin(run: RunReader) -> str:
    training = split_checkpoint(checkpoint_of(run))
    if training is not None and training[0]:
        return training[0]
    return run.weights_sha256 or str(run.location)
