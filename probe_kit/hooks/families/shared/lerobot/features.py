"""Names of features in lerobot's data sets and checkpoints. Imports no lerobot, so that plans read them too."""

from collections.abc import Iterable

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
_EMPTY_CAMERA = "empty_camera"
"""Beginning of the names that lerobot gives to cameras that never get a picture."""


def cameras_of(features: Iterable[str]) -> tuple[str, ...]:
    """Return the cameras among names of features that a picture can be given for, in their order."""
    names = (name.removeprefix(IMAGES) for name in features if name.startswith(IMAGES))
    return tuple(name for name in names if not name.startswith(_EMPTY_CAMERA))
