"""Tables of episodes as two equal runs have them."""

import pandas as pd


def without_seconds(episodes: pd.DataFrame) -> pd.DataFrame:
    """`Run.episodes` without what the clock says."""
    return episodes.drop(columns=["seconds_inference", "seconds_simulation"])
