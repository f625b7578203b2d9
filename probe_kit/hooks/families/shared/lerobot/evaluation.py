"""Evaluation settings that no checkpoint file contains: image size, state layout, statistics."""

from dataclasses import dataclass
from typing import Literal

from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.contract.state_layout import OPENNESS

Picture = Literal["padded", "padded-top-left", "squashed"]
PICTURES: tuple[Picture, ...] = ("padded", "padded-top-left", "squashed")
EVALUATION_OPTIONS = (
    Option(
        "statistics",
        str,
        "File with p01 and p99 of action and proprio, or bridge (shipped), where the checkpoint has none; "
        "none: its numbers are metres and radians.",
        "the checkpoint's",
        is_path=True,
    ),
    Option(
        "picture",
        str,
        "How pictures come to the network's resolution.",
        "as the checkpoint's layout implies",
        PICTURES,
    ),
    Option("openness", str, "release: as Act2Answer's evaluation has it.", "measured", OPENNESS),
)
"""The fields of `Evaluation` that users of any such policy set."""


@dataclass(frozen=True)
class Evaluation:
    """The treatment of observations and actions around the network; its fields are the options of loaders.

    statistics: a file, the name of a shipped one, `none` for numbers that are units already, or None for what the
    checkpoint says. picture: how a picture comes to the network's resolution; None for what the layout of the
    checkpoint implies. openness: the state's last number, see `state_layout`. unread: settings of an old
    config.json that are left out, comma-separated.
    """

    statistics: str | None = None
    picture: Picture | None = None
    openness: str = "measured"
    unread: str = ""
