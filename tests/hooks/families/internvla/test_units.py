import numpy as np
import pytest

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.internvla import ActionUnits
from tests.support.internvla_checkpoints import statistics

LOW, HIGH = [-1.0] * 6 + [0.0], [3.0] * 6 + [1.0]


def test_values_are_clipped_and_stretched_and_the_gripper_is_cut_at_a_half() -> None:
    units = ActionUnits.of("x", {"q01": LOW, "q99": HIGH, "mask": [True] * 6 + [False]})
    given = np.array([[-2, -1, 0, 0.5, 1, 5, 0.5], [0, 0, 0, 0, 0, 0, 0.49]], np.float32)
    np.testing.assert_allclose(units.restore(given)[0], [-1, -1, 1, 2, 3, 3, 1])
    np.testing.assert_allclose(units.restore(given)[1, 6], 0)


def test_a_masked_in_gripper_is_stretched_after_it_was_cut() -> None:
    units = ActionUnits.of("x", {"q01": LOW, "q99": HIGH})
    assert units.restore(np.full((1, 7), 0.2, np.float32))[0, 6] == 0.5
    assert units.restore(np.full((1, 7), 0.7, np.float32))[0, 6] == 1.0


def test_the_only_set_needs_no_name_and_several_have_to_be_chosen_from() -> None:
    with pytest.raises(UsageError, match="with -M unnorm_key=NAME: bridge_dataset, fractal"):
        ActionUnits.choose(statistics(), None)
    assert ActionUnits.choose({"franka": statistics()["bridge_dataset"]}, None).key == "franka"
    two = {"franka": {}, "google": {}}
    with pytest.raises(UsageError, match="franka, google"):
        ActionUnits.choose(two, None)
    with pytest.raises(UsageError, match="Did you mean franka"):
        ActionUnits.choose(two, "frank")


def test_bad_statistics_are_named() -> None:
    with pytest.raises(CheckpointError, match="q99"):
        ActionUnits.choose({"franka": {"action": {"q01": [0.0]}}}, None)
    with pytest.raises(CheckpointError, match="finite"):
        ActionUnits.of("x", {"q01": [0.0, np.inf], "q99": [1.0, 1.0]})
    with pytest.raises(CheckpointError, match=r"dataset_statistics\.json"):
        ActionUnits.choose({}, None)
