"""Physical units of GR00T, as lerobot's processor steps map them to numbers between −1 and 1."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.policies.groot.processor_groot import (
    GrootActionUnpackUnnormalizeStep,
    GrootN17ActionDecodeStep,
    GrootN17PackInputsStep,
)
from lerobot.policies.groot.utils import config_value
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.shared.lerobot.normaliser import outside
from probe_kit.models.bounds import check_bounds


@dataclass(frozen=True)
class BoundedUnits:
    """Numbers between −1 and 1. low, high: (D,) float32, what these stand for.

    clamp: whether values outside are moved to the bounds. sign: the number that becomes −1 or 1, as LIBERO's
    gripper; None where there is none.
    """

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    mode: str
    source: str
    clamp: bool = True
    sign: int | None = None

    def __post_init__(self) -> None:
        check_bounds(self.low, self.high, self.source)

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Physical units to the numbers the network reads; (..., D). A number without a range becomes 0."""
        span = self.high - self.low
        mapped = np.where(span == 0, 0, 2 * (values - self.low) / np.where(span == 0, 1, span) - 1)
        return np.asarray(mapped.clip(-1, 1) if self.clamp else mapped, np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Network output to physical units; (..., D)."""
        inside = values.clip(-1, 1) if self.clamp else values
        restored = np.asarray((inside + 1) * 0.5 * (self.high - self.low) + self.low, np.float32)
        if self.sign is not None:
            restored[..., self.sign] = -np.sign(2 * restored[..., self.sign] - 1)
        return restored

    def slope(self, numbers: int) -> NDArray[np.float32]:
        """(D,) of `restore`, where it does not clamp; 0 for a number that jumps."""
        own = np.asarray((self.high - self.low) / 2, np.float32)[:numbers].copy()
        if self.sign is not None:
            own[self.sign] = 0
        return own

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., D) of `restore` at these outputs of the network; 0 where it clamps."""
        inside = np.abs(values) <= 1 if self.clamp else np.ones(values.shape, bool)
        return np.asarray(inside * self.slope(values.shape[-1]), np.float32)

    def unusual(self, values: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(..., D): outside the bounds."""
        return outside(values, self.low, self.high)


def state_units(step: GrootN17PackInputsStep, numbers: int, source: str) -> BoundedUnits:
    """Of lerobot's packing step. Raises CheckpointError where it would let the state pass unchanged."""
    if not step.normalize_min_max:
        raise CheckpointError(f"{source} does not normalise the state: its units are unknown")
    low, high = _bounds((step.stats or {}).get("observation.state", {}), numbers, "observation.state", source)
    return BoundedUnits(low, high, "MIN_MAX", source, clamp=step.clip_outliers)


def action_units(
    step: GrootN17ActionDecodeStep | GrootActionUnpackUnnormalizeStep, numbers: int, source: str
) -> BoundedUnits:
    """Of lerobot's step that decodes actions.

    Raises CheckpointError for statistics that are missing, and for actions relative to the state: they have no
    unit of their own.
    """
    if isinstance(step, GrootN17ActionDecodeStep):
        return _grouped(step, numbers, source)
    if not step.normalize_min_max:
        raise CheckpointError(f"{source} does not normalise actions: their units are unknown")
    low, high = _bounds((step.stats or {}).get("action", {}), numbers, "action", source)
    jumps = step.libero_gripper_action and numbers >= 7
    if jumps and not step.libero_gripper_binarize:
        raise CheckpointError(f"{source} asks for a gripper between −1 and 1 that lerobot does not write itself")
    return BoundedUnits(
        low, high, "MIN_MAX", source, clamp=step.clip_normalized_action, sign=numbers - 1 if jumps else None
    )


def _grouped(step: GrootN17ActionDecodeStep, numbers: int, source: str) -> BoundedUnits:
    """The groups of NVIDIA's statistics side by side, in the order of the configuration."""
    own = (step.modality_config or {}).get("action", {})
    keys, kinds = own.get("modality_keys", []), own.get("action_configs", [])
    statistics = (step.raw_stats or {}).get("action", {})
    names = ("q01", "q99") if step.use_percentiles else ("min", "max")
    parts: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    where: dict[str, int] = {}
    for index, key in enumerate(keys):
        kind = kinds[index] if index < len(kinds) else {}
        if step.use_relative_action and config_value(kind.get("rep")) == "relative":
            raise CheckpointError(
                f"{source}: the actions of {key!r} are relative to the state in which the chunk was predicted; "
                "probe_kit does not add it. Capture with --no-act"
            )
        entry = statistics.get(key, {})
        if missing := [name for name in names if name not in entry]:
            raise CheckpointError(f"{source} has no statistics {', '.join(missing)} of the action {key!r}")
        where[key] = sum(len(low) for low, _ in parts)
        parts.append(tuple(np.atleast_1d(np.asarray(entry[name], np.float32)) for name in names))  # type: ignore[arg-type]
    nothing = np.zeros(0, np.float32)
    low, high = (np.concatenate([nothing, *(part[side] for part in parts)])[:numbers] for side in (0, 1))
    if len(low) != numbers:
        raise CheckpointError(f"{source} has statistics of {len(low)} numbers; an action has {numbers}")
    if step.action_decode_transform is not None and where.get("gripper", numbers) >= numbers:
        raise CheckpointError(f"{source} has no action 'gripper', which LIBERO's convention is about")
    sign = where["gripper"] if step.action_decode_transform is not None else None
    mode = "QUANTILES" if step.use_percentiles else "MIN_MAX"
    return BoundedUnits(low, high, mode, source, sign=sign)


def _bounds(
    statistics: Mapping[str, Any], numbers: int, feature: str, source: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Raises CheckpointError for statistics that are missing or of another length: lerobot fills them up."""
    found = [np.asarray(statistics.get(name, []), np.float32).reshape(-1) for name in ("min", "max")]
    if any(len(own) != numbers for own in found):
        raise CheckpointError(
            f"{source} has min and max of {[len(own) for own in found]} numbers for {feature}, which has "
            f"{numbers}: its units are unknown. Take the statistics of the data set it was trained on"
        )
    return found[0], found[1]
