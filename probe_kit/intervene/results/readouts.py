"""The behaviour by the readout that the table does not show: first chunk beside whole episode. Needs no model."""

from collections.abc import Mapping

from probe_kit.intervene.kinds.image_swap.effects import ImageSwapEffect, stored_image_swaps
from probe_kit.intervene.kinds.image_swap.verdict import UseVerdict, classify_behaviour, control_for
from probe_kit.intervene.store.settings import FIRST_CHUNK, PER_STEP
from probe_kit.train.data.run_reader import RunReader


def stored_other_readouts(run: RunReader, found: Mapping[str, ImageSwapEffect]) -> dict[str, UseVerdict]:
    """By category, the behaviour by the other readout; without categories in which that is not stored.

    found: what is shown, by category. The positive control is of the other readout too. Raises RunDamagedError.
    """
    stored = {readout: stored_image_swaps(run, readout) for readout in (FIRST_CHUNK, PER_STEP)}
    others: dict[str, UseVerdict] = {}
    for category, own in found.items():
        same = stored[PER_STEP if own.readout == FIRST_CHUNK else FIRST_CHUNK]
        if category in same:
            others[category] = classify_behaviour(same[category], control_for(category, same))
    return others
