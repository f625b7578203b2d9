"""Differences of class means as a file of directions, which `intervene --direction FILE#NAME` reads."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.runs.direction_files import about_direction, write_directions
from probe_kit.runs.export.vectors import StreamChoice, is_tokens
from probe_kit.runs.reader import SIDE, check_sides
from probe_kit.runs.run import Run


def write_class_means(run: Run, choices: Sequence[StreamChoice], file: Path) -> None:
    """Write half the difference of the means of left and right, per category, view and site, of all episodes.

    In raw features, so that a coefficient of 2 goes from one mean to the other. Equal means are left out. Raises
    UsageError for a run without sides, for views of tokens, and where no means differ.
    """
    check_sides(run, "an export of directions")
    episodes = run.episodes
    is_left = (episodes[SIDE] == "left").to_numpy()
    vectors: dict[str, NDArray[np.float32]] = {}
    about = {}
    for choice in choices:
        for view in choice.views:
            if is_tokens(view):
                raise UsageError(f"--view {view} with --format directions; take a pooled view, such as mean:image")
            for site in choice.sites:
                features = run.column(site, view).astype(np.float64)
                for category in dict.fromkeys(episodes["category"].astype(str)):
                    rows = (episodes["category"] == category).to_numpy()
                    left_rows, right_rows = features[rows & is_left], features[rows & ~is_left]
                    if not len(left_rows) or not len(right_rows):
                        continue
                    difference = left_rows.mean(axis=0) - right_rows.mean(axis=0)
                    if difference.any():
                        name, about[name] = about_direction(category, view, site, run.weights_sha256)
                        vectors[name] = (difference / 2).astype(np.float32)
    if not vectors:
        raise UsageError(f"{run.location}: the means of left and right are equal at all of these sites")
    write_directions(file, vectors, about)
