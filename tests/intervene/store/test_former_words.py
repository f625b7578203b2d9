"""What was stored in format 1 is read in today's words."""

from io import BytesIO

import numpy as np

from probe_kit.intervene import ConditionOutcomes
from probe_kit.intervene.store.former_words import STORED_WORDS, current_certificate, current_settings
from probe_kit.intervene.store.settings import FORMAT
from tests.intervene.answers import follower, outcomes_of

FORMER = {"array": {now: then for then, now in STORED_WORDS["array"].items()}}


def former_bytes(outcomes: ConditionOutcomes, conditions: tuple[str, ...]) -> bytes:
    """As format 1 wrote it."""
    arrays = {
        FORMER["array"].get(name, name): value for name, value in vars(outcomes).items() if value is not None
    }
    file = BytesIO()
    np.savez_compressed(file, **{**arrays, "conditions": np.array(conditions)})
    return file.getvalue()


def test_conditions_and_arrays_have_todays_names_and_the_same_numbers() -> None:
    made = outcomes_of({"color": follower(8)})
    read = ConditionOutcomes.from_bytes(former_bytes(made, ("plain", "exchanged")), "follow")
    assert read.conditions == made.conditions == ("clean", "image_swap")
    np.testing.assert_array_equal(read.displacement, made.displacement)
    asked = ConditionOutcomes.from_bytes(former_bytes(made, ("exchanged", "pictures")), "words")
    assert asked.conditions == ("instruction_swap", "image_swap")
    inside = ConditionOutcomes.from_bytes(former_bytes(made, ("plain", "memory.02|all")), "interchange")
    assert inside.conditions == ("clean", "kv.02|all")


def test_settings_of_every_kind_are_those_of_today() -> None:
    steer = {
        "format": 1,
        "kind": "steer",
        "toward": "left",
        "doses": [1.0],
        "readout": "shadow",
        "sites": ["memory.*"],
    }
    assert current_settings(steer, FORMAT) == {
        "format": FORMAT, "kind": "steer", "target_side": "left", "coefficients": [1.0], "readout": "per-step",
        "sites": ["kv.*"],
    }  # fmt: skip
    loop = current_settings({"format": 1, "kind": "closed-loop", "cells": ["memory.02|all"]}, FORMAT)
    assert loop["targets"] == ["kv.02|all"]
    assert current_settings({"format": 1, "kind": "words"}, FORMAT)["kind"] == "instruction-swap"
    today = {"format": FORMAT, "kind": "follow"}
    assert current_settings(today, FORMAT) == today, "words of today's format are left alone"


def test_a_certificate_names_conditions_and_edits_as_today() -> None:
    edit = {"fires": 2.0, "still": 1.0, "norm": 3.0, "moved": 0.5, "largest": 0.9, "largest_change": 0.1}
    said = {
        "edits": {"memory.00|all": edit},
        "readable": {"backbone.02|image|none|0": {"color": 0.5}},
        "supported": {"kinds": ["follow", "memory"], "readout": "shadow"},
        "replay": {"equal": 3},
    }
    assert current_certificate(said, "erase") == {
        "edits": {
            "kv.00|all": {
                "fires": 2.0, "no_op_fires": 1.0, "norm": 3.0, "change": 0.5, "largest_change": 0.9,
                "max_action_change": 0.1,
            }
        },
        "probe_accuracy": {"backbone.02|image|none|0": {"color": 0.5}},
        "supported": {"kinds": ["swap", "kv"], "readout": "per-step"},
        "replay": {"equal": 3},
    }  # fmt: skip
