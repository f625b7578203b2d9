"""What a client says of its episodes."""

from typing import Any

import numpy as np
import pytest

from probe_kit.errors import ObservationError
from probe_kit.serve.marks import Mark, read_mark


@pytest.mark.parametrize(
    ("sent", "mark"),
    [
        ({"id": "task3/7"}, Mark("task3/7")),
        ({"id": 7, "group": "task3", "step": 10}, Mark("7", "task3", 10)),
        ({"end": True}, Mark(end=True)),
        ({"end": True, "id": "a", "facts": {"success": 1}}, Mark("a", end=True, facts={"success": True})),
        ({"end": True, "facts": {"done": np.bool_(True)}}, Mark(end=True, facts={"done": True})),
    ],
)  # fmt: skip
def test_a_mark_names_an_episode_or_its_end(sent: dict[str, Any], mark: Mark) -> None:
    assert read_mark(sent) == mark


@pytest.mark.parametrize(
    ("sent", "complaint"),
    [
        ("a", "expected a map"),
        ({}, "it has no id"),
        ({"id": ""}, "plain characters"),
        ({"id": "a\x1b[31m"}, "plain characters"),
        ({"id": "x" * 201}, "plain characters"),
        ({"id": True}, "plain characters"),
        ({"id": "a", "seed": 3}, "'seed'"),
        ({"id": "a", "step": -1}, "step is -1"),
        ({"id": "a", "step": 2.0}, "step is 2.0"),
        ({"id": "a", "facts": {"success": True}}, "facts come with end"),
        ({"end": 1}, "end is 1"),
        ({"end": True, "facts": {"success": 0.5}}, "truth value"),
        ({"end": True, "facts": {"reward": float("nan")}}, "finite"),
        ({"end": True, "facts": {"note": "good"}}, "finite"),
        ({"end": True, "facts": {f"f{number}": 0 for number in range(65)}}, "at most 64"),
    ],
)
def test_an_invalid_mark_is_refused_with_the_value_that_was_seen(sent: object, complaint: str) -> None:
    with pytest.raises(ObservationError, match=complaint):
        read_mark(sent)
