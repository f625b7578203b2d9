"""Steering: a direction is added to the tokens of one role, with controls of the same norm.

An answer may lie in *which* tokens are marked. One vector for all tokens cannot move such an answer, because it
marks all of them alike. A direction `mean-difference:K` has a vector for each position, which moves the mark from
one tile to the other.

Steering adds to the evidence of an interchange and does not replace it. The sum may lie where the network was
never trained, a coefficient has no natural size, and with a large one every direction disrupts the task. So
coefficients count half the difference of the class means: 2 goes from one mean to the other. Controls are
orthogonal directions of the data's own covariance with the same norm. Flips to either side are reported.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edits import AddVector, apply_patch
from probe_kit.intervene.edited_cells import EditedCell
from probe_kit.intervene.kinds.image_swap import SMALLEST_REACH
from probe_kit.intervene.kinds.interchange import PatchEffect, PatchKind
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import TILES, resolve_all
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from probe_kit.intervene.directions import Directions
    from probe_kit.intervene.sessions import ReplaySession

TargetSide = Literal["wrong", "correct", "left", "right"]
LARGE_CHANGE = 2.0
"""Change in token norms beyond which a steering is called large."""


def steer_cell(
    cell: Cell, name: str, coefficient: float, target_side: TargetSide, bases: "Directions"
) -> Condition:
    """Return the clean inference with the tokens of one cell moved along a direction of `bases`."""

    def play(context: ConditionContext) -> ConditionResult:
        pair, session, site_group = context.pair, context.session, cell.site_group
        is_left = pair.side != "right"  # without sides it is not read
        side = {"left": 1.0, "right": -1.0, "correct": 1.0 if is_left else -1.0, "wrong": -1.0 if is_left else 1.0}
        strength = coefficient * (1.0 if pair.side is None else side[target_side])
        shift = bases.shift(name, pair.episode, strength)
        tokens = context.tokens.selection(site_group.stream, cell.role)
        with apply_patch(session.policy, site_group.sites, tokens, AddVector(shift)) as edit_log:
            return ConditionResult(context.act(), edit_log)

    return Condition.of_cell(EditedCell(cell.site_group.name, cell.role, name, f"{coefficient:g}"), play)


@dataclass(frozen=True, kw_only=True)
class Steering(PatchKind):
    """Conditions at every place and coefficient, toward one side, with controls; 0 is always played as well.

    Attributes:
        sites: Patterns of places.
        role: Role of the moved tokens.
        direction: Name of the direction. `mean-difference` or `probe` is one vector found in the mean of these
            tokens and added to each. `mean-difference:K` is at each position the difference of the class means
            there, within the K directions that positions share.
        coefficients: Sizes of the step, in half class-mean differences along the direction, or in lengths of the
            vector of a file.
        target_side: Side to steer to; `wrong` and `correct` are those of the clean images.
        controls: Number of orthogonal directions.

    Raises:
        UsageError: For a role, coefficient or side that does not fit.
    """

    kind: ClassVar[str] = "steer"
    summary: ClassVar[str] = "Add a direction to tokens, with controls of the same norm."
    position: ClassVar[int] = 6
    takes_none: ClassVar[bool] = False
    options: ClassVar[Mapping[str, str]] = {
        "sites": "where tokens are moved; required",
        "roles": "the one whose tokens are moved; required",
        "direction": "mean-difference (default), probe, mean-difference:K or FILE#NAME, whose vector is the unit",
        "controls": "random directions; default 5",
        "coefficients": "in half class-mean differences, or in lengths of a file's vector; default 1,2,4",
        "target_side": "wrong (default), correct, left or right",
        "seed": "of controls and folds; default 0",
    }

    sites: tuple[str, ...]
    role: str
    direction: str = "mean-difference"
    coefficients: tuple[float, ...] = (1.0, 2.0, 4.0)
    target_side: TargetSide = "wrong"
    controls: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.role in TILES:
            raise UsageError(
                f"{self.role} has no mean in the run from which a direction could be found; steer `image`, or "
                "patch the tile (--kind interchange)"
            )
        if self.target_side not in get_args(TargetSide):
            raise UsageError(
                f"target_side is {self.target_side!r}; expected one of {', '.join(get_args(TargetSide))}"
            )
        if not self.coefficients or not all(0 < coefficient <= 1000 for coefficient in self.coefficients):
            raise UsageError(f"coefficients are {self.coefficients}; expected positive numbers, such as 1, 2, 4")
        if len(set(self.coefficients)) != len(self.coefficients):
            raise UsageError(f"coefficients are {self.coefficients}; give each once")

    @property
    def patterns(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """The patterns of places with the role."""
        return tuple((site, (self.role,)) for site in self.sites)

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind as the command builds it.

        Raises:
            UsageError: Without sites, or with other than one role.
        """
        roles = options.pop("roles", ())
        if "sites" not in options or len(roles) != 1:
            raise UsageError(
                "--kind steer needs --sites and one of --roles, such as --sites backbone.02 --roles image"
            )
        return super().from_options(run, role=roles[0], **options)

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, images swapped, then every place at every coefficient, with its controls.

        The swap is the unit of the effect: a steering is a share of it.

        Raises:
            UnknownSiteError: For a place that does not exist, or has several sites.
            NoDirectionError: For a named place without a direction.
        """
        cells = [Cell(site_group, self.role) for site_group in resolve_all(self.sites, session.policy).values()]
        conditions = [CLEAN_RUN, SOURCE_RUN]
        for cell, bases in self.fit_directions(session, cells, self.sites).items():
            # Adding nothing must change nothing: `runner._ledgers` checks the hook itself by it.
            doses = [(self.direction, 0.0)]
            for coefficient in self.coefficients:
                doses += [(name, coefficient) for name in (self.direction, *bases.control_names)]
            conditions += [steer_cell(cell, *dose, self.target_side, bases) for dose in doses]
        return conditions

    @staticmethod
    def notes(rows: Sequence[PatchEffect]) -> list[str]:
        """Return notes on too large a change, and on a vector that cannot move the answer."""
        large = [
            f"{name} moves tokens by {ratio:.1f} times their own norm; what that does is little evidence."
            for name, ratio in {row.name: row.relative_change for row in rows if row.coefficient}.items()
            if ratio > LARGE_CHANGE
        ]
        # Categories in which a direction of the tokens' mean moves no action by a smallest reach.
        pooled = [row for row in rows if row.is_dose and not row.is_control and ":" not in row.direction]
        moved = {row.category for row in pooled if abs(row.mean_displacement) >= SMALLEST_REACH}
        return large + [
            f"{category}: one vector that is added to every token moves no action. An answer that lies in which "
            "tokens are marked has no such vector; --direction mean-difference:1 has a vector for each position."
            for category in dict.fromkeys(row.category for row in pooled)
            if category not in moved
        ]


KIND = Steering
