"""Units from an evaluation's statistics file: quantiles p01 and p99 of states and actions, as in INT-ACT."""

import hashlib
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.bounded_json import parse_json
from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.shared.lerobot.normaliser import outside

SHIPPED = ("bridge",)
"""Statistics that come with the package, by name."""
NO_STATISTICS = "none"
FILES = ("dataset_statistics.json", "bridge_statistics.json", "statistics.json")
"""Under these names a checkpoint's folder may hold them."""
_EPS = 1e-8
_OPEN = 0.5
"""Of the network's own number for the gripper, which ends in 1 for open and 0 for closed."""


@dataclass(frozen=True)
class Bounds:
    """p01 to -1 and p99 to 1. A state is clipped there; an action keeps its last number, open above a half.

    low, high: (D,) float32. source: what they come from. The rest is the interface of `Normaliser`.
    """

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    source: str
    mode: str = "BOUNDS"

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Physical units to the numbers the network reads; (..., D)."""
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPS) - 1
        return np.asarray(scaled.clip(-1, 1), np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Network output to physical units, and the gripper to 1 open or 0 closed; (..., D)."""
        metres = np.asarray((values + 1) / 2 * (self.high - self.low) + self.low, np.float32)
        # From the number of the network itself, which the statistics do not scale.
        metres[..., -1] = values[..., -1] > _OPEN
        return metres

    def slope(self, numbers: int) -> NDArray[np.float32]:
        """(D,) of `restore`; 0 of the gripper, which is open or closed."""
        slopes = np.asarray((self.high - self.low) / 2, np.float32) * np.ones(numbers, np.float32)
        slopes[-1] = 0
        return slopes

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., D): `slope` everywhere."""
        return self.slope(values.shape[-1]) * np.ones_like(values)

    def unusual(self, values: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(..., D): outside the bounds, where `normalise` clips."""
        return outside(values, self.low, self.high)


@dataclass(frozen=True)
class StatisticsFile:
    """A statistics file. sha256: of its bytes, for the identity of what was made with it."""

    name: str
    sha256: str
    content: dict[str, Any]

    @classmethod
    def read(cls, name: str) -> "StatisticsFile":
        """Read a file, or one of `SHIPPED`. Raises CheckpointError if `name` is neither or the file is no JSON."""
        if name in SHIPPED:
            return cls._of(f"{name} statistics shipped with probe_kit", _shipped(name))
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
        """p01 and p99 of actions or states. Raises CheckpointError unless they are `numbers` finite ones each."""
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
        return Bounds(low.astype(np.float32), high.astype(np.float32), self.name)


def _shipped(name: str) -> bytes:
    return (files("probe_kit.models") / f"{name}_statistics.json").read_bytes()


def statistics_in(folder: Path) -> str | None:
    """The statistics file that lies in a checkpoint's folder, or None."""
    return next((str(folder / name) for name in FILES if (folder / name).is_file()), None)
