"""The choices of a probe sweep: sides, tasks, controls and incomplete items. Importing them loads no library."""

from typing import Literal

Side = Literal["side.correct", "side.chosen", "side.shuffled"]
Incomplete = Literal["keep", "drop"]
Control = Literal["position", "step", "state", "action", "instruction", "random-features", "pixels"]
Task = Literal["binary", "classes", "continuous"]
Chance = Literal["half", "permuted"]

CORRECT: Side = "side.correct"
"""The target of probes unless another is named."""
CHOSEN: Side = "side.chosen"
"""The target that only what a policy did or answered has."""
SIDES: dict[str, str] = {
    CORRECT: "side of the correct picture",
    CHOSEN: "side on which the cube was placed (rule disc), or that a VLM named; others are left out",
    "side.shuffled": "control: side of the correct picture, flipped for a random half of the items",
}
"""Targets that are sides of a picture."""
EVERYWHERE = "all"
"""Category that holds the episodes of all categories, and the only stratum where groups exchange everywhere."""
INCOMPLETE: dict[str, str] = {
    "keep": "items of which a layout is missing take part with the other",
    "drop": "they do not: the classes are balanced again",
}
CONTROLS: dict[str, str] = {
    "position": "the layout alone",
    "step": "the number of the captured inference alone; for labels that change within an episode",
    "state": "the pose of the hand and the opening of the gripper, or the recorded state; needs either",
    "action": "the recorded action at the frame; needs recordings, and is not run by default",
    "instruction": "the words of the instruction; for a side alone and with the layout",
    "random-features": "random nonlinear features of pictures and words, as wide as the site; needs pictures",
    "pixels": "the pictures at 32 × 32 pixels; needs the suite, or recorded frames",
}
TASKS: dict[str, str] = {
    "binary": "one of two values; logistic probe, balanced accuracy",
    "classes": "one of several values; ridge on class indicators, balanced accuracy",
    "continuous": "a quantity; ridge, R²",
}
