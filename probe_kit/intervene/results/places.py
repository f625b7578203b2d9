"""Where stored interventions found that the answer passes and is read, for verdicts. Needs no model."""

from probe_kit.intervene.kinds.image_swap.verdict import Places
from probe_kit.intervene.kinds.joint.effects import describe_joint_places, stored_joint_places
from probe_kit.intervene.results.site_maps import stored_carrying_directions, stored_localised_sites
from probe_kit.train.data.run_reader import RunReader


def stored_places(run: RunReader) -> dict[str, Places]:
    """By category, of interchanges and joint places; without categories that were not searched.

    Raises RunDamagedError.
    """
    located, carried = stored_localised_sites(run), stored_carrying_directions(run)
    jointly = {category: describe_joint_places(rows) for category, rows in stored_joint_places(run).items()}
    return {
        category: Places(located.get(category), carried.get(category, ()), jointly.get(category, ""))
        for category in dict.fromkeys((*located, *carried, *jointly))
    }
