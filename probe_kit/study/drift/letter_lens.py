"""Accuracy of the logit lens at every layer, from the margins that `ask` stored."""

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract.vqa.scores import side_expected
from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.train.data.run_reader import RunReader


def lens_accuracy(run: RunReader, episodes: NDArray[np.str_]) -> NDArray[np.float64] | None:
    """(L,) share of these episodes in which layer l would answer with the right side; a tie counts as one half.

    None for a run without margins, which is every run but questions that are answered by letter.
    """
    stored: NDArray[np.float64] | None = run.lens_margins
    if stored is None:
        return None
    chosen = run.episodes["episode_id"].isin(episodes).to_numpy()
    margins = stored[chosen]
    if np.isnan(margins).any():
        return None
    query = (ask_of(run) or {}).get("object", "target")
    left = np.array([side_expected(query, side) == "left" for side in run.episodes["side_correct"][chosen]])
    signed = np.where(left[:, None], margins, -margins)
    return np.asarray(((signed > 0) + 0.5 * (signed == 0)).mean(axis=0))
