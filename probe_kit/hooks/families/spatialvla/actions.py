"""Actions as tokens: three per step, for movement, rotation and gripper.

A movement is a direction and a length: bins of polar angle, azimuth and radius. A rotation is bins of roll, pitch
and yaw. The edges of all bins belong to the checkpoint, which places them where its training data are dense.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError

STEP_TOKENS = 3
"""Tokens of one step, in the order of `ActionBins.slots`."""
_GRIPPER = 2
_MOVEMENT = {"theta": (0.0, np.pi), "phi": (-np.pi, np.pi), "r": (0.0, np.sqrt(3.0))}
_ROTATION = {"roll": (-1.0, 1.0), "pitch": (-1.0, 1.0), "yaw": (-1.0, 1.0)}
_GROUPS = {"translation": _MOVEMENT, "rotation": _ROTATION}
Floats = NDArray[np.float64]
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class ActionBins:
    """The ids that name actions, and their meaning.

    Attributes:
        first: The lowest id.
        edges: Edges of the bins of theta, phi, r, roll, pitch, yaw.
        spherical: False for a checkpoint whose three movement axes are Cartesian.
    """

    first: int
    edges: tuple[Floats, ...]
    spherical: bool = True

    @classmethod
    def of(cls, values: Mapping[str, Any], first: int, actions: int, source: str) -> "ActionBins":
        """Read the content of a `processor_config.json`.

        Edges come from `bin_policy`, where that is missing from the Gaussians in `gs_params`, or are even if
        `action_config` says that the distribution is uniform.

        Args:
            values: Content of the file.
            first: The lowest id that the model has for actions.
            actions: Number of ids that the model has for actions.
            source: Name of the file, for messages.

        Raises:
            CheckpointError: If a part is missing or contradicts itself or the model; the message names `source`.
        """
        settings = values.get("action_config") or {}
        counts = settings.get("num_bins") or {}
        if missing := [group for group in (*_GROUPS, "gripper") if group not in counts]:
            raise CheckpointError(f"{source}: action_config names no number of bins for {', '.join(missing)}")
        edges = tuple(
            _edges(values, group, axis, int(counts[group][f"{axis}_bins"]), source)
            for group, axes in _GROUPS.items()
            for axis in axes
        )
        bins = cls(first, edges, bool(settings.get("use_spherical", True)))
        counted = (bins.slots[-1].stop - first, int(counts["gripper"]))
        if counted != (actions, _GRIPPER):
            raise CheckpointError(
                f"{source}: its bins make {counted[0]} action tokens with {counted[1]} for the gripper; the model "
                f"has {actions} with {_GRIPPER}. The file belongs to another checkpoint"
            )
        return bins

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """The number of bins per axis."""
        return tuple(len(edges) - 1 for edges in self.edges)

    @cached_property
    def slots(self) -> tuple[range, range, range]:
        """The ids of movement, rotation and gripper."""
        movement = self.first + int(np.prod(self.counts[:3]))
        rotation = movement + int(np.prod(self.counts[3:]))
        return (
            range(self.first, movement),
            range(movement, rotation),
            range(rotation, rotation + _GRIPPER),
        )

    @property
    def content(self) -> list[Any]:
        """The values over which an identity of these bins is computed."""
        return [self.first, [edges.tolist() for edges in self.edges], self.spherical]

    def is_action(self, ids: Ids) -> NDArray[np.bool_]:
        """Return whether each id of (…, 3) names an action in its slot."""
        starts, stops = np.array([[slot.start, slot.stop] for slot in self.slots]).T
        return np.asarray((ids >= starts) & (ids < stops))

    def values(self, ids: Ids) -> Floats:
        """Return normalised actions (…, 7) of ids (…, 3); an id outside its slot counts as the nearest one inside.

        Movement and roll-pitch-yaw are in [-1, 1] from the middles of their bins, the gripper is 0 or 1.
        """
        movement, rotation, gripper = (
            np.clip(ids[..., k], slot.start, slot.stop - 1) - slot.start for k, slot in enumerate(self.slots)
        )
        axes = self._middles(movement, 0), self._middles(rotation, 3)
        xyz = np.clip(_cartesian(axes[0]) if self.spherical else axes[0], -1, 1)
        return np.concatenate([xyz, axes[1], (gripper[..., None] != 0).astype(np.float64)], axis=-1)

    def ids(self, values: Floats) -> Ids:
        """Return the ids (…, 3) of normalised actions (…, 7); values outside of [-1, 1] are clipped."""
        clipped = np.clip(values, -1, 1)
        axes = _spherical(clipped[..., :3]) if self.spherical else clipped[..., :3]
        parts = [
            self._index(axes, 0) + self.slots[0].start,
            self._index(clipped[..., 3:6], 3) + self.slots[1].start,
            (clipped[..., 6] >= 0.5) + self.slots[2].start,
        ]
        return np.stack(parts, axis=-1).astype(np.int64)

    def _middles(self, index: Ids, axis: int) -> Floats:
        """Return middles (…, 3) of the bins that `index` counts through, the last of the three axes fastest."""
        places = np.unravel_index(index, self.counts[axis : axis + 3])
        edges = self.edges[axis : axis + 3]
        return np.stack([(e[p] + e[p + 1]) / 2 for e, p in zip(edges, places, strict=True)], axis=-1)

    def _index(self, axes: Floats, axis: int) -> Ids:
        places = tuple(
            np.digitize(axes[..., k], edges[1:-1]) for k, edges in enumerate(self.edges[axis : axis + 3])
        )
        return np.asarray(np.ravel_multi_index(places, self.counts[axis : axis + 3]))


def _cartesian(axes: Floats) -> Floats:
    theta, phi, radius = np.moveaxis(axes, -1, 0)
    across = radius * np.sin(theta)
    return np.stack([across * np.cos(phi), across * np.sin(phi), radius * np.cos(theta)], axis=-1)


def _spherical(xyz: Floats) -> Floats:
    x, y, z = np.moveaxis(xyz, -1, 0)
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)], axis=-1)


def _edges(values: Mapping[str, Any], group: str, axis: str, count: int, source: str) -> Floats:
    stored = ((values.get("bin_policy") or {}).get(group) or {}).get(f"{axis}_bins")
    gaussian = (values.get("gs_params") or {}).get(axis)
    low, high = _GROUPS[group][axis]
    if stored is not None:
        edges = np.asarray(stored, np.float64)
    elif gaussian is not None:
        spread = max(float(gaussian["sigma"]), float(values.get("min_sigma") or 0.0))
        edges = equal_mass_edges(float(gaussian["mu"]), spread, low, high, count)
    elif (values.get("action_config") or {}).get("distribution") == "uniform":
        edges = np.linspace(low, high, count + 1)
    else:
        raise CheckpointError(
            f"{source} has neither bin_policy nor gs_params for {axis}: its action tokens have no meaning. "
            "Copy the file from the model's page again"
        )
    if edges.shape != (count + 1,) or not np.isfinite(edges).all() or (np.diff(edges) < 0).any():
        raise CheckpointError(f"{source}: {axis} has edges {edges.tolist()}; expected {count + 1} rising numbers")
    return edges


def equal_mass_edges(mean: float, deviation: float, low: float, high: float, count: int) -> Floats:
    """Return edges (count + 1,) between `low` and `high` of bins with equal mass under a Gaussian."""
    from scipy.special import ndtr, ndtri  # type: ignore[import-untyped]

    below, above = (float(ndtr((limit - mean) / deviation)) for limit in (low, high))
    edges = ndtri(np.linspace(below, above, count + 1)) * deviation + mean
    return np.asarray(np.clip(edges, low, high), np.float64)
