"""Steering: a direction added to the tokens of one role, beside matched controls of the same norm.

A supplement to the interchange, not a replacement. What is added lies nowhere the network ever was; a dose has no
natural size; and at a large one every direction breaks the hand. So a dose counts half gaps between the class
means (2 goes from one to the other), controls are orthogonal directions of the data's own covariance with the same
norm, and both sides are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.intervene.edits.patching import Moved, patched
from probe_kit.intervene.edits.pooled_directions import DIRECTIONS, MEAN_DIFFERENCE, Axes, axes_of
from probe_kit.intervene.edits.sites import Place, places
from probe_kit.intervene.replay.conditions import Condition, Intervention, Plain, Played, Turn
from probe_kit.intervene.replay.image_tokens import TILES, role_tokens
from probe_kit.intervene.replay.session import Bench

Toward = Literal["wrong", "correct", "left", "right"]
DOSES = (1.0, 2.0, 4.0)


@dataclass(frozen=True, kw_only=True)
class Steer(Intervention):
    """Every place and dose, toward one side, and the same for the controls; dose 0 is always played as well.

    sites: patterns of places. role: whose tokens are moved, along the direction found in their own mean. doses: in
    half gaps of the class means along the direction. toward: the side, `wrong` and `correct` of the plain
    pictures. controls: so many orthogonal directions. Raises UsageError for a dose or side that cannot be.
    """

    sites: tuple[str, ...]
    role: str
    direction: str = MEAN_DIFFERENCE
    doses: tuple[float, ...] = DOSES
    toward: Toward = "wrong"
    controls: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.role in TILES:
            raise UsageError(
                f"{self.role} has no mean in the run from which a direction could be found; steer `image`, or "
                "exchange the tile (--kind interchange)"
            )
        if self.direction not in DIRECTIONS:
            raise UsageError(
                f"{self.direction!r} is no direction for a dose: steering adds one vector to every token. Use "
                f"{' or '.join(DIRECTIONS)}"
            )
        if self.toward not in get_args(Toward):
            raise UsageError(f"toward is {self.toward!r}; expected one of {', '.join(get_args(Toward))}")
        if not self.doses or not all(0 < dose <= 1000 for dose in self.doses):
            raise UsageError(f"doses are {self.doses}; expected positive numbers of half gaps, such as 1, 2, 4")
        if len(set(self.doses)) != len(self.doses):
            raise UsageError(f"doses are {self.doses}; give each once")

    @property
    def kind(self) -> str:
        """`steer`."""
        return "steer"

    def own_settings(self) -> dict[str, Any]:
        """Where, along what, how far and to which side."""
        return {
            "sites": list(self.sites), "role": self.role, "direction": self.direction, "doses": list(self.doses),
            "toward": self.toward, "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """Plain, then every place at dose 0 and every other, each with its controls. Raises UnknownSiteError."""
        found = {place.name: place for pattern in self.sites for place in places(pattern, bench.policy)}
        conditions: list[Condition] = [Plain()]
        for place in found.values():
            axes = axes_of(bench.run, place.only_site, self.role, self.direction, self.controls, self.seed)
            conditions.append(Pushed(place, self.role, self.direction, 0.0, self.toward, axes))
            conditions += [
                Pushed(place, self.role, name, dose, self.toward, axes)
                for dose in self.doses
                for name in (self.direction, *axes.control_names)
            ]
        return conditions


@dataclass(frozen=True)
class Pushed:
    """The tokens of one role at one place, moved along a direction."""

    place: Place
    role: str
    direction: str
    dose: float
    toward: Toward
    axes: Axes

    @property
    def name(self) -> str:
        """Place, role, direction and dose, apart by `|`."""
        return f"{self.place.name}|{self.role}|{self.direction}|{self.dose:g}"

    def play(self, turn: Turn) -> Played:
        """The plain inference with these tokens moved."""
        question, bench = turn.question, turn.bench
        left = question.side_correct == "left"
        side = {"left": 1.0, "right": -1.0, "correct": 1.0 if left else -1.0, "wrong": -1.0 if left else 1.0}
        length = self.dose * self.axes.half_gap(question.episode_id, question.category) * side[self.toward]
        unit = self.axes.of(self.direction, question.episode_id, question.category)
        tokens = role_tokens(bench.policy, question, self.place.stream, self.role, turn.memo)
        with patched(bench.policy, self.place.sites, tokens, Moved(np.float32(length) * unit)) as ledger:
            chunk = bench.act(question.seen, question.seed)
        return Played(chunk, ledger)
