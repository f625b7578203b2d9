"""Probe directions in a site's raw features, for steering."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import open_arrays
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.direction_files import about_direction, write_directions
from probe_kit.runs.results import Bundle

Place = tuple[str, str, Site]
"""A category, a view and a site."""


@dataclass(frozen=True)
class Direction:
    """The probes of one place in raw features: w · x + b > 0 reads `left`, one probe per outer fold (F).

    weights: (F, D) float32. intercepts: (F,). Each fold's probe never saw the episodes that fold tests
    (`Curve.fold_of`): to steer an episode without having trained on it, take its fold's row.
    spreads: (F,) deviation of the training samples along weights / ‖weights‖, the σ of a steering strength.
    """

    weights: NDArray[np.float32]
    intercepts: NDArray[np.float64]
    spreads: NDArray[np.float64]

    @property
    def unit(self) -> NDArray[np.float64]:
        """(D,) mean of the folds' unit weights, of length 1; zero where no probe has any weight."""
        lengths = np.linalg.norm(self.weights, axis=1, keepdims=True)
        mean = np.divide(self.weights, lengths, where=lengths > 0, out=np.zeros(self.weights.shape)).mean(axis=0)
        length = np.linalg.norm(mean)
        return np.asarray(mean / length if length else mean)

    @property
    def spread(self) -> float:
        """Mean of `spreads`."""
        return float(self.spreads.mean())


def save_directions(directions: Mapping[Place, Direction], file: BinaryIO) -> None:
    """Write to an uncompressed `.npz`, members `category/view/site/part`; views and sites hold no slash."""
    arrays = {
        f"{category}/{view}/{site}/{part}": array
        for (category, view, site), direction in directions.items()
        for part, array in vars(direction).items()
    }
    np.savez(file, allow_pickle=False, **arrays)


class StoredDirections(Mapping[Place, Direction]):
    """Directions in a file of stored results, each read when it is asked for.

    All of the file is checked once, before the first. Raises RunDamagedError then.
    """

    def __init__(self, bundle: Bundle, name: str) -> None:
        self._bundle, self._name = bundle, name
        self._checked = False

    def _open(self) -> BinaryIO:
        if not self._checked:
            self._bundle.check(self._name)
            self._checked = True
        return self._bundle.open(self._name)

    def __getitem__(self, key: Place) -> Direction:
        return self.read([key])[key]

    def read(self, places: Iterable[Place]) -> dict[Place, Direction]:
        """Several directions in one opening of the file. Raises KeyError for a place that was not probed."""
        directions = {}
        with self._open() as file, open_arrays(file) as arrays:
            for key in places:
                name = "/".join(map(str, key))
                if f"{name}/weights" not in arrays:
                    raise KeyError(key)
                directions[key] = Direction(
                    **{part: arrays[f"{name}/{part}"] for part in Direction.__annotations__}
                )
        return directions

    def __iter__(self) -> Iterator[Place]:
        with self._open() as file, open_arrays(file) as arrays:
            for name in dict.fromkeys(member.rpartition("/")[0] for member in arrays):
                category, view, site = name.rsplit("/", 2)
                yield category, view, Site.parse(site)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def read_directions(directions: Mapping[Place, Direction], places: Iterable[Place]) -> dict[Place, Direction]:
    """The directions of `places`, stored ones in one opening of their file. Raises KeyError for unknown places."""
    if isinstance(directions, StoredDirections):
        return directions.read(places)
    return {key: directions[key] for key in places}


def write_direction_file(directions: Mapping[Place, Direction], file: Path, weights: str | None) -> int:
    """Write the probes' directions for `intervene --direction FILE#NAME`, and return how many.

    A vector is the mean of the folds' unit weights, times the deviation of the samples along it: a coefficient
    counts deviations, toward `left`. weights: hash of the network's. Probes without any weight are left out.
    """
    vectors, about = {}, {}
    for (category, view, site), direction in read_directions(directions, directions).items():
        if direction.unit.any():
            name, about_name = about_direction(category, view, site, weights)
            vectors[name] = direction.unit * direction.spread
            about[name] = about_name
    write_directions(file, vectors, about)
    return len(vectors)
