"""Options of `probe-kit extract` and `probe-kit dataset` that choose recordings."""

from functools import partial
from typing import Annotated

import typer

_option = partial(typer.Option, rich_help_panel="Recordings")

Dataset = Annotated[
    str | None,
    _option(
        "--dataset",
        metavar="FOLDER",
        help="Show frames of a LeRobotDataset (3.0) in place of a suite: a folder, or USER/NAME@COMMIT of the "
        "hub. The model does not act.",
    ),
]
Episodes = Annotated[
    str | None,
    _option("--episodes", metavar="START:STOP", help="Episodes of the data set, such as 0:5. Default: all."),
]
Select = Annotated[
    str | None,
    _option("--select", metavar="every:N", help="Frames of an episode, such as every:5. Default: every:1."),
]
Cameras = Annotated[
    list[str] | None,
    _option(
        "--camera",
        metavar="CAMERA=FEATURE",
        help="Which picture of the data set a camera of the model gets; repeatable. Default: equal names.",
    ),
]
Rotations = Annotated[
    list[str] | None,
    _option(
        "--rotate", metavar="CAMERA=DEGREES", help="Rotate the pictures of a camera by 90, 180 or 270 degrees."
    ),
]
Instruction = Annotated[
    str | None, _option("--instruction", help="What the model reads. Default: the task of each frame.")
]
NoPixels = Annotated[
    bool,
    _option("--no-pixels", help="Store no pictures at 32 × 32; two controls of labels are then not possible."),
]
