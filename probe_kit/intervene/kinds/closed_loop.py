"""Closed loop: the episode is played again, with the edit at every inference.

The action of the first inference only forecasts where the cube ends. Here it is seen, and compared with the
outcome in the run. Scene and seeds are the same, and an identity patch must reproduce every outcome.

Two effects are measured apart: to which picture the cube was brought, and whether it was brought to any. An edit
that disrupts the task lowers a success rate just as one that changes the choice. So it enters no verdict.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.numbers import with_sign
from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edits import EditLog, Identity, apply_patch
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edited_cells import SEPARATOR, EditedCell
from probe_kit.intervene.kinds.base import (
    NONE,
    AlongDirection,
    EffectColumn,
    EffectRow,
    common_columns,
    compare_with_controls,
    count_edits,
    edit_of,
    effect_table,
    lines_of,
    mean_of,
    p_of,
    rate,
    share_of_edits,
    signed_interval,
)
from probe_kit.intervene.kinds.interchange import best_patch_targets, patch_of, patches_within
from probe_kit.intervene.outcomes import CLEAN, UNCHANGED, ConditionOutcomes
from probe_kit.intervene.patching.patch import Cell, sites_of_cells
from probe_kit.intervene.places import ALL, TILES, resolve_sites
from probe_kit.intervene.replay import SOURCE_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.settings import FIRST_CHUNK, categories_in
from probe_kit.intervene.stored import Measurement
from probe_kit.runs.run import Run
from probe_kit.statistics.paired_tests import sign_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import SMALLEST_EFFECT_OF_INTEREST

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.sessions import ReplaySession

MIN_IN_ZONE_RATIO = 0.5
"""Share of the clean in-zone share below which the task is called disrupted: most of the placing is gone."""
CORRECT, WRONG = "correct", "wrong"
"""Outcomes of `env.scoring` with the cube in a zone; the third, `oob`, is outside both."""
LoopFinding = Literal["identity patch", "control", "task disrupted", "confirmed", "not confirmed"]


def identity_patch(sites: Sequence[Site]) -> Condition:
    """Return the inference as the run made it, with every site that a condition changes written back as it is."""

    def play(context: ConditionContext) -> ConditionResult:
        policy = context.session.policy
        with ExitStack() as stack:
            edit_logs = []
            for stream in dict.fromkeys(site.stream for site in sites):
                of_stream = [site for site in sites if site.stream == stream]
                tokens = context.tokens.selection(stream, ALL)
                edit_logs.append(stack.enter_context(apply_patch(policy, of_stream, tokens, Identity())))
            chunk = context.act()
        return ConditionResult(chunk, EditLog.sum(edit_logs))

    return Condition(CLEAN, play)


@dataclass(frozen=True, kw_only=True)
class ClosedLoop(AlongDirection):
    """Interchange at a few targets in closed loop: identity patch, image swap, every target and its controls.

    Every target is patched in full. Where its place is one site and its role no tile, it is also patched within
    the direction, and within the random ones.

    Attributes:
        targets: Names `PLACE|ROLE`, such as `backbone.02|image`; see `best_patch_targets`.
        direction: Name of the direction, as for `Interchange`; `none` for no patches within a direction.
        controls: Number of random directions of the data's own covariance.
    """

    kind: ClassVar[str] = "closed-loop"
    summary: ClassVar[str] = "Interchange at every inference; whole episodes are played."
    position: ClassVar[int] = 7
    needs_scene: ClassVar[bool] = True
    options: ClassVar[Mapping[str, str]] = {
        "sites": "default the last place, of each category, that the newest interchange localised",
        "roles": "with --sites; default all",
        "direction": "patch within it as well: as of interchange, or none; default mean-difference:1",
        "controls": "random directions; default 1",
        "seed": "of controls and folds; default 0",
    }

    targets: tuple[str, ...]
    direction: str = "mean-difference:1"
    controls: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != FIRST_CHUNK:
            raise UsageError("a closed loop is read where the cube ends; leave --readout out")
        if not self.targets or any(target.count(SEPARATOR) != 1 for target in self.targets):
            raise UsageError(f"targets are {self.targets}; expected PLACE|ROLE, such as backbone.02|image")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind at the named sites and roles, else at `best_patch_targets`.

        Raises:
            UsageError: For roles without sites.
        """
        sites, roles = options.pop("sites", None), options.pop("roles", None)
        if roles and not sites:
            raise UsageError("--roles of a closed loop go with --sites; leave both out for the best stored place")
        if options.get("direction") == NONE:
            options.setdefault("controls", 0)
        if sites:
            targets = tuple(f"{site}{SEPARATOR}{role}" for site in sites for role in roles or (ALL,))
        else:
            targets = best_patch_targets(run, categories_in(run, options.get("categories")))
        return cls(**options, targets=targets)

    @property
    def patterns(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """The place and role of every target."""
        targets = (target.split(SEPARATOR) for target in self.targets)
        return tuple((site, (role,)) for site, role in targets)

    @property
    def plays_episodes(self) -> bool:
        """Whether whole episodes are played again: always."""
        return True

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return the identity patch, the image swap and every target.

        Raises:
            NoProbesError: For a direction of probes in a run without them.
            UnknownSiteError: For a place that does not exist.
            NoDirectionError: For a named place without a direction.
        """
        cells = [
            Cell(site_group, role)
            for site, (role,) in self.patterns
            for site_group in resolve_sites(site, session.policy)
        ]
        source_sites = sites_of_cells(cells)
        within = [cell for cell in cells if len(cell.site_group.sites) == 1 and cell.role not in TILES]
        bases = (
            {}
            if self.direction == NONE
            else self.fit_directions(session, within, [site for site, _ in self.patterns])
        )
        conditions = [identity_patch(source_sites), SOURCE_RUN]
        for cell in cells:
            conditions.append(patch_of(cell, source_sites))
            if cell in bases:
                conditions += patches_within(self.direction, bases[cell], cell, source_sites)
        return conditions

    @staticmethod
    def effects(measurement: Measurement) -> "list[ClosedLoopEffect]":
        """Return one row per category and condition, the identity patch first."""
        return measurement.rows(closed_loop_effects)

    @staticmethod
    def table(rows: "Sequence[ClosedLoopEffect]", context: Measurement) -> "Table":
        """Return one line per category and condition, the identity patch first."""
        return effect_table(
            f"Is it so in closed loop? {context.subject}",
            ("category", "edit"),
            lines_of(rows, lambda row: "identity patch" if row.sites == CLEAN else row.name),
            {"Where the cube ends": _ENDS, "Compared with the identity patch": _COMPARED},
            lambda row: row.finding == "confirmed",
            before=["every episode played again, same scene and seeds, with the edit at every inference"],
        )

    @staticmethod
    def sentence(rows: "Sequence[ClosedLoopEffect]", context: Measurement) -> str:
        """Return at which places the cube turns to the other picture."""
        del context
        edits = [row for row in rows if row.sites != CLEAN]
        confirmed = [f"{row.name} {row.net:+.2f}" for row in edits if row.finding == "confirmed"]
        disrupted = [row.name for row in edits if row.finding == "task disrupted"]
        turned = (
            "edits that turn the cube to the other picture beyond their controls: "
            f"{count_edits(confirmed, len(edits))}"
        )
        return turned + (f"; that disrupt the task: {count_edits(disrupted, len(edits))}" if disrupted else "")

    @staticmethod
    def finding(rows: "Sequence[ClosedLoopEffect]", context: Measurement) -> str:
        """Return whether an edit turns the cube to the other picture, and where."""
        del context
        edits = [row for row in rows if row.sites != CLEAN]
        confirmed = sorted((row for row in edits if row.finding == "confirmed"), key=lambda row: -row.net)
        if confirmed:
            return f"confirmed: the cube turns to the other picture after {share_of_edits(confirmed, len(edits))}"
        if edits and all(row.disrupted for row in edits):
            return "task disrupted: after every edit the cube stays away from both pictures"
        return (
            f"not confirmed: none of {len(edits)} edits turns the cube to the other picture more than its controls"
        )

    @staticmethod
    def notes(rows: "Sequence[ClosedLoopEffect]") -> list[str]:
        """Return notes on edits that disrupt the task."""
        return [
            f"{edit_of(row)}: the cube is in a zone in {100 * row.in_zone:.0f} % of episodes; the "
            "task is disrupted, and this enters no verdict."
            for row in rows
            if row.disrupted
        ]


KIND = ClosedLoop


@dataclass(frozen=True, kw_only=True)
class ClosedLoopEffect(EffectRow):
    """The effect of one edit on whole episodes, in one category; see `EffectRow`.

    Here `net` is the share of episodes that end wrong minus that without the edit. `max_action_change` is of any
    number of any trajectory. The test is one-sided, by sign flips of whole groups; its numbers are None for rows
    that enter no verdict.

    Attributes:
        correct: Share of episodes that end on the correct picture.
        wrong: Share of episodes that end on the wrong picture.
        in_zone: Share of episodes that end on either picture.
        wrong_in_zone: Share of wrong ones among those in a zone; None if none is.
        net_left: The same as `net`, of episodes with the wrong picture on the left; None if there are none.
        net_right: The same as `net`, of episodes with the wrong picture on the right; None if there are none.
        control_net: Mean `net` of its controls that do not disrupt the task; None without any.
        gained: Number of episodes that end wrong only with the edit.
        lost: Number of episodes that end wrong only without it.
        p_mcnemar: Exact two-sided p-value with the episodes of an item taken as independent, so that it is no
            verdict.
        t: Statistic of `net` beyond the controls'.
        p: The p-value of the same.
        p_fwe: Family-wise p-value, against the largest t of the category.
        disrupted: Whether the cube is in a zone less than half as often.
    """

    correct: float
    wrong: float
    in_zone: float
    wrong_in_zone: float | None
    net_left: float | None
    net_right: float | None
    control_net: float | None
    gained: int
    lost: int
    p_mcnemar: float
    t: float | None
    p: float | None
    p_fwe: float | None
    disrupted: bool

    @property
    def finding(self) -> LoopFinding:
        """The finding: `confirmed` if, beyond controls and chance, enough episodes turn to the other picture."""
        if self.sites == CLEAN:
            return "identity patch"
        if self.disrupted:
            return "task disrupted"
        if self.is_control:
            return "control"
        beyond = self.net - (self.control_net or 0.0)
        turned = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE and beyond >= SMALLEST_EFFECT_OF_INTEREST
        return "confirmed" if turned else "not confirmed"

    def to_json(self) -> dict[str, Any]:
        """Return plain values and the finding."""
        return {**super().to_json(), "finding": self.finding}


def closed_loop_effects(outcomes: ConditionOutcomes) -> list[ClosedLoopEffect]:
    """Return one row per condition of one category, the identity patch first."""
    assert outcomes.episode_outcomes is not None
    clean = {at for at, name in enumerate(outcomes.conditions) if name == CLEAN}
    # What edits no cell is listed under its name: the identity patch, and the image swap.
    pairs = zip(outcomes.conditions, outcomes.cells, strict=True)
    cells = [EditedCell(name) if name in UNCHANGED else cell for name, cell in pairs]
    wrong = (outcomes.episode_outcomes == WRONG).astype(float)
    in_zone = np.isin(outcomes.episode_outcomes, (CORRECT, WRONG)).mean(axis=1)
    disrupted = in_zone < MIN_IN_ZONE_RATIO * in_zone[0]
    net = wrong - wrong[0]
    left_out = set(np.flatnonzero(disrupted).tolist())
    tests = compare_with_controls(net, cells, outcomes, skipped=left_out | clean, broken_controls=left_out)
    rows = []
    for at, (cell, test) in enumerate(zip(cells, tests, strict=True)):
        gained, lost = int((net[at] > 0).sum()), int((net[at] < 0).sum())
        rows.append(
            ClosedLoopEffect(
                **common_columns(outcomes, at, cell, net[at]),
                correct=float((outcomes.episode_outcomes[at] == CORRECT).mean()),
                wrong=float(wrong[at].mean()),
                in_zone=float(in_zone[at]),
                wrong_in_zone=float(wrong[at].mean() / in_zone[at]) if in_zone[at] else None,
                net_left=mean_of(net[at][outcomes.sides == "right"]),
                net_right=mean_of(net[at][outcomes.sides == "left"]),
                control_net=mean_of(net[test.controls]),
                gained=gained,
                lost=lost,
                p_mcnemar=sign_p(gained, lost),
                t=test.t,
                p=test.p,
                p_fwe=test.p_fwe,
                disrupted=bool(disrupted[at]),
            )
        )
    return rows


def _cell_of_edits(cell: Callable[[ClosedLoopEffect], TableCell]) -> Callable[[ClosedLoopEffect], TableCell]:
    """Return the function that gives a cell, with a dash for the identity patch."""
    return lambda row: TableCell(None) if row.sites == CLEAN else cell(row)


_ENDS = (
    EffectColumn[ClosedLoopEffect]("correct %", lambda row: rate(row.correct)),
    EffectColumn[ClosedLoopEffect]("wrong %", lambda row: rate(row.wrong)),
    EffectColumn[ClosedLoopEffect]("in a zone %", lambda row: rate(row.in_zone), "in a zone: on either picture"),
    EffectColumn[ClosedLoopEffect]("wrong of these %", lambda row: rate(row.wrong_in_zone)),
)
_COMPARED = (
    EffectColumn[ClosedLoopEffect](
        "net flip rate [95 %]",
        _cell_of_edits(lambda row: signed_interval(row.net, row.net_ci)),
        "net flip rate: share of episodes that end on the wrong picture, minus that with the identity patch",
    ),
    EffectColumn[ClosedLoopEffect](
        "left / right",
        _cell_of_edits(lambda row: TableCell(row.net_left, with_sign, after=f" / {with_sign(row.net_right)}")),
    ),
    EffectColumn[ClosedLoopEffect]("controls", _cell_of_edits(lambda row: TableCell(row.control_net, with_sign))),
    EffectColumn[ClosedLoopEffect](
        "only with : only without", _cell_of_edits(lambda row: TableCell(row.gained, after=f" : {row.lost}"))
    ),
    EffectColumn[ClosedLoopEffect](
        "p",
        _cell_of_edits(lambda row: p_of(row.p_fwe)),
        "p: family-wise and one-sided, of the net flip rate beyond that of the controls",
    ),
    EffectColumn[ClosedLoopEffect](
        "finding",
        lambda row: row.finding,
        f"confirmed: p < 0.05 and {SMALLEST_EFFECT_OF_INTEREST} beyond the controls; task disrupted: the cube "
        f"ends in a zone less than {MIN_IN_ZONE_RATIO:g} times as often as with the identity patch; such edits "
        "enter no verdict",
    ),
)
