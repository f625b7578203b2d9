"""Choices of a probe sweep: targets, baselines and incomplete items. Importing them loads no library."""

from typing import Literal

Target = Literal["correct", "chosen", "shuffled"]
Incomplete = Literal["keep", "drop"]
Baseline = Literal["position", "instruction", "pixels", "random-features"]

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
