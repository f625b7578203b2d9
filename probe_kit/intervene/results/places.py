"""Where stored interventions found that the answer passes and is read, for verdicts. Needs no model."""

from collections.abc import Sequence

from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.kinds.image_swap.verdict import Places
from probe_kit.intervene.kinds.joint.effects import (
    EVERY,
    JointEffect,
    describe_joint_places,
    describe_remainder,
    stored_joint_places,
)
from probe_kit.intervene.results.site_maps import stored_carrying_directions, stored_localised_sites
from probe_kit.train.data.run_reader import RunReader


def stored_places(run: RunReader) -> dict[str, Places]:
    """By category, of interchanges and joint places; without categories that were not searched.

    Raises RunDamagedError.
    """
    located, carried = stored_localised_sites(run), stored_carrying_directions(run)
    searched = {name: rows for name, rows in stored_joint_places(run).items() if _says_where(rows)}
    jointly = {name: describe_joint_places(rows) for name, rows in searched.items()}
    rest = {name: describe_remainder(rows) for name, rows in searched.items()}
    return {
        name: Places(located.get(name), carried.get(name, ()), jointly.get(name, ""), rest.get(name, ""))
        for name in dict.fromkeys((*located, *carried, *jointly))
    }


def _says_where(rows: Sequence[JointEffect]) -> bool:
    """Whether a search belongs into a verdict: one of a part that carries nothing does not rule out the others."""
    (every,) = (row for row in rows if row.part == EVERY)
    return every.finding != "past it" or every.cells == KV_STREAM
