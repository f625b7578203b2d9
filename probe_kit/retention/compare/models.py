"""Models as the unit of a comparison: the origin of a network, and the test of two groups of models."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Literal

import numpy as np

from probe_kit._tables.numbers import Limits
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.lineage import first_checkpoint
from probe_kit.retention.estimators import ACTION, BACKBONE, PooledScores, limits
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.model_groups import exchange_p, is_exchangeable, welch_interval
from probe_kit.statistics.retention import Scores, retention

# -- what a network grew from --------------------------------------------------------------------------------

_STEP = re.compile(r"(?:^|.*(?:step|checkpoint|ckpt|iter|iteration)s?[-_=]?)0*(\d{1,18})$", re.IGNORECASE)
"""The name of a folder of a training: `020000`, `checkpoint-500`, `step_20000`, `ckpt-3`."""
_INNER = ("pretrained_model", "model", "params", "weights")
"""Folders that trainers put below that of a step. Others are not skipped: a folder above may be a date."""


Relation = Literal["yes", "no", "unknown"]


def grew_from(policy: RunReader, vlm: RunReader) -> Relation:
    """Return whether the policy's network grew from the VLM's weights.

    Compares hash, hub id and number of parameters on both cards; `unknown` where they are too little. A family's
    name identifies the network and not the weights: another name is another source, the same name is no evidence.
    A card names its commit behind an @; the source of a family is known by repository only.
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
    """Return the card of the model that was really loaded; empty where a run has no certificate."""
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
    """Return the origin of every run's model, by location; runs of equal origin are of one model.

    A run without a declared origin has the folder of its training where its checkpoint is one of several steps. A
    released checkpoint that grew from another one that is compared too has the origin of that one; see
    `hooks.contract.lineage`. Otherwise a run has its weights, or else its own location.

    Args:
        runs: The runs that are compared.
        declared: Origins by location, such as `finetuned_from` of a study.

    Raises:
        UsageError: For a declared location that is none of the runs.
    """
    places = {str(run.location): run for run in runs}
    if strange := [location for location in declared or {} if location not in places]:
        raise UsageError(f"an origin is declared of {strange[0]}; expected one of the runs {', '.join(places)}")
    firsts = {location: first_checkpoint(_released_checkpoint(run)) for location, run in places.items()}
    with_sisters = {first for location, first in firsts.items() if first != _released_checkpoint(places[location])}
    return {
        location: (declared or {}).get(location)
        or (firsts[location] if firsts[location] in with_sisters else _origin(run))
        for location, run in places.items()
    }


def _released_checkpoint(run: RunReader) -> str:
    """Return the checkpoint of a run without its revision; empty for untrained weights, which grew from none."""
    return "" if card_of(run).get("random_weights") else checkpoint_of(run).partition("@")[0]


def _origin(run: RunReader) -> str:
    training = split_checkpoint(checkpoint_of(run))
    if training is not None and training[0]:
        return training[0]
    return run.weights_sha256 or str(run.location)


# -- two groups of models ------------------------------------------------------------------------------------

Sides = tuple[Sequence[Sequence[RowWithEstimates]], Sequence[Sequence[RowWithEstimates]]]
"""For either side and per category, the row of each run."""


@dataclass(frozen=True)
class ModelTest:
    """Two groups of models compared with the model as the unit.

    `p` and `smallest_p` are None where the spreads of the groups are too unlike, see `is_exchangeable`.

    Attributes:
        n: Models of the first group; runs of one origin are of one.
        n_minus: Models of the second group.
        difference: Difference of the groups' means.
        ci: Welch's 95 % interval of the difference.
        p: Exact and two-sided p of exchanging the models' labels, which tests equal distributions and not only
            equal means.
        smallest_p: The least p that so few models allow.
    """

    n: int
    n_minus: int
    difference: float
    ci: Limits
    p: float | None
    smallest_p: float | None

    @classmethod
    def of(cls, first: Sequence[float], second: Sequence[float], largest: float = inf) -> "ModelTest | None":
        """Return the test of one value per model; None for two single models, or where one has no value.

        Args:
            first: Values of the first group's models.
            second: Values of the second group's models.
            largest: The difference that no two groups can exceed, see `welch_interval`.
        """
        if len(first) + len(second) < 3 or not (first and second and all(map(isfinite, (*first, *second)))):
            return None
        gap, interval = float(np.mean(first) - np.mean(second)), limits(welch_interval(first, second, largest))
        if not is_exchangeable(first, second):
            return cls(len(first), len(second), gap, interval, None, None)
        test = exchange_p(first, second)
        return cls(len(first), len(second), gap, interval, test.p, test.smallest)


def compare_models(
    rows: Sides,
    origins: Mapping[str, str],
    value: Callable[[Sequence[RowWithEstimates]], float | None],
    largest: float = inf,
) -> ModelTest | None:
    """Return the test of two sides with a value per origin of models.

    None where a model has no value, or is on both sides: its labels cannot be exchanged.

    Args:
        rows: Rows of either side, by category and run.
        origins: Origin of each run's model, by location; by default its weights.
        value: The value of a run from its rows of all categories; None where it has none.
        largest: The difference that no two groups can exceed, see `ModelTest.of`.
    """
    first, second = (_by_model(side, value) for side in rows)
    if first is None or second is None or first.keys() & second.keys():
        return None
    return ModelTest.of(_by_origin(first, rows[0], origins), _by_origin(second, rows[1], origins), largest)


def _by_model(
    side: Sequence[Sequence[RowWithEstimates]], value: Callable[[Sequence[RowWithEstimates]], float | None]
) -> dict[str, float] | None:
    """Return the value of each model over its categories, see `_model`.

    Runs of one model, such as of several seeds, are averaged: they are no further models.
    """
    if len({len(of_category) for of_category in side}) != 1:  # a run lacks a category
        return None
    values: dict[str, list[float]] = {}
    for of_run in zip(*side, strict=True):
        of_model = value(of_run)
        if of_model is None:
            return None
        values.setdefault(_model(of_run[0]), []).append(of_model)
    return {model: float(np.mean(of_runs)) for model, of_runs in values.items()} or None


def _by_origin(
    values: Mapping[str, float], side: Sequence[Sequence[RowWithEstimates]], origins: Mapping[str, str]
) -> list[float]:
    """Return a value per origin: the mean of its models, which resemble each other."""
    origin_of: dict[str, str] = {}
    for row in side[0]:
        origin_of.setdefault(_model(row), origins.get(row.row.run.location, _model(row)))
    grouped: dict[str, list[float]] = {}
    for model, origin in origin_of.items():
        grouped.setdefault(origin, []).append(values[model])
    return [float(np.mean(models)) for models in grouped.values()]


def _model(row: RowWithEstimates) -> str:
    """Return the hash of a run's weights, or its location where that is unknown."""
    return row.row.run.weights_sha256 or row.row.run.location


def success_of_model(rows: Sequence[RowWithEstimates]) -> float | None:
    """Return the mean success rate of a run over its categories; None where one has none."""
    rates = [row.row.success.sr for row in rows if row.row.success.sr is not None]
    return float(np.mean(rates)) if len(rates) == len(rows) else None


def retention_of_model(rows: Sequence[RowWithEstimates]) -> float | None:
    """Return the retention of a run over its probed categories; None without both streams."""
    pooled = [None if row.streams is None else PooledScores.of([row.streams]) for row in rows]
    scores = [run.scores for run in pooled if run is not None and run.names == (ACTION, BACKBONE)]
    return retention(Scores.mean(scores)).value if scores else None
