import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from probe_kit.errors import CheckpointError
from probe_kit.models.spatialvla_actions import ActionBins, equal_mass_edges
from tests.support.spatialvla_checkpoints import BINS, FIRST_ACTION, processor_values

AXES = ("theta", "phi", "r", "roll", "pitch", "yaw")
GAUSSIANS = {axis: {"mu": 0.1 * index, "sigma": 0.3} for index, axis in enumerate(AXES)}


def bins(**fields: Any) -> ActionBins:
    return ActionBins.of(processor_values(**fields), FIRST_ACTION, BINS["total"], "file")


def test_the_three_slots_follow_each_other_and_end_the_vocabulary() -> None:
    movement, rotation, gripper = bins().slots
    assert (len(movement), len(rotation), len(gripper)) == (24, 12, 2)
    assert (movement.start, rotation.start, gripper.start) == (FIRST_ACTION, movement.stop, rotation.stop)
    assert gripper.stop == FIRST_ACTION + BINS["total"]


def test_every_rotation_and_gripper_id_is_found_again_from_its_value() -> None:
    own = bins()
    ids = np.array([[own.slots[0][0], r, g] for r in own.slots[1] for g in own.slots[2]])
    np.testing.assert_array_equal(own.ids(own.values(ids))[:, 1:], ids[:, 1:])


def test_every_movement_that_no_edge_cuts_off_is_found_again_from_its_value() -> None:
    own = bins()
    ids = np.array([[m, own.slots[1][0], own.slots[2][0]] for m in own.slots[0]])
    values = own.values(ids)
    inside = (np.abs(values[:, :3]) < 1).all(axis=1)
    assert inside.sum() == 12  # the inner of two radii
    np.testing.assert_array_equal(own.ids(values)[inside], ids[inside])


def test_a_movement_is_direction_and_length() -> None:
    """Straight up, by hand: the smallest polar angle, the smaller radius."""
    own = bins()
    theta, phi, radius = own.edges[:3]
    middles = [(edges[0] + edges[1]) / 2 for edges in (theta, phi, radius)]
    expected = middles[2] * np.array(
        [np.sin(middles[0]) * np.cos(middles[1]), np.sin(middles[0]) * np.sin(middles[1]), np.cos(middles[0])]
    )
    ids = np.array([slot.start for slot in own.slots])
    np.testing.assert_allclose(own.values(ids)[:3], np.clip(expected, -1, 1))
    second_radius = own.values(ids + np.array([1, 0, 0]))[:3]
    assert np.linalg.norm(second_radius) > np.linalg.norm(expected)


def test_an_id_outside_its_slot_counts_as_the_nearest_and_is_not_known() -> None:
    own = bins()
    inside = np.array([slot[0] for slot in own.slots])
    below, above = np.array([0, 0, 0]), np.array([slot[-1] for slot in own.slots])
    np.testing.assert_array_equal(own.values(below), own.values(inside))
    np.testing.assert_array_equal(own.values(above + 100), own.values(above))
    assert own.is_action(inside).all()
    assert not own.is_action(below).any()
    assert own.is_action(np.stack([inside, inside[::-1]])).tolist() == [[True] * 3, [False, True, False]]


def test_the_gripper_is_closed_or_open() -> None:
    own = bins()
    for value, expected in ((-1, 0), (0.49, 0), (0.5, 1), (1, 1)):
        found = own.values(own.ids(np.array([0.1, 0.2, 0.3, 0, 0, 0, value])))
        assert found[6] == expected


def test_where_edges_are_absent_they_come_from_the_gaussians() -> None:
    own = bins(bin_policy=None, gs_params=GAUSSIANS)
    for edges, (axis, shape) in zip(own.edges, GAUSSIANS.items(), strict=True):
        mass = np.diff(norm.cdf(edges, shape["mu"], shape["sigma"]))
        np.testing.assert_allclose(mass, mass[0], rtol=1e-6, err_msg=axis)
    assert own.edges[0][0] == 0
    assert own.edges[1][-1] == pytest.approx(np.pi)


def test_a_floor_of_the_deviation_is_kept() -> None:
    narrow = {axis: {**shape, "sigma": 0.01} for axis, shape in GAUSSIANS.items()}
    floored = bins(bin_policy=None, gs_params=narrow, min_sigma=0.3)
    np.testing.assert_allclose(floored.edges[3], equal_mass_edges(0.3, 0.3, -1, 1, 2))


def test_even_edges_have_to_be_asked_for() -> None:
    even = {**processor_values()["action_config"], "distribution": "uniform"}
    np.testing.assert_allclose(bins(bin_policy=None, action_config=even).edges[4], [-1, -1 / 3, 1 / 3, 1])
    with pytest.raises(CheckpointError, match="neither bin_policy nor gs_params for theta"):
        bins(bin_policy=None)


def test_axes_may_be_cartesian() -> None:
    plain = {**processor_values()["action_config"], "use_spherical": False}
    own = bins(action_config=plain)
    ids = np.array([slot.start for slot in own.slots])
    expected = [(edges[0] + edges[1]) / 2 for edges in own.edges[:3]]
    np.testing.assert_allclose(own.values(ids)[:3], np.clip(expected, -1, 1))


def test_bins_of_another_checkpoint_are_refused() -> None:
    with pytest.raises(CheckpointError, match="make 38 action tokens"):
        ActionBins.of(processor_values(), FIRST_ACTION, 8194, "file")
    more = {**BINS, "rotation": {**BINS["rotation"], "yaw_bins": 5}}
    with pytest.raises(CheckpointError, match="yaw has edges"):
        bins(action_config={**processor_values()["action_config"], "num_bins": more})
    with pytest.raises(CheckpointError, match="no number of bins for translation"):
        bins(action_config={})


def test_the_originals_tables_are_reproduced_exactly(golden_spatialvla: Path) -> None:
    values = json.loads((golden_spatialvla / "checkpoint" / "processor_config.json").read_text(encoding="utf-8"))
    model = json.loads((golden_spatialvla / "checkpoint" / "config.json").read_text(encoding="utf-8"))
    first, actions = model["action_token_begin_idx"], model["spatial_token_num"]
    own = ActionBins.of(values, first, actions, "golden")
    with np.load(golden_spatialvla / "reference.npz") as arrays:
        recorded = {name: arrays[name] for name in ("tok_actions", "tok_ids", "tok_decoded", "decode_table")}
    np.testing.assert_array_equal(own.ids(recorded["tok_actions"]), recorded["tok_ids"])
    np.testing.assert_allclose(own.values(recorded["tok_ids"]), recorded["tok_decoded"], rtol=0, atol=1e-12)
    every = np.repeat(np.arange(len(recorded["decode_table"]))[:, None], 3, axis=1)
    np.testing.assert_allclose(own.values(every), recorded["decode_table"], rtol=0, atol=1e-12)
    gaussian = ActionBins.of({k: v for k, v in values.items() if k != "bin_policy"}, first, actions, "golden")
    for ours, stored in zip(gaussian.edges, own.edges, strict=True):
        np.testing.assert_allclose(ours, stored, rtol=0, atol=1e-12)
