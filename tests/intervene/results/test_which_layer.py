"""The line that says which layer matters, of interchanges and probes that are stored."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.hooks import Site
from probe_kit.intervene.results.results import load_effects
from probe_kit.intervene.settings import FORMAT
from probe_kit.train import ArrayRun, train_probes
from tests.intervene.answers import follower, outcomes_of, store_outcomes

EPISODES = 24
ANSWERS = outcomes_of({"color": follower(EPISODES)})
UNTESTED = "--kind interchange tests where the answer passes"
OPEN = "--kind joint tests where it is read"
UNREAD = "the probes' best site backbone.03 is unread: nothing that acts reads the end of the backbone"
PASSES = {
    **{f"backbone.{layer:02d}|{role}": 1.0 for layer in (0, 1, 2) for role in ("all", "image")},
    **{f"backbone.{layer:02d}|language": 0.0 for layer in range(4)},
    "backbone.03|all": 0.0,
    "backbone.03|image": 0.0,
}
"""Where the answer passes in the embedded policy, in the pictures' tokens of the first layers."""


@pytest.fixture
def run(tmp_path: Path) -> ArrayRun:
    """Of a policy of the embedded family: the answer is planted at the end of its backbone."""
    episodes = pd.DataFrame(
        {
            "episode_id": ANSWERS.episodes, "item_id": ANSWERS.items, "group_id": ANSWERS.groups,
            "category": ANSWERS.categories, "side_correct": ANSWERS.sides, "layout": "original",
            "outcome": "correct", "side_placed": ANSWERS.sides,
        }
    )  # fmt: skip
    draw = np.random.default_rng(0)
    left = np.where(ANSWERS.sides == "left", 1.0, -1.0)[:, None]
    features = {
        (Site("backbone", layer), "mean"): draw.normal(size=(EPISODES, 4)) + 4 * left * (layer == 3)
        for layer in range(4)
    }
    return ArrayRun(tmp_path, "pi0-tiny", "suite@1#0123456789ab", episodes, features)


def store(run: ArrayRun, moves: Mapping[str, float], kind: str = "interchange", **settings: Any) -> None:
    """Store an intervention; moves: by condition, the share of episodes that go where the swap brings them."""
    turned = np.arange(EPISODES)
    rows = [
        np.where(turned < share * EPISODES, ANSWERS.of("image_swap"), ANSWERS.of("clean"))
        for share in moves.values()
    ]
    displacement = np.vstack([ANSWERS.displacement, *rows])
    outcomes = replace(
        ANSWERS,
        conditions=(*ANSWERS.conditions, *moves),
        displacement=displacement,
        max_action_change=np.abs(displacement - displacement[0]),
        edit_log=np.ones((*displacement.shape, 5)),
    )
    common = {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": ["color"], "readout": "first-chunk", "direction": "none",
    }  # fmt: skip
    store_outcomes(run.location, run.suite, {**common, **settings}, outcomes)


def line(run: ArrayRun) -> str:
    """The line below the newest intervention's table."""
    result = load_effects(run)
    text, (parts,) = result.sentences[-1].removeprefix("Which layer, Color: "), result.layers.values()
    assert text == f"{'; '.join(parts)}."
    assert result.findings[-1] == f"Which layer, Color: {parts[0]}."
    return text.removesuffix(".")


def test_after_an_interchange_it_names_where_the_answer_passes_and_where_to_steer(run: ArrayRun) -> None:
    train_probes(run, permutations=50, controls=())
    store(run, PASSES)
    assert line(run).split("; ") == [
        "passes at backbone.01, backbone.02",
        "steer at backbone.02 image with --direction mean-difference:1",
        OPEN,
        UNREAD,
    ]


def test_where_a_block_of_keys_and_values_carries_it_the_block_is_named(run: ArrayRun) -> None:
    store(run, PASSES)
    store(run, {"kv.00|image": 0.0, "kv.01|image": 0.0, "kv.02|image": 1.0}, sites=["kv.*"])
    assert "read at kv.02 image" in line(run).split("; ")
    assert OPEN not in line(run)


def test_where_no_layer_carries_it_no_place_to_steer_is_named(run: ArrayRun) -> None:
    train_probes(run, permutations=50, controls=())
    store(run, dict.fromkeys(PASSES, 0.0))
    assert line(run).split("; ") == ["no layer of the backbone carries half of it", OPEN, UNREAD]


def test_without_an_interchange_and_probes_it_names_the_commands_that_are_missing(run: ArrayRun) -> None:
    steered = {"backbone.01|image|mean-difference|2": 0.0}
    store(run, steered, "steer", direction="mean-difference", target_side="wrong", seed=0)
    assert line(run).split("; ") == [UNTESTED, OPEN, "there are no probes, which probe-kit train makes"]


@pytest.mark.parametrize(
    ("direction", "turned", "is_said"),
    [("mean-difference", 0.0, True), ("mean-difference", 1.0, False), ("mean-difference:1", 0.0, False)],
)
def test_steering_by_one_vector_that_moves_nothing_says_which_direction_may(
    run: ArrayRun, direction: str, turned: float, is_said: bool
) -> None:
    """The embedded policy marks the tokens of one tile: the same vector on all of them changes no action."""
    condition = f"backbone.02|image|{direction}|2"
    store(run, {condition: turned}, "steer", direction=direction, target_side="wrong", seed=0)
    notes = [note for note in load_effects(run).notes if "one vector that is added to every token" in note]
    assert len(notes) == is_said
    assert all("color: " in note and "--direction mean-difference:1" in note for note in notes)
