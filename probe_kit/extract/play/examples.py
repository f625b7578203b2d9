"""What a model will be shown, before anything is played: token counts and requirements are known from it."""

import numpy as np

from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.hooks.card import Card
from probe_kit.hooks.observation import Observation
from probe_kit.suite import Suite


def example_observations(scene: SceneSpec, suite: Suite) -> list[Observation]:
    """Per instruction of the suite one observation with a blank picture of the scene's size, in text order."""
    blank, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
    texts = sorted({item.instruction for item in suite.items})
    return [Observation(blank, state, text, scene.intrinsics) for text in texts]


def refuse_unfit(card: Card, batch: int, example: Observation) -> None:
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
