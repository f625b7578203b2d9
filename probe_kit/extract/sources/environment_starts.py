"""The beginnings of episodes of an environment: what differs between two of them, and their hash."""

from collections.abc import Mapping
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.sources.environment import Step

FIRST_PICTURE = "the picture"
"""The name of `Observation.image` in messages."""


def start_digest(step: Step) -> str:
    """Return the BLAKE2b hash of pictures and state that a model is shown first, as 32 hexadecimal digits."""
    digest = blake2b(digest_size=16)
    for name, array in _arrays(step).items():
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def compare_steps(first: Step, second: Step) -> tuple[list[str], list[str]]:
    """Return what differs between two steps and what is equal, in words, with the size of the difference."""
    was, now = _arrays(first), _arrays(second)
    different, equal = list[str](), list[str]()
    for name in {**was, **now}:
        difference = _difference(was.get(name), now.get(name))
        (different if difference else equal).append(f"{name}{difference}")
    for name, same in (
        ("facts", dict(first.facts) == dict(second.facts)),
        ("done", bool(first.done) == bool(second.done)),
    ):
        if not same:
            different.append(name)
        elif name == "facts" and first.facts:
            equal.append(name)
    return different, equal


def _arrays(step: Step) -> Mapping[str, NDArray[np.generic]]:
    observation = step.observation
    cameras = {f"the camera {name!r}": picture for name, picture in sorted(observation.cameras.items())}
    return {FIRST_PICTURE: observation.image, **cameras, "the state": observation.state}


def _difference(was: NDArray[np.generic] | None, now: NDArray[np.generic] | None) -> str:
    """Return by how much two arrays differ, in brackets; empty where they are equal."""
    if was is None or now is None:
        return " (only once)"
    if was.shape != now.shape:
        return f" ({' × '.join(map(str, was.shape))}, then {' × '.join(map(str, now.shape))})"
    if np.array_equal(was, now):
        return ""
    distances = np.abs(was.astype(np.float64) - now.astype(np.float64))
    if was.ndim == 1:
        number = int(distances.argmax())
        return f" (number {number} by {distances[number]:.3g})"
    return f" ({distances.any(axis=-1).mean():.1%} of its pixels, by up to {distances.max():.0f} of 255)"
