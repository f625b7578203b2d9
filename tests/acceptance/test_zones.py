"""Cubes that end close to the edge of a picture's zone: which of them count as placed.

The scripted expert is stopped while it carries the cube, so that the cube ends centimetres from the middle.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit

SEVEN_CM, SEVENTEEN_CM, TWENTY_TWO_CM = 14, 12, 10
"""Steps of the expert, by the distance from the middle of the picture at which the cube is then."""


def stopped(folder: Path, steps: int, *more: object, model: str = "expert") -> pk.Run:
    """Play two questions for so many steps."""
    settings = ("--categories", "color", "--items", "2", "--env-workers", "0", "--max-steps", steps)
    probe_kit("extract", "--model", model, *settings, *more, "--out", folder)
    return pk.open_run(folder)


def distances(run: pk.Run, mirrored: bool = False) -> np.ndarray:
    """(episodes,) metres between cube and the middle of the picture that the expert goes to, seen from above."""
    metres = []
    for episode, side in zip(run.episodes["episode_id"], run.episodes["side_correct"], strict=True):
        moved = run.trajectory(episode)
        left = (side == "left") != mirrored
        tile = moved.tile_left if left else moved.tile_right
        metres.append(np.hypot(*(moved.cube[-1, :2] - tile[-1, :2])))
    return np.array(metres)


def rules(run: pk.Run, *words: object) -> dict[str, Any]:
    """Success rates by rule and by radius, as JSON."""
    answer = probe_kit("retention", run.path, *words, "--format", "json").json()
    held: dict[str, Any] = next(row for row in answer if row["category"] == "color")["rules"]
    return held


@pytest.mark.slow
@pytest.mark.parametrize(("model", "inside"), [("expert", "correct"), ("expert-mirrored", "wrong")])
def test_a_cube_is_placed_up_to_the_radius_and_not_beyond_it(model: str, inside: str, tmp_path: Path) -> None:
    run = stopped(tmp_path / "measured", SEVEN_CM, model=model)
    away = distances(run, mirrored=model == "expert-mirrored")
    assert np.ptp(away) < 0.01 * away.mean()
    assert 0.05 < away.mean() < 0.09
    for name, share, expected in (("wider", 1.05, inside), ("narrower", 0.95, "oob")):
        radius = round(share * float(away.mean()), 4)
        scored = stopped(tmp_path / name, SEVEN_CM, "--epsilon", radius, model=model)
        assert set(scored.episodes["outcome"]) == {expected}
        assert scored.episodes["epsilon"].tolist() == [radius] * 4
        assert rules(scored)["sr_by_rule"]["disc"] == (expected == "correct"), "judged again from the trajectory"


@pytest.mark.slow
def test_radii_of_a_table_are_metres_from_the_middle_of_the_correct_picture(tmp_path: Path) -> None:
    run = stopped(tmp_path / "run", SEVEN_CM)
    assert run.episodes["distance_correct"].to_numpy() == pytest.approx(distances(run), abs=1e-6)
    radii = [round(share * float(distances(run).mean()), 4) for share in (0.6, 0.95, 1.05, 1.9)]
    rates = rules(run, "--epsilons", ",".join(map(str, radii)))["sr_by_epsilon"]
    assert {float(radius): rate for radius, rate in rates.items()} == dict(zip(radii, (0, 0, 1, 1), strict=True))


@pytest.mark.slow
def test_the_square_of_the_released_rule_ends_between_seventeen_and_twenty_two_centimetres(tmp_path: Path) -> None:
    for steps, rate in ((SEVENTEEN_CM, 1), (TWENTY_TWO_CM, 0)):
        assert rules(stopped(tmp_path / str(steps), steps))["sr_by_rule"]["box"] == rate
