"""Interchange intervention (activation patching): tokens are patched from the same inference with swapped images.

What is patched in is what this policy computes there in this state, so it is on the policy's own distribution, has
no strength to choose, and can do no more than the image swap: with all that differs patched, the effect is 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edit_engine import apply_patch
from probe_kit.hooks.capturing.token_edits import ReplaceInSubspace, ReplaceWith, TokenEdit
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import KV_STREAM, Site
from probe_kit.intervene.edits.sites import ALL, SiteGroup, resolve_all, roles_of
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

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache

SITES = ("backbone.*",)
ROLES = (ALL, "image", "language")
NONE = "none"


def capabilities_for(sites: Sequence[str], roles: Sequence[str]) -> tuple[InterventionKind, ...]:
    """What a family must support for changes at such places and roles."""
    reads_kv = any(pattern.partition(".")[0] == KV_STREAM for pattern in sites)
    further: dict[InterventionKind, bool] = {"kv": reads_kv, "tiles": bool(set(roles) & set(TILES))}
    return ("edit", *(kind for kind, is_needed in further.items() if is_needed))


@dataclass(frozen=True, kw_only=True)
class Interchange(Intervention):
    """Every place is tried at every role, alone.

    sites: patterns, see `resolve_sites`. roles: of the tokens that are patched; a stream is tried at those
    that it has. direction: `none` patches tokens in full; `mean-difference` or `probe` only along that direction
    of each place (rank 1), found in means over tokens without the episode it is used on; `mean-difference:K` along
    K directions found in the tokens themselves, see `token_directions`. controls: so many times as many random
    directions of the data's own covariance, orthogonal to it, per place and role.
    """

    sites: tuple[str, ...] = SITES
    roles: tuple[str, ...] = ROLES
    direction: str = NONE
    controls: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sites or not self.roles:
            raise UsageError("an interchange needs at least one site and one role")
        if set(self.roles) & set(TILES) and self.direction != NONE:
            raise UsageError(
                "tiles have no mean in the run from which a direction could be found; patch them in full: leave "
                "--direction out"
            )
        if self.direction != NONE:
            check_direction(self.direction)
        elif self.controls:
            raise UsageError("controls are directions beside another one; choose --direction, or no --controls")

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Five controls where a direction is given, if their number is not."""
        options.setdefault("controls", 5 if "direction" in options else 0)
        return super().from_options(run, **options)

    @property
    def kind(self) -> str:
        """`interchange`."""
        return "interchange"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Edits; and `kv`, where one of its places is."""
        return capabilities_for(self.sites, self.roles)

    @property
    def fits_first(self) -> bool:
        """Where its direction is of tokens."""
        return ":" in self.direction

    def parameters(self) -> dict[str, Any]:
        """Where, which tokens and along what."""
        return {
            "sites": list(self.sites), "roles": list(self.roles), "direction": self.direction,
            "controls": self.controls, "seed": self.seed,
        }  # fmt: skip

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, images swapped, and every place at every role. Raises UnknownSiteError, NoProbesError."""
        found = resolve_all(self.sites, session.policy)
        source_sites = tuple(dict.fromkeys(site for place in found.values() for site in place.sites))
        wanted = {place: roles_of(session.policy, place.stream, self.roles) for place in found.values()}
        conditions: list[Condition] = [CleanRun(), ImagesSwapped()]
        if self.direction == NONE:
            return conditions + [
                PatchedFromSource(place, role, source_sites) for place in wanted for role in wanted[place]
            ]
        items = items_of(session.run, replace(self, items=None))
        found_along = fit_token_directions(
            session, items, wanted, self.direction, self.controls, self.seed, PassedOver(session, self.sites)
        )
        for (place, role), bases in found_along.items():
            conditions += patches_within(self.direction, bases, place, role, source_sites)
        return conditions


@dataclass(frozen=True)
class PatchedFromSource:
    """The tokens of one role at one place, from the inference with swapped images.

    sources: all sites of which that inference is asked, once for all conditions. direction: the name of one of
    `bases`, empty to patch tokens in full.
    """

    place: SiteGroup
    role: str
    source_sites: tuple[Site, ...]
    direction: str = ""
    bases: DirectionBasis | None = None

    @property
    def name(self) -> str:
        """See `ConditionName`."""
        return str(ConditionName(self.place.name, self.role, self.direction))

    def play(self, context: ConditionContext) -> ConditionResult:
        """The clean inference with these tokens in it."""
        replay_input, session = context.replay_input, context.session
        tokens = role_tokens(session.policy, replay_input, self.place.stream, self.role, context.memo)
        with apply_patch(
            session.policy, self.place.sites, tokens, self._change(context, tokens.count)
        ) as edit_log:
            chunk = session.act(replay_input.seen, replay_input.seed)
        return ConditionResult(chunk, edit_log)

    def _change(self, context: ConditionContext, tokens: int) -> TokenEdit:
        source = source_of(context, self.source_sites)
        if self.bases is None:
            return self.place.limit(ReplaceWith(source, tokens))
        basis = self.bases.basis(self.direction, context.replay_input.episode_id, context.replay_input.category)
        return ReplaceInSubspace(source, tokens, basis)


def patches_within(
    direction: str, bases: DirectionBasis, place: SiteGroup, role: str, source_sites: tuple[Site, ...]
) -> list[PatchedFromSource]:
    """What is patched along a direction, and along each of its controls."""
    return [
        PatchedFromSource(place, role, source_sites, name, bases) for name in (direction, *bases.control_names)
    ]


def source_of(context: ConditionContext, sites: Sequence[Site]) -> "ActivationCache":
    """What all these sites hold with swapped images, with the question's state and noise; made once."""
    from probe_kit.hooks import capture

    if "source" not in context.memo:
        with capture(context.session.policy, sites) as tape:
            context.memo["first-chunk"] = context.session.act(
                context.replay_input.swapped, context.replay_input.seed
            )
        context.memo["source"] = tape
    source: ActivationCache = context.memo["source"]
    return source
