"""Physical units of GR00T, as the processors of lerobot and of NVIDIA map them to the network's numbers."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
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
from probe_kit.hooks.contract.feature_statistics import LEVELS, FeatureStatistics
from probe_kit.hooks.families.groot.packing import StateFields
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser


@dataclass(frozen=True)
class StateUnits(Normaliser):
    """The state as NVIDIA's processor gives it to the network.

    Attributes:
        angles: (begin, end) of the groups in which the sines of all numbers, then their cosines stand for the
            numbers.
        excluded: Whether the network reads zeros in their place.
    """

    angles: tuple[tuple[int, int], ...] = ()
    excluded: bool = False

    @property
    def numbers(self) -> int:
        """The count of numbers that the network reads."""
        return len(self.low) + sum(end - begin for begin, end in self.angles)

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map physical units (..., D) to the numbers the network reads (..., numbers)."""
        if self.excluded:
            return np.zeros((*values.shape[:-1], self.numbers), np.float32)
        mapped, position = super().normalise(values), 0
        parts = []
        for begin, end in self.angles:
            angles = values[..., begin:end]
            parts += [mapped[..., position:begin], np.sin(angles), np.cos(angles)]
            position = end
        return np.asarray(np.concatenate([*parts, mapped[..., position:]], -1), np.float32)

    @property
    def statistics(self) -> FeatureStatistics | None:
        """The statistics with which states are compared; None where the state is not read.

        An angle in radians comes back after a turn; one in degrees lies outside the bounds and beyond a turn.
        """
        statistics = super().statistics
        if statistics is None or self.excluded:
            return None
        periodic = np.zeros(statistics.width, bool)
        for begin, end in self.angles:
            periodic[begin:end] = True
        return replace(statistics, periodic=periodic)


def state_units(
    step: GrootN17PackInputsStep, numbers: int, source: str, fields: StateFields | None = None
) -> Normaliser:
    """Return the units of lerobot's packing step, or of NVIDIA's processor where its `fields` are there.

    Args:
        step: The packing step of lerobot.
        numbers: The count of numbers of the state.
        source: The files the statistics come from, for messages.
        fields: The fields of NVIDIA's processor file; None in lerobot's layout.

    Raises:
        CheckpointError: Where it would let the state pass unchanged.
    """
    if fields is not None:
        return _nvidias_state(step, numbers, source, fields)
    if not step.normalize_min_max:
        raise CheckpointError(f"{source} does not normalise the state: its units are unknown")
    stored = (step.stats or {}).get("observation.state", {})
    low, high = _bounds(stored, numbers, "observation.state", source)
    return Normaliser("MIN_MAX", low, high, 0.0, source, clamped=step.clip_outliers, stored=stored)


def action_units(
    step: GrootN17ActionDecodeStep | GrootActionUnpackUnnormalizeStep,
    numbers: int,
    source: str,
    fields: StateFields | None = None,
) -> Normaliser:
    """Return the units of lerobot's step that decodes actions.

    Args:
        step: The step of lerobot that decodes actions.
        numbers: The count of numbers of an action.
        source: The files the statistics come from, for messages.
        fields: The fields of NVIDIA's processor file; None in lerobot's layout.

    Raises:
        CheckpointError: For statistics that are missing, and for actions relative to the state: they have no unit
            of their own.
    """
    if isinstance(step, GrootN17ActionDecodeStep):
        return _group_statistics(step, numbers, source, () if fields is None else fields.action_deviations)
    if not step.normalize_min_max:
        raise CheckpointError(f"{source} does not normalise actions: their units are unknown")
    stored = (step.stats or {}).get("action", {})
    low, high = _bounds(stored, numbers, "action", source)
    jumps = step.libero_gripper_action and numbers >= 7
    if jumps and not step.libero_gripper_binarize:
        raise CheckpointError(f"{source} asks for a gripper between −1 and 1 that lerobot does not write itself")
    sign = numbers - 1 if jumps else None
    clamped = step.clip_normalized_action
    return Normaliser("MIN_MAX", low, high, 0.0, source, clamped=clamped, sign=sign, stored=stored)


def _nvidias_state(step: GrootN17PackInputsStep, numbers: int, source: str, fields: StateFields) -> StateUnits:
    """Return the groups of the state side by side, each mapped in its own way."""
    keys = (step.modality_config or {}).get("state", {}).get("modality_keys", [])
    statistics = (step.raw_stats or {}).get("state", {})
    names = ("q01", "q99") if step.use_percentiles else ("min", "max")
    low, high, scored, ends = _side_by_side(keys, statistics, names, fields.deviations, f"{source}: the state")
    if len(low) != numbers:
        raise CheckpointError(f"{source} has statistics of {len(low)} numbers; the state has {numbers}")
    angles = tuple(ends[key] for key in keys if key in fields.angles)
    mode = f"{_mode(names, scored)} and SIN_COS" if angles else _mode(names, scored)
    mode = "EXCLUDED (zeros)" if fields.excluded else mode
    clamped = ~scored & step.clip_outliers
    units = StateUnits(
        mode, low, high, 0.0, source, scored=scored, clamped=clamped, angles=angles, excluded=fields.excluded,
        stored=_all_side_by_side(keys, statistics, numbers),
    )  # fmt: skip
    if units.numbers > step.max_state_dim:
        raise CheckpointError(
            f"{source}: the state with its sines and cosines has {units.numbers} numbers; the network reads "
            f"{step.max_state_dim}. Take the original files"
        )
    return units


def _side_by_side(
    keys: Sequence[str],
    statistics: Mapping[str, Any],
    names: tuple[str, str],
    scored: Collection[str],
    subject: str,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], dict[str, tuple[int, int]]]:
    """Return two statistics of groups as vectors, which numbers are scored, and where each group stands.

    Args:
        keys: The names of the groups, in order.
        statistics: The statistics of every group, by its name.
        names: The two statistics of groups that are not in `scored`.
        scored: The groups that are mapped by mean and deviation.
        subject: The file and the part of it, for messages.

    Raises:
        CheckpointError: For a statistic that is missing.
    """
    parts: tuple[list[NDArray[np.float32]], ...] = ([], [])
    flags: list[bool] = []
    ends: dict[str, tuple[int, int]] = {}
    for key in keys:
        entry, statistic_names = statistics.get(key, {}), ("mean", "std") if key in scored else names
        if missing := [name for name in statistic_names if name not in entry]:
            raise CheckpointError(f"{subject} {key!r} has no statistics {', '.join(missing)}")
        low, high = (np.atleast_1d(np.asarray(entry[name], np.float32)) for name in statistic_names)
        for part, side in zip(parts, (low, high), strict=True):
            part.append(side)
        ends[key] = (len(flags), len(flags) + len(low))
        flags += [key in scored] * len(low)
    nothing = np.zeros(0, np.float32)
    below, above = (np.concatenate([nothing, *part]) for part in parts)
    return below, above, np.array(flags, bool), ends


def _all_side_by_side(
    keys: Sequence[str], statistics: Mapping[str, Any], numbers: int
) -> dict[str, NDArray[np.float64]]:
    """Return every statistic (numbers,) that all groups have, the groups side by side."""
    entries = [statistics.get(key, {}) for key in keys]
    return {
        name: np.concatenate([np.atleast_1d(np.asarray(entry[name], np.float64)) for entry in entries])[:numbers]
        for name in (*LEVELS, "std")
        if entries and all(name in entry for entry in entries)
    }


def _mode(names: tuple[str, str], scored: NDArray[np.bool_]) -> str:
    bounds_mode = "QUANTILES" if names[0] == "q01" else "MIN_MAX"
    return bounds_mode if not scored.any() else "MEAN_STD" if scored.all() else f"{bounds_mode} and MEAN_STD"


def _group_statistics(
    step: GrootN17ActionDecodeStep, numbers: int, source: str, scored: Collection[str] = ()
) -> Normaliser:
    """Return the groups of NVIDIA's statistics side by side, in the order of the configuration.

    Args:
        step: The step of lerobot that decodes actions.
        numbers: The count of numbers of an action.
        source: The files the statistics come from, for messages.
        scored: Groups that are mapped by mean and deviation.

    Raises:
        CheckpointError: For statistics that are missing, and for actions relative to the state.
    """
    action = (step.modality_config or {}).get("action", {})
    keys, kinds = action.get("modality_keys", []), action.get("action_configs", [])
    statistics = (step.raw_stats or {}).get("action", {})
    names = ("q01", "q99") if step.use_percentiles else ("min", "max")
    for index, key in enumerate(keys):
        kind = kinds[index] if index < len(kinds) else {}
        if step.use_relative_action and config_value(kind.get("rep")) == "relative":
            raise CheckpointError(
                f"{source}: the actions of {key!r} are relative to the state in which the chunk was predicted; "
                "probe_kit does not add it. Capture with --no-act"
            )
    low, high, flags, ends = _side_by_side(keys, statistics, names, scored, f"{source}: the action")
    if len(low) < numbers:
        raise CheckpointError(f"{source} has statistics of {len(low)} numbers; an action has {numbers}")
    begin = ends["gripper"][0] if "gripper" in ends else numbers
    if step.action_decode_transform is not None and begin >= numbers:
        raise CheckpointError(f"{source} has no action 'gripper', which LIBERO's convention is about")
    sign = begin if step.action_decode_transform is not None else None
    low, high, flags = low[:numbers], high[:numbers], flags[:numbers]
    stored = _all_side_by_side(keys, statistics, numbers)
    return Normaliser(
        _mode(names, flags), low, high, 0.0, source, scored=flags, clamped=~flags, sign=sign, stored=stored
    )


def _bounds(
    statistics: Mapping[str, Any], numbers: int, feature: str, source: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The minima and maxima of a feature.

    Raises:
        CheckpointError: For statistics that are missing or of another length: lerobot fills them up.
    """
    bounds = [np.asarray(statistics.get(name, []), np.float32).reshape(-1) for name in ("min", "max")]
    if any(len(bound) != numbers for bound in bounds):
        raise CheckpointError(
            f"{source} has min and max of {[len(bound) for bound in bounds]} numbers for {feature}, which has "
            f"{numbers}: its units are unknown. Take the statistics of the data set it was trained on"
        )
    return bounds[0], bounds[1]
