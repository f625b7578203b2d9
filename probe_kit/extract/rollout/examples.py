"""An example of a model's input, from which token counts and requirements are computed before the run."""

from collections.abc import Iterable

import numpy as np

from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.observation import Observation


def example_observations(scene: SceneSpec, instructions: Iterable[str]) -> list[Observation]:
    """Per instruction one observation with a blank picture of the scene's size."""
    blank, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
    return [Observation(blank, state, text, scene.intrinsics) for text in instructions]


def check_unfit(card: ModelCard, batch: int, example: Observation) -> None:
    """Raise UsageError if a model takes smaller batches, or needs what the scene does not show."""
    if card.batch is not None and batch > card.batch:
        raise UsageError(
            f"--batch {batch} with {card.family}, which takes at most {card.batch} observations per call: more "
            f"would change its numbers; pass --batch {card.batch} and use --workers to go faster"
        )
    if lacking := example.lacks(card.needs):
        raise UsageError(
            f"{card.family} reads {', '.join(lacking)}, which this scene lacks; it has one picture, its "
            "intrinsics and the state"
        )
