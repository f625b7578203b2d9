"""Names of a feature's numbers are read in every spelling, and what does not fit is said."""

from typing import Any

import pytest

from probe_kit.hooks.families.shared.feature_names import names_misfit, names_of, read_names

ARMS = {"left": ["x", "y"], "right": ["x", "y"]}


@pytest.mark.parametrize(
    ("spelling", "names"),
    [
        (["x", "y", "z"], "x y z"),
        ([["x", "y", "z"]], "x y z"),
        ([["x", "y"], ["z"]], "x y z"),
        ({"motors": ["x", "y", "z"]}, "x y z"),
        ({"motors": [["x", "y", "z"]]}, "x y z"),
        ({"axes": ["x", "y"], "gripper": "z"}, "x y z"),
        ({"z": 2, "x": 0, "y": 1}, "x y z"),
        ({"2": "z", "0": "x", "1": "y"}, "x y z"),
        ({"arm": {"z": 2, "x": 0}, "hand": {"y": 1}}, "x y z"),
        (ARMS, "left.x left.y right.x right.y"),
        ([["x", "y"], ["x", "y"]], "0.x 0.y 1.x 1.y"),
        ({"left": {"y": 1, "x": 0}, "right": {"x": 0, "y": 1}}, "left.x left.y right.x right.y"),
    ],
    ids=str,
)
def test_names_are_read_in_the_order_of_the_numbers(spelling: Any, names: str) -> None:
    expected = tuple(names.split())
    assert read_names(spelling) == expected
    assert names_of(spelling, len(expected)) == expected
    assert names_misfit(spelling, len(expected)) == ""


@pytest.mark.parametrize(
    ("spelling", "reason"),
    [
        (["state"], "one name for all: state"),
        ("state", "one name for all: state"),
        (["x", "y"], "its 2 names do not fit: x, y"),
        ([["x", "y"], ["z", "w"]], "its 4 names do not fit: x, y, z, w"),
        ({"x": 0, "y": 0, "z": 1}, "no known spelling"),
        ([None, None, None], "no known spelling"),
    ],
    ids=str,
)
def test_names_that_do_not_fit_are_said(spelling: Any, reason: str) -> None:
    assert names_of(spelling, 3) is None
    assert reason in names_misfit(spelling, 3)


@pytest.mark.parametrize("spelling", [None, [], {}])
def test_where_nothing_is_named_nothing_is_said(spelling: Any) -> None:
    assert names_of(spelling, 3) is None
    assert names_misfit(spelling, 3) == ""
