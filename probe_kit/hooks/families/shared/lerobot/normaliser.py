"""Units of a lerobot checkpoint: statistics of processor files, of old weights, or of an evaluation's file."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import load_file

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import shard_name
from probe_kit.hooks.contract.feature_statistics import LEVELS, FeatureStatistics
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    MASKED,
    NORMALISERS,
    reads_state_as_it_is,
    rename_map,
    saved_steps,
)
from probe_kit.models.bounds import check_bounds, check_deviations

_EPS = 1e-8
"""The number in denominators, where the checkpoint says no other: LeRobot's default."""
_STEPS = (*NORMALISERS, *MASKED)
# The two statistics each mode needs, as (offset-like, scale-like).
_NEEDED = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
_NAMED = {**_NEEDED, "BOUNDS": ("q01", "q99")}

# Prefixes of the statistics that old files kept among the weights; today they lie in the processor files.
STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")

Mask = NDArray[np.bool_] | bool


@dataclass(frozen=True)
class Normaliser:
    """A map per dimension between physical units and the numbers of a network, in lerobot's conventions.

    Attributes:
        mode: MEAN_STD, MIN_MAX, QUANTILES, QUANTILE10, IDENTITY, or several in words.
        low: (D,) float32, the values that stand for -1; the mean of numbers that are `scored`.
        high: (D,) float32, the values that stand for 1; the deviation of numbers that are `scored`.
        eps: A small number in place of a range or beside a deviation.
        source: The file that the statistics come from.
        scored: (D,) which numbers are mapped by mean and deviation; None for what `mode` says.
        plain: Mask of the numbers that stay as they are.
        clamped: Mask of the network's numbers that are moved to -1 to 1.
        sign: Index of the action that becomes −1 or 1, as LIBERO's gripper; None where there is none.
        stored: (D,) every statistic of the feature that the file holds, by lerobot's name.

    Raises:
        CheckpointError: For statistics that are not finite, or whose scale is not positive.
    """

    mode: str
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    eps: float
    source: str
    scored: NDArray[np.bool_] | None = None
    plain: Mask = False
    clamped: Mask = False
    sign: int | None = None
    stored: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scored = self._scored
        if self.low.shape != self.high.shape:
            check_bounds(self.low, self.high, self.source)  # which names the shapes
        if self.mode != "IDENTITY" and not scored.all():
            check_bounds(self.low[~scored], self.high[~scored], self.source)
        if scored.any():
            check_deviations(self.low[scored], self.high[scored], self.source)
        if not (np.isfinite(self.eps) and self.eps >= 0):
            raise CheckpointError(f"{self.source}: eps is {self.eps}; expected a small positive number")

    @property
    def _scored(self) -> NDArray[np.bool_]:
        return np.full(self.low.shape, self.mode == "MEAN_STD") if self.scored is None else self.scored

    @property
    def _span(self) -> NDArray[np.float32]:
        # eps where the number never changed, as lerobot has it: any other value then lies far outside [-1, 1].
        return np.asarray(np.where(self.high == self.low, self.eps, self.high - self.low), np.float32)

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map physical units (..., D) to the numbers the network reads; 0 without range and eps."""
        mapped = values
        if self.mode != "IDENTITY":
            span, deviation = self._span, self.high + self.eps
            bounded = np.where(span == 0, 0, 2 * (values - self.low) / np.where(span == 0, 1, span) - 1)
            still = deviation == 0  # NVIDIA leaves a number without deviation as it is
            scores = np.where(still, values, (values - self.low) / np.where(still, 1, deviation))
            mapped = np.where(self.plain, values, np.where(self._scored, scores, bounded))
        return np.asarray(np.where(self.clamped, mapped.clip(-1, 1), mapped), np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map network output (..., D) to physical units."""
        restored = self._line(np.where(self.clamped, values.clip(-1, 1), values))
        if self.sign is not None:
            restored[..., self.sign] = -np.sign(2 * restored[..., self.sign] - 1)
        return restored

    def _line(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return `restore` of values (..., D) without what clamps or jumps."""
        if self.mode == "IDENTITY":
            return np.asarray(values, np.float32)
        bounded = (values + 1) / 2 * self._span + self.low
        # Without eps, as in lerobot: not quite the inverse of `normalise`.
        scores = np.where(self.high + self.eps == 0, values, values * self.high + self.low)
        return np.asarray(np.where(self.plain, values, np.where(self._scored, scores, bounded)), np.float32)

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (..., D) by how much `restore` changes per unit of these outputs; 0 where it clamps or jumps.

        The slope is taken from two points, so that it is that of `restore` in every mode.
        """
        low, high = (self._line(np.full_like(values, value)) for value in (0, 1))
        slopes = np.asarray(np.where(self.clamped & (np.abs(values) > 1), 0, high - low), np.float32)
        if self.sign is not None:
            slopes[..., self.sign] = 0
        return slopes

    @property
    def statistics(self) -> FeatureStatistics | None:
        """The statistics with which physical values are compared; None where none normalise them.

        Numbers that stay as they are have statistics too, and are not compared.
        """
        if self.mode == "IDENTITY":
            return None
        low, high = next((pair for mode, pair in _NAMED.items() if self.mode.startswith(mode)), ("", ""))
        stored = FeatureStatistics.of(self.stored, len(self.low))
        values = {} if stored is None else dict(stored.values)
        for names, mask in (((low, high), ~self._scored), (("mean", "std"), self._scored)):
            for name, numbers in zip(names, (self.low, self.high), strict=True):
                if name and mask.any():
                    other = values.get(name, np.full(len(mask), np.nan))
                    values[name] = np.where(mask, numbers.astype(np.float64), other)
        return FeatureStatistics(values, np.broadcast_to(~np.asarray(self.plain), self.low.shape))


def read_normaliser(folder: Path, pipeline: str, feature: str, kind: str) -> Normaliser:
    """Read the map of one feature from `<pipeline>.json` and the safetensors file it names.

    Args:
        folder: The folder of the checkpoint.
        pipeline: `policy_preprocessor` or `policy_postprocessor`.
        feature: `observation.state` or `action`.
        kind: The feature's type in lerobot's norm_map, `STATE` or `ACTION`.

    Raises:
        CheckpointError: If statistics are missing: lerobot would let the values pass unchanged.
    """
    path = folder / f"{pipeline}.json"
    if not path.is_file():
        raise CheckpointError(f"{path} is missing: without it the units of {feature} are unknown")
    for step in saved_steps(folder, pipeline):
        if step.name in _STEPS:
            mode = (step.config.get("norm_map") or {}).get(kind, "IDENTITY")
            if mode == "IDENTITY" or (kind == "STATE" and reads_state_as_it_is(step, feature)):
                return Normaliser("IDENTITY", np.zeros(0, np.float32), np.zeros(0, np.float32), 0.0, path.name)
            low, high, stored = _statistics(folder, step.state, feature, mode)
            with while_reading(path):
                eps = float(step.config.get("eps", _EPS))
            return Normaliser(mode, low, high, eps, str(step.state), stored=stored)
    raise CheckpointError(f"{path} has no normaliser step: the units of {feature} are unknown")


def _statistics(
    folder: Path, name: str | None, feature: str, mode: str
) -> tuple[NDArray[np.float32], NDArray[np.float32], dict[str, NDArray[Any]]]:
    """Return the two statistics of a mode, and all of the feature by their names."""
    if mode not in _NEEDED:
        raise CheckpointError(f"normalisation {mode!r} of {feature} is not one of {', '.join(_NEEDED)}, IDENTITY")
    with while_reading(folder / str(name), advice="Download it again"):
        path = folder / shard_name(name) if name else None
        arrays = load_file(path) if path is not None and path.is_file() else {}
    keys = [f"{feature}.{statistic}" for statistic in _NEEDED[mode]]
    missing = [key for key in keys if key not in arrays]
    if missing:
        sources = [name for name, renamed in rename_map(folder).items() if renamed == feature]
        if source_name := next((source for source in sources if f"{source}.{_NEEDED[mode][0]}" in arrays), None):
            raise CheckpointError(
                f"{path} has the statistics of {source_name}, which the preprocessor's rename map calls "
                f"{feature}: lerobot looks them up as {feature}, and so leaves that feature as it is. Fine-tune "
                f"it on a data set whose feature is called {feature}"
            )
        raise CheckpointError(
            f"{folder} has no statistics {', '.join(missing)} (looked in {name}): its {feature} has no physical "
            "unit. Take the statistics of the data set it was trained on"
        )
    stored = {name: arrays[f"{feature}.{name}"] for name in (*LEVELS, "std") if f"{feature}.{name}" in arrays}
    return arrays[keys[0]], arrays[keys[1]], stored


def read_buffers(folder: Path) -> dict[str, NDArray[np.float32]]:
    """The statistics that lerobot kept among the weights until 2025, by their names there; mostly none.

    Raises:
        CheckpointError: If a weights file cannot be read.
    """
    buffers: dict[str, NDArray[np.float32]] = {}
    for path in sorted(folder.glob("model*.safetensors")):
        with while_reading(path, advice="Download the checkpoint again"), safe_open(path, "pt") as file:
            names = [name for name in file.keys() if name.startswith(STATISTICS)]  # noqa: SIM118
            buffers |= {name: file.get_tensor(name).float().numpy() for name in names}
    return buffers


def from_buffers(
    buffers: Mapping[str, NDArray[np.float32]], modes: Mapping[str, object], feature: str, kind: str, source: str
) -> Normaliser | None:
    """Return the map of one feature from old buffers; None where the configuration normalises nothing.

    Args:
        buffers: The statistics among the weights, see `read_buffers`.
        modes: `normalization_mapping` of the configuration.
        feature: `observation.state` or `action`.
        kind: The feature's type in `modes`, `STATE` or `ACTION`.
        source: The checkpoint whose weights they are, for messages.

    Raises:
        CheckpointError: If a buffer is missing, or was never filled.
    """
    stored_mode = modes.get(kind, "IDENTITY")
    mode = str(getattr(stored_mode, "value", stored_mode))
    if mode == "IDENTITY":
        return None
    if mode not in _NEEDED:
        raise CheckpointError(f"normalisation {mode!r} of {feature} is not one of {', '.join(_NEEDED)}, IDENTITY")
    module = "normalize_inputs" if kind == "STATE" else "unnormalize_outputs"
    names = [f"{module}.buffer_{feature.replace('.', '_')}.{statistic}" for statistic in _NEEDED[mode]]
    missing = [name for name in names if name not in buffers]
    unfilled = [name for name in names if name in buffers and not np.isfinite(buffers[name]).all()]
    if missing or unfilled:
        what = f"lack {', '.join(missing)}" if missing else f"hold {', '.join(unfilled)} without values"
        raise CheckpointError(
            f"{source} has no policy_preprocessor.json and its weights {what}: its {feature} has no physical "
            "unit. Take the statistics of the data set it was trained on"
        )
    return Normaliser(mode, buffers[names[0]], buffers[names[1]], _EPS, "the weights")


# -- statistics of an evaluation's file -----------------------------------------------------------------------

SHIPPED = ("bridge",)
"""Statistics that come with the package, by name."""
NO_STATISTICS = "none"
FILES = ("dataset_statistics.json", "bridge_statistics.json", "statistics.json")
"""The names under which a checkpoint's folder may hold statistics."""
_OPEN = 0.5
"""The threshold of the network's own number for the gripper, which ends in 1 for open and 0 for closed."""


@dataclass(frozen=True)
class Bounds(Normaliser):
    """A map of p01 to -1 and p99 to 1.

    A state is clipped there; an action keeps its last number, open above a half.
    """

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map physical units (..., D) to the numbers the network reads, clipped to -1 to 1."""
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPS) - 1
        return np.asarray(scaled.clip(-1, 1), np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map network output (..., D) to physical units, and the gripper to 1 open or 0 closed."""
        metres = super().restore(values)
        # From the number of the network itself, which the statistics do not scale.
        metres[..., -1] = values[..., -1] > _OPEN
        return metres

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the slopes of `restore` (..., D); 0 of the gripper, which is open or closed."""
        slopes = super().slopes(values)
        slopes[..., -1] = 0
        return slopes


@dataclass(frozen=True)
class StatisticsFile:
    """A statistics file.

    Attributes:
        sha256: Hash of its bytes, for the identity of what was made with it.
        content: The parsed JSON object.
    """

    name: str
    sha256: str
    content: dict[str, Any]

    @classmethod
    def read(cls, name: str) -> "StatisticsFile":
        """Read a file, or one of `SHIPPED`.

        Raises:
            CheckpointError: If `name` is neither or the file is no JSON.
        """
        if name in SHIPPED:
            return cls._of(f"{name} statistics shipped with probe_kit", _shipped_file(name))
        path = Path(name).expanduser()
        if not path.is_file():
            raise CheckpointError(
                f"no statistics at {name}: there is no such file, and shipped are only {', '.join(SHIPPED)}"
            )
        return cls._of(path.name, read_regular(path))

    @classmethod
    def _of(cls, name: str, content: bytes) -> "StatisticsFile":
        try:
            values = parse_json(content)
        except ValueError as error:
            raise CheckpointError(f"the statistics {name} are not JSON ({error})") from error
        if not isinstance(values, dict):
            raise CheckpointError(f"the statistics {name} are a {type(values).__name__}; expected an object")
        return cls(name, hashlib.sha256(content).hexdigest(), values)

    def bounds(self, part: Literal["action", "proprio"], numbers: int) -> Bounds:
        """The map by p01 and p99 of actions or states.

        Raises:
            CheckpointError: Unless they are `numbers` finite ones each.
        """
        group = self.content.get(part)
        rows = [np.asarray(group.get(name, []), np.float64) if isinstance(group, dict) else None
                for name in ("p01", "p99")]  # fmt: skip
        low, high = rows
        if low is None or high is None or low.shape != (numbers,) or high.shape != (numbers,):
            shapes = "none" if low is None or high is None else f"{low.shape} and {high.shape}"
            raise CheckpointError(
                f"the statistics {self.name} give p01 and p99 of {part} as {shapes}; this checkpoint needs "
                f"{numbers} numbers each"
            )
        if not np.isfinite([low, high]).all() or (high < low).any():
            raise CheckpointError(f"the statistics {self.name} of {part} are not finite or p99 lies below p01")
        return Bounds("BOUNDS", low.astype(np.float32), high.astype(np.float32), 0.0, self.name)


def _shipped_file(name: str) -> bytes:
    return (files(__package__) / f"{name}_statistics.json").read_bytes()


def statistics_in(folder: Path) -> str | None:
    """The statistics file that lies in a checkpoint's folder, or None."""
    return next((str(folder / name) for name in FILES if (folder / name).is_file()), None)
