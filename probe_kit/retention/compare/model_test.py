"""Groups of models compared with the model as the unit: runs of one origin are of one model."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np

from probe_kit.retention.estimators.stream_scores import ACTION, BACKBONE, Limits, PooledScores, limits
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.statistics.estimates.retention import retention
from probe_kit.statistics.estimates.scores import Scores
from probe_kit.statistics.model_groups import exchange_p, is_exchangeable, welch_interval

Sides = tuple[Sequence[Sequence[RowWithEstimates]], Sequence[Sequence[RowWithEstimates]]]
"""Of either side and per category, the row of each run."""


@dataclass(frozen=True)
class ModelTest:
    """Two groups of models compared with the model as the unit.

    n, n_minus: models of either group; runs of one origin are of one. difference: of the groups' means, with
    Welch's 95 % interval. p: exact and two-sided, of exchanging the models' labels, which tests equal
    distributions and not only equal means; smallest_p: the least that so few models allow. Both are None where the
    smaller group has the larger spread, see `is_exchangeable`.
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

        largest: the difference that no two groups can exceed, see `welch_interval`.
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

    origins: what the model of each run grew from, by location; by default its weights. largest: see `ModelTest`.
    None where a model has no value, or is on both sides: its labels cannot be exchanged.
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
    pooled = [None if row.estimates.streams is None else PooledScores.of([row.estimates.streams]) for row in rows]
    scores = [run.scores for run in pooled if run is not None and run.names == (ACTION, BACKBONE)]
    return retention(Scores.mean(scores)).value if scores else None
