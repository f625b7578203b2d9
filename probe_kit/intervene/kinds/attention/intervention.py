"""Attention: the share of the acting stream's attention on images, tiles, instruction and state. Descriptive.

An attended token need not be used, and a used one may get little attention. So this enters no verdict, and nothing
is edited. Every inference runs twice, with and without recording, and both actions must be bit-identical.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError, CaptureError, EmptyRoleError, UsageError
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.hooks.contract.sites import first_of
from probe_kit.intervene.edits.sites import ALL, roles_of
from probe_kit.intervene.kinds.attention.attention_mass import AttentionShares
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ConditionContext,
    ConditionResult,
    Intervention,
    ReplayBatch,
)
from probe_kit.intervene.replay.image_tokens import TILES, role_token_mask
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.store.answers import ATTENTION, ATTENTION_FILE, RECORDED
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.hooks.capturing.attention import AttentionMass

ROLES = ("image", *TILES, "language", "state", "special")
"""Whose tokens are asked about, where a family has them and, of tiles, says which tokens see them."""


@dataclass(frozen=True, kw_only=True)
class AttentionReadout(Intervention):
    """Two inferences per episode, or with the readout `per-step` per call of it: clean, and recorded.

    roles: of the backbone's tokens; empty for `ROLES`, as many of them as the family has. `all` is always
    recorded: what is missing to 1 lies on the acting part's own tokens. Raises UsageError for a role that comes
    twice."""

    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.roles)) != len(self.roles):
            raise UsageError(f"roles are {', '.join(self.roles)}; give each once")

    @property
    def kind(self) -> str:
        """`capture_attention`."""
        return ATTENTION

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """A family that tells it; and which tokens see a tile, where that is asked by name."""
        return ("attention", *(("tiles",) if set(self.roles) & set(TILES) else ()))

    def parameters(self) -> dict[str, Any]:
        """Of whose tokens."""
        return {"roles": list(self.roles)}

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, and the same with its attention recorded. Raises UsageError for a role it lacks."""
        return CleanRun(), AttentionRecorded(backbone_of(session.policy), self._roles(session.policy))

    def certificate_entries(self, conditions: Sequence[Condition], found: ReplayBatch) -> dict[str, Any]:
        """What the axes of the stored array are. Raises CaptureChangedActionError if noting changed an action."""
        (recording,) = (one for one in conditions if isinstance(one, AttentionRecorded))
        largest = float(found.max_action_change.max(initial=0.0))
        if largest:
            raise CaptureChangedActionError(
                f"with its attention recorded an action differs by {largest:.3g}; expected the same bit for bit. "
                "The adapter's `record_attention` changes the inference, or the model is not deterministic"
            )
        assert found.mass is not None
        inferences, blocks, iterations, heads, _ = found.mass.shape
        return {
            ATTENTION: {
                "stream": recording.stream, "roles": list(recording.roles), "inferences": inferences,
                "blocks": blocks, "iterations": iterations, "heads": heads, "max_action_change": largest,
            }
        }  # fmt: skip

    def extra_files(self, run: Run, conditions: Sequence[Condition], found: ReplayBatch) -> dict[str, bytes]:
        """The attention of every inference."""
        (recording,) = (one for one in conditions if isinstance(one, AttentionRecorded))
        assert found.mass is not None
        assert found.inferences is not None
        rows = run.episodes.iloc[found.inferences[:, 0]]
        columns = {
            own: rows[name].to_numpy(dtype=str)
            for own, name in (
                ("episodes", "episode_id"), ("groups", "group_id"), ("categories", "category"),
                ("sides", "side_correct"),
            )
        }  # fmt: skip
        attention_records = AttentionShares(
            recording.roles, **columns, calls=found.inferences[:, 1], mass=found.mass
        )
        return {ATTENTION_FILE: attention_records.to_bytes()}

    def _roles(self, policy: "Policy") -> tuple[str, ...]:
        stream = backbone_of(policy)
        has_tiles = policy.interventions.supports("tiles")
        wanted = self.roles or tuple(role for role in ROLES if has_tiles or role not in TILES)
        there = roles_of(policy, stream, wanted)
        if missing := [role for role in self.roles if role not in there]:
            raise UsageError(
                f"no token of {stream} has the role {missing[0]!r}; there are "
                f"{', '.join(policy.role_names[policy.tokens_of(stream)])}"
            )
        return tuple(dict.fromkeys((ALL, *there)))


@dataclass(frozen=True)
class AttentionRecorded:
    """The clean inference with attention weights recorded. stream: whose tokens are attended to."""

    stream: str
    roles: tuple[str, ...]
    name: str = RECORDED

    def play(self, context: ConditionContext) -> ConditionResult:
        """Nothing is changed."""
        from probe_kit.hooks.capturing.attention import capture_attention

        replay_input, session = context.replay_input, context.session
        masks = [self._mask(context, role) for role in self.roles]
        with capture_attention(session.policy) as mass:
            chunk = session.act(replay_input.seen, replay_input.seed)
        return ConditionResult(chunk, mass=shares_by_role(mass, masks))

    def _mask(self, context: ConditionContext, role: str) -> NDArray[np.bool_] | None:
        """None where no token plays it now: a family may have the role, and a tile be hidden by the arm."""
        try:
            return role_token_mask(context.session.policy, context.replay_input, self.stream, role, context.memo)
        except EmptyRoleError:
            return None


def shares_by_role(mass: "AttentionMass", masks: Sequence[NDArray[np.bool_] | None]) -> NDArray[np.float32]:
    """(B, I, H, R) shares by block, iteration, head and role.

    NaN where a block is not read in an iteration, and of a role that no token has. Of one observation. masks: (T,)
    each, None for no token. Raises CaptureError for blocks with different numbers of heads.
    """
    shapes = {found.shape[:2] for found in mass.by_head.values()}
    if len(shapes) != 1 or next(iter(shapes))[0] != 1:
        raise CaptureError(f"attention has rows and heads {sorted(shapes)}; expected one row, as many heads each")
    blocks, iterations = (max(own) + 1 for own in zip(*mass.by_head, strict=True))
    shares = np.full((blocks, iterations, next(iter(shapes))[1], len(masks)), np.nan, np.float32)
    for role, tokens in enumerate(masks):
        if tokens is None:
            continue
        for (block, iteration), share in mass.heads_on(tokens).items():
            shares[block, iteration, :, role] = share[0]
    return shares


def backbone_of(policy: "Policy") -> str:
    """Name of the stream that the acting stream reads."""
    name = first_of("backbone", policy.streams.values())
    assert name is not None, "every policy has a backbone"
    return name
