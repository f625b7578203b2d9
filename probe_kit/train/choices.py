"""Choices of a probe sweep: targets, baselines and incomplete items. Importing them loads no library."""

from typing import Literal

Target = Literal["correct", "chosen", "shuffled"]
Incomplete = Literal["keep", "drop"]
Baseline = Literal["position", "instruction", "pixels", "random-features"]
Task = Literal["binary", "classes", "continuous"]
LabelControl = Literal["step", "state", "action", "instruction", "pixels", "random-features"]

TARGETS: dict[str, str] = {
    "correct": "side of the correct picture",
    "chosen": "side on which the cube was placed; episodes outside both zones are left out",
    "shuffled": "control: side of the correct picture, flipped for a random half of the items",
}
INCOMPLETE: dict[str, str] = {
    "keep": "items of which a layout is missing take part with the other",
    "drop": "they do not: the classes are balanced again",
}
BASELINES: dict[str, str] = {
    "position": "the layout alone",
    "instruction": "the words of the instruction, alone and with the layout",
    "pixels": "the two pictures, left and right, at 32 × 32 pixels; needs the suite",
    "random-features": "random nonlinear features of pictures and words, as wide as the site; needs the suite",
}
TASKS: dict[str, str] = {
    "binary": "one of two values; logistic probe, balanced accuracy",
    "classes": "one of several values; ridge on class indicators, balanced accuracy",
    "continuous": "a quantity; ridge, R²",
}
"""Tasks of labels of one's own."""
LABEL_CONTROLS: dict[str, str] = {
    "step": "the number of the captured inference alone; for labels that change within an episode",
    "state": "the pose of the hand and the opening of the gripper, or the recorded state; needs either",
    "action": "the recorded action at the frame; needs recordings, and is not run by default",
    "instruction": "the words of the instruction",
    "pixels": "the two pictures at 32 × 32 pixels; needs the suite",
    "random-features": "random nonlinear features of pictures, words and state; needs the suite",
}
"""Controls of labels of one's own."""
