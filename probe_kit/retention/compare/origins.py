"""The origins of models: what a network grew from; checkpoints of one training count as one model.

Sister checkpoints resemble each other. Counted one by one they make p over models too small.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from probe_kit.errors import UsageError
from probe_kit.runs.reader import RunReader

_STEP = re.compile(r"(?:^|.*(?:step|checkpoint|ckpt|iter|iteration)s?[-_=]?)0*(\d+)$", re.IGNORECASE)
"""A folder of a training: `020000`, `checkpoint-500`, `step_20000`, `ckpt-3`."""
_INNER = ("pretrained_model", "model", "params", "weights")
"""Folders that trainers put below that of a step. Others are not skipped: a folder above may be a date."""


Relation = Literal["yes", "no", "unknown"]


def grew_from(policy: RunReader, vlm: RunReader) -> Relation:
    """Compares hash, hub id and number of parameters on both cards; `unknown` where they are too little.

    A family's name says which network it is and not which weights: another name is another source, the same name
    is no evidence. A card names its commit behind an @; the source of a family is known by repository only.
    """
    grown, vlm_card = card_of(policy), card_of(vlm)
    if grown.get("random_weights") or vlm_card.get("random_weights"):
        return "no"
    source = grown.get("source_weights") or {}
    if source.get("sha256"):
        return "yes" if source["sha256"] == vlm_card.get("weights_sha256") else "no"
    if source.get("checkpoint") and source["checkpoint"] == str(vlm_card.get("checkpoint")).partition("@")[0]:
        return "yes"
    sizes = source.get("parameters"), vlm_card.get("parameters")
    evidence = sizes if None not in sizes else (grown.get("source"), vlm_card.get("family"))
    return "no" if None not in evidence and len(set(evidence)) == 2 else "unknown"


def card_of(run: RunReader) -> Mapping[str, Any]:
    """Return what was really loaded; empty where a run has no certificate."""
    certificate: Mapping[str, Any] = run.certificate
    card: Mapping[str, Any] = certificate.get("policy") or {}
    return card


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
