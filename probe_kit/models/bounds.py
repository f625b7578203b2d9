"""Limits on the numbers of a checkpoint: sizes, and scales of actions. Importing them loads no torch."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from probe_kit.errors import CheckpointError

MOST_STEPS = 1000
"""Limit of flow or diffusion steps, actions of a chunk, layers: far beyond any model, and no loop without end."""
LARGEST_SIZE = 1 << 24
_DEEPEST = 50
_STEPS = (
    "num_inference_steps", "num_steps", "diffusion_steps", "chunk_size", "n_action_steps", "n_obs_steps",
    "action_chunk_size", "num_hidden_layers", "num_layers", "n_layers", "depth", "num_vlm_layers",
    "num_expert_layers",
)  # fmt: skip
_SIZES = (
    "hidden_size", "intermediate_size", "vocab_size", "num_attention_heads", "num_key_value_heads", "head_dim",
    "max_state_dim", "max_action_dim",
)  # fmt: skip


def check_sizes(content: Any, source: str, _depth: int = 0) -> None:
    """Raise CheckpointError for a count in a configuration, at any depth, that is no whole number or absurd.

    -1 and null stand for "as the model has it".
    """
    if _depth > _DEEPEST or not isinstance(content, Mapping | list):
        return
    for name, value in content.items() if isinstance(content, Mapping) else enumerate(content):
        check_sizes(value, source, _depth + 1)
        most = MOST_STEPS if name in _STEPS else LARGEST_SIZE if name in _SIZES else None
        if most is None or value is None or isinstance(value, list | Mapping):
            continue
        if type(value) is not int or not -1 <= value <= most:
            raise CheckpointError(
                f"{source}: {name} is {value!r}; expected a whole number up to {most}. Take the original file"
            )


def check_bounds(low: ArrayLike, high: ArrayLike, source: str) -> None:
    """Raise CheckpointError unless the bounds of a normalisation are finite, and no upper one below its lower.

    Equal ones stand for a dimension that never moved.
    """
    below, above = _numbers(low, source), _numbers(high, source)
    if below.shape != above.shape or not (np.isfinite(below).all() and np.isfinite(above).all()):
        raise CheckpointError(
            f"{source}: lower bounds {below.shape} and upper bounds {above.shape} are not one finite number per "
            "dimension each. Take the original file"
        )
    if (above < below).any():
        at = int(np.argmax((above < below).ravel()))
        raise CheckpointError(
            f"{source}: dimension {at} has the upper bound {above.ravel()[at]:g} below the lower "
            f"{below.ravel()[at]:g}, which would turn its actions around. Take the original file"
        )


def check_deviations(mean: ArrayLike, deviation: ArrayLike, source: str) -> None:
    """Raise CheckpointError unless means and deviations are finite and no deviation is negative or all are 0."""
    centre, spread = _numbers(mean, source), _numbers(deviation, source)
    if centre.shape != spread.shape or not (np.isfinite(centre).all() and np.isfinite(spread).all()):
        raise CheckpointError(
            f"{source}: means {centre.shape} and deviations {spread.shape} are not one finite number per "
            "dimension each. Take the original file"
        )
    if (spread < 0).any() or (spread.size and not spread.any()):
        raise CheckpointError(f"{source}: deviations must be positive; found {spread.ravel()[:8].tolist()}")


def _numbers(values: ArrayLike, source: str) -> "np.ndarray[Any, np.dtype[np.float64]]":
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{source}: statistics are not numbers ({error}). Take the original file") from error
