"""Closed loop: the episode is played again, with the edit at every inference.

What the first inference would do is a forecast. Here the cube lands somewhere, and is compared with the run's own
outcomes: the same scene, the same seeds, and an identity patch that must give every one of them again.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.env.scoring.rules import DEFAULT_RULE
from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edit_engine import EditLog, apply_patch
from probe_kit.hooks.capturing.token_edits import Identity, TokenSelection
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.pooled_directions import MEAN_DIFFERENCE
from probe_kit.intervene.edits.sites import ALL, SiteGroup, resolve_sites, token_mask
from probe_kit.intervene.kinds.base import SEPARATOR, ConditionName
from probe_kit.intervene.kinds.interchange.intervention import (
    NONE,
    PatchedFromSource,
    capabilities_for,
    patches_within,
)
from probe_kit.intervene.replay.conditions import (
    Condition,
    ConditionContext,
    ConditionResult,
    ImagesSwapped,
    Intervention,
    ReplayBatch,
)
from probe_kit.intervene.replay.image_tokens import TILES
from probe_kit.intervene.replay.passed_over import PassedOver
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.replay.token_directions import DirectionBasis, check_direction, fit_token_directions
from probe_kit.intervene.store.answers import CLEAN
from probe_kit.intervene.store.settings import FIRST_CHUNK, items_of
from probe_kit.runs.run import Run

NAME = "closed-loop"


@dataclass(frozen=True, kw_only=True)
class ClosedLoop(Intervention):
    """Interchange at a few targets in closed loop: identity patch, image swap, every target and its controls.

    targets: `PLACE|ROLE`, such as `backbone.02|image`; see `best_patch_targets`. direction: as of `Interchange`;
    a target is also patched within it, and within `controls` random ones of the data's own covariance, where a
    place is one site and the role no tile; `none` for neither. Every target is also patched in full.
    """

    targets: tuple[str, ...]
    direction: str = f"{MEAN_DIFFERENCE}:1"
    controls: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout != FIRST_CHUNK:
            raise UsageError("a closed loop is read where the cube ends; leave --readout out")
        if not self.targets or any(target.count(SEPARATOR) != 1 for target in self.targets):
            raise UsageError(f"targets are {self.targets}; expected PLACE|ROLE, such as backbone.02|image")
        if self.direction != NONE:
            check_direction(self.direction)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or --controls 0")

    @property
    def kind(self) -> str:
        """`closed-loop`."""
        return NAME

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Edits; and `kv`, where one of its places is."""
        sites, roles = zip(*map(self._split, self.targets), strict=True)
        return capabilities_for(sites, roles)

    @property
    def fits_first(self) -> bool:
        """Where its direction is of tokens."""
        return ":" in self.direction

    def parameters(self) -> dict[str, Any]:
        """Where and along what; it is read where the cube ends."""
        return {
            "readout": "episode", "targets": list(self.targets), "direction": self.direction,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def categories_in(self, run: Run) -> tuple[str, ...]:
        """Its categories. Raises UsageError for outcomes by another rule than they were recorded by."""
        if run.rule != DEFAULT_RULE:
            raise UsageError(
                f"{run.location} is read by the rule {run.rule!r}; a closed loop repeats outcomes as they were "
                f"recorded: open the run without another rule ({DEFAULT_RULE})"
            )
        return super().categories_in(run)

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """The identity patch, the image swap and every target. Raises UnknownSiteError, NoProbesError."""
        split = [self._split(target) for target in self.targets]
        tried = [(place, role) for pattern, role in split for place in resolve_sites(pattern, session.policy)]
        source_sites = tuple(dict.fromkeys(site for place, _ in tried for site in place.sites))
        bases = self._bases(session, tried)
        found: list[Condition] = [IdentityPatch(source_sites), ImagesSwapped()]
        for place, role in tried:
            found.append(PatchedFromSource(place, role, source_sites))
            if (place, role) in bases:
                found += patches_within(self.direction, bases[place, role], place, role, source_sites)
        return found

    def play(self, session: ReplaySession, item: str, conditions: Sequence[Condition]) -> ReplayBatch:
        """The item's episodes, each under every condition, from its first step to its last."""
        from probe_kit.intervene.replay.rollout import play

        return play(session, session.replay_inputs(item), conditions)

    def _bases(
        self, session: ReplaySession, tried: Sequence[tuple[SiteGroup, str]]
    ) -> Mapping[tuple[SiteGroup, str], DirectionBasis]:
        """Of the targets that have directions."""
        wanted: dict[SiteGroup, list[str]] = {}
        for place, role in tried:
            if self.direction != NONE and len(place.sites) == 1 and role not in TILES:
                wanted.setdefault(place, []).append(role)
        items = items_of(session.run, replace(self, items=None))
        passed_over = PassedOver(session, [pattern for pattern, _ in map(self._split, self.targets)])
        return fit_token_directions(session, items, wanted, self.direction, self.controls, self.seed, passed_over)

    @staticmethod
    def _split(target: str) -> tuple[str, str]:
        name = ConditionName.parse(target)
        return name.place, name.role


@dataclass(frozen=True)
class IdentityPatch:
    """As the run made it, with every site that any condition changes written back as it was."""

    sites: tuple[Site, ...]
    name: str = CLEAN

    def play(self, context: ConditionContext) -> ConditionResult:
        """Hooks fire, and nothing moves."""
        session, seen = context.session, context.replay_input.seen
        with ExitStack() as stack:
            edit_logs = [
                stack.enter_context(
                    apply_patch(
                        session.policy,
                        [site for site in self.sites if site.stream == stream],
                        TokenSelection.of(
                            token_mask(session.policy, seen, stream, ALL), session.policy.card.device
                        ),
                        Identity(),
                    )
                )
                for stream in dict.fromkeys(site.stream for site in self.sites)
            ]
            chunk = session.act(seen, context.replay_input.seed)
        return ConditionResult(chunk, EditLog.sum(edit_logs))
