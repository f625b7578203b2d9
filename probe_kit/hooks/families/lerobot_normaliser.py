"""Normalisation with the statistics a lerobot checkpoint carries in its processor files."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from probe_kit.errors import CheckpointError

# The two statistics each mode needs, as (offset-like, scale-like).
_NEEDED = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99")}


@dataclass(frozen=True)
class Normaliser:
    """An affine map per dimension, in lerobot's conventions (`NormalizerProcessorStep`, lerobot 0.6).

    mode: MEAN_STD, MIN_MAX, QUANTILES or IDENTITY. low, high: the two statistics, (D,) float32.
    source: the file they come from.
    """

    mode: str
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    eps: float
    source: str

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Physical units to the numbers the network reads; (..., D)."""
        if self.mode == "IDENTITY":
            return values
        if self.mode == "MEAN_STD":
            return np.asarray((values - self.low) / (self.high + self.eps), np.float32)
        span = np.where(self.high == self.low, self.eps, self.high - self.low)
        return np.asarray(2 * (values - self.low) / span - 1, np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Network output to physical units; (..., D)."""
        if self.mode == "IDENTITY":
            return values
        if self.mode == "MEAN_STD":
            return np.asarray(values * self.high + self.low, np.float32)
        span = np.where(self.high == self.low, self.eps, self.high - self.low)
        return np.asarray((values + 1) / 2 * span + self.low, np.float32)


def read_normaliser(folder: Path, pipeline: str, feature: str, kind: str) -> Normaliser:
    """The map of one feature from `<pipeline>.json` and the safetensors file it names.

    pipeline: `policy_preprocessor` or `policy_postprocessor`. feature: `observation.state` or `action`.
    kind: the feature's type in lerobot's norm_map, `STATE` or `ACTION`.
    Raises CheckpointError if statistics are missing: lerobot would let the values pass unchanged.
    """
    path = folder / f"{pipeline}.json"
    if not path.is_file():
        raise CheckpointError(f"{path} is missing: without it the units of {feature} are unknown")
    for step in json.loads(path.read_text())["steps"]:
        if step["registry_name"] in ("normalizer_processor", "unnormalizer_processor"):
            config = step["config"]
            mode = config["norm_map"].get(kind, "IDENTITY")
            if mode == "IDENTITY":
                return Normaliser(mode, np.zeros(0, np.float32), np.zeros(0, np.float32), 0.0, path.name)
            low, high = _statistics(folder, step.get("state_file"), feature, mode)
            return Normaliser(mode, low, high, float(config.get("eps", 1e-8)), step["state_file"])
    raise CheckpointError(f"{path} has no normaliser step: the units of {feature} are unknown")


def _statistics(
    folder: Path, name: str | None, feature: str, mode: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    if mode not in _NEEDED:
        raise CheckpointError(f"normalisation {mode!r} of {feature} is not one of {', '.join(_NEEDED)}, IDENTITY")
    path = folder / name if name else None
    arrays = load_file(path) if path is not None and path.is_file() else {}
    wanted = [f"{feature}.{statistic}" for statistic in _NEEDED[mode]]
    missing = [key for key in wanted if key not in arrays]
    if missing:
        raise CheckpointError(
            f"{folder} has no statistics {', '.join(missing)} (looked in {name}): its {feature} has no physical "
            "unit. Take the statistics of the data set it was trained on"
        )
    return arrays[wanted[0]], arrays[wanted[1]]
