"""Steering: a direction added to the tokens of one role, with matched controls of the same norm.

One vector for all tokens cannot move an answer that lies in *which* tokens are marked: it marks all of them alike.
`mean-difference:K` has a vector for each position, which takes the mark from one tile to the other.

A supplement to the interchange, not a replacement. The sum may lie off the network's distribution, a coefficient
has no natural size, and at a large one every direction disrupts the task. So coefficients count half class-mean
differences (2 goes from one mean to the other), controls are orthogonal directions of the data's own covariance
with the same norm, and both sides are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, get_args

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edit_engine import apply_patch
from probe_kit.hooks.capturing.token_edits import AddVector
from probe_kit.intervene.edits.pooled_directions import MEAN_DIFFERENCE
from probe_kit.intervene.edits.sites import SiteGroup, resolve_all
from probe_kit.intervene.kinds.base import ConditionName
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ConditionContext,
    ConditionResult,
    ImagesSwapped,
    Intervention,
)
from probe_kit.intervene.replay.image_tokens import TILES, role_tokens
from probe_kit.intervene.replay.passed_over import PassedOver
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.replay.token_directions import DirectionBasis, check_direction, fit_token_directions
from probe_kit.intervene.store.settings import items_of
from probe_kit.runs.run import Run

TargetSide = Literal["wrong", "correct", "left", "right"]
COEFFICIENTS = (1.0, 2.0, 4.0)


@dataclass(frozen=True, kw_only=True)
class Steering(Intervention):
    """Every place and coefficient, toward one side, and the same for the controls; 0 is always played as well.

    sites: patterns of places. role: whose tokens are moved. direction: `mean-difference` or `probe`, one vector
    found in the mean of these tokens and added to each; or `mean-difference:K`, at each position the difference of
    the class means there, within the K directions that positions share.
    coefficients: in half class-mean differences along the direction. target_side: `wrong` and `correct` are those
    of the clean images. controls: so many orthogonal directions. Raises UsageError for a coefficient or side that
    does not exist.
    """

    sites: tuple[str, ...]
    role: str
    direction: str = MEAN_DIFFERENCE
    coefficients: tuple[float, ...] = COEFFICIENTS
    target_side: TargetSide = "wrong"
    controls: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.role in TILES:
            raise UsageError(
                f"{self.role} has no mean in the run from which a direction could be found; steer `image`, or "
                "patch the tile (--kind interchange)"
            )
        check_direction(self.direction)
        if self.target_side not in get_args(TargetSide):
            raise UsageError(
                f"target_side is {self.target_side!r}; expected one of {', '.join(get_args(TargetSide))}"
            )
        if not self.coefficients or not all(0 < coefficient <= 1000 for coefficient in self.coefficients):
            raise UsageError(f"coefficients are {self.coefficients}; expected positive numbers, such as 1, 2, 4")
        if len(set(self.coefficients)) != len(self.coefficients):
            raise UsageError(f"coefficients are {self.coefficients}; give each once")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Raises UsageError without sites or with other than one role."""
        roles = options.pop("roles", ())
        if "sites" not in options or len(roles) != 1:
            raise UsageError(
                "--kind steer needs --sites and one of --roles, such as --sites backbone.02 --roles image"
            )
        return super().from_options(run, role=roles[0], **options)

    @property
    def kind(self) -> str:
        """`steer`."""
        return "steer"

    @property
    def fits_first(self) -> bool:
        """Where its direction is of tokens."""
        return ":" in self.direction

    def parameters(self) -> dict[str, Any]:
        """Where, along what, how far and to which side."""
        return {
            "sites": list(self.sites), "role": self.role, "direction": self.direction,
            "coefficients": list(self.coefficients),
            "target_side": self.target_side, "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, images swapped, then every place at every coefficient, with its controls.

        The swap is the unit of the effect: a steering is a share of what it does.

        Raises UnknownSiteError, and NoDirectionError for a named place without a direction.
        """
        wanted = dict.fromkeys(resolve_all(self.sites, session.policy).values(), (self.role,))
        items = items_of(session.run, replace(self, items=None))
        fitted = fit_token_directions(
            session, items, wanted, self.direction, self.controls, self.seed, PassedOver(session, self.sites)
        )
        conditions: list[Condition] = [CleanRun(), ImagesSwapped()]
        for (place, _), axes in fitted.items():
            conditions.append(Steered(place, self.role, self.direction, 0.0, self.target_side, axes))
            conditions += [
                Steered(place, self.role, name, coefficient, self.target_side, axes)
                for coefficient in self.coefficients
                for name in (self.direction, *axes.control_names)
            ]
        return conditions


@dataclass(frozen=True)
class Steered:
    """The tokens of one role at one place, moved along a direction."""

    place: SiteGroup
    role: str
    direction: str
    coefficient: float
    target_side: TargetSide
    axes: DirectionBasis

    @property
    def name(self) -> str:
        """See `ConditionName`."""
        return str(ConditionName(self.place.name, self.role, self.direction, f"{self.coefficient:g}"))

    def play(self, context: ConditionContext) -> ConditionResult:
        """The clean inference with these tokens moved."""
        replay_input, session = context.replay_input, context.session
        left = replay_input.side_correct == "left"
        side = {"left": 1.0, "right": -1.0, "correct": 1.0 if left else -1.0, "wrong": -1.0 if left else 1.0}
        strength = self.coefficient * side[self.target_side]
        shift = self.axes.shift(self.direction, replay_input.episode_id, replay_input.category, strength)
        tokens = role_tokens(session.policy, replay_input, self.place.stream, self.role, context.memo)
        with apply_patch(session.policy, self.place.sites, tokens, AddVector(shift)) as edit_log:
            chunk = session.act(replay_input.seen, replay_input.seed)
        return ConditionResult(chunk, edit_log)
