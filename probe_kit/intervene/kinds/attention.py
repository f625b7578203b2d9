"""Attention: how much of the acting stream's attention falls on images, tiles, instruction and state.

This kind only describes. A token that gets attention need not be used, and a token that is used may get little
attention, so the result enters no verdict. Nothing is edited. Every inference runs twice, with and without
recording, and both actions must be equal bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.numbers import percent, points
from probe_kit.errors import CaptureChangedActionError, CaptureError, EmptyRoleError, UsageError
from probe_kit.hooks.contract.declared import InterventionKind
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import first_of
from probe_kit.intervene.kinds.base import EffectColumn, Intervention, effect_table
from probe_kit.intervene.outcomes import (
    RECORDED,
    ConditionOutcomes,
    Effect,
    arrays_from_bytes,
    arrays_to_bytes,
)
from probe_kit.intervene.places import ALL, TILE_ROLES, TILES, roles_of
from probe_kit.intervene.replay import CLEAN_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.stored import Measurement, StoredResult, stored_results
from probe_kit.intervene.tokens import shown_cameras, token_boxes
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.bootstrap import GAINS, student_interval, units_seed

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit._tables.table import Table
    from probe_kit.hooks import Policy
    from probe_kit.hooks.capturing.attention import AttentionMass
    from probe_kit.intervene.sessions import ReplaySession

ATTENTION, ATTENTION_FILE, PATCHES_FILE = "attention", "attention.npz", "attention_patches.npz"
"""The kind, and its files: shares by role, and shares of single patches with their places in the picture."""
ROLES = ("image", *TILES, "language", "state", "special")
"""Roles that are recorded, where a family has them and, for tiles, says which tokens see them."""


@dataclass(frozen=True, kw_only=True)
class AttentionReadout(Intervention):
    """Two inferences per episode, or per call with the readout `per-step`: clean, and with attention recorded.

    The role `all` is always recorded. Its difference to 1 is the attention on the acting part's own tokens.

    Attributes:
        roles: Roles of the backbone's tokens; empty for `ROLES`, as many of them as the family has.

    Raises:
        UsageError: For a role that comes twice.
    """

    kind: ClassVar[str] = ATTENTION
    summary: ClassVar[str] = "Shares of the acting stream's attention (descriptive)."
    position: ClassVar[int] = 9
    options: ClassVar[Mapping[str, str]] = {"roles": "of the backbone's tokens; default all that the family has"}
    needs: ClassVar[tuple[InterventionKind, ...]] = ("attention",)
    is_descriptive: ClassVar[bool] = True

    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.roles)) != len(self.roles):
            raise UsageError(f"roles are {', '.join(self.roles)}; give each once")

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return the clean inference, and the same with its attention recorded.

        Raises:
            UsageError: For a role that the policy lacks.
        """
        policy, stream = session.policy, backbone_of(session.policy)
        boxes: dict[str, NDArray[np.float32]] = {}
        if policy.interventions.supports("tiles"):
            observations = (pair.clean for item in self.items_in(session.run) for pair in session.pairs(item))
            first = next(observations, None)
            if isinstance(first, Observation):
                boxes = {camera: token_boxes(policy, first, camera) for camera in shown_cameras(policy, stream)}
        roles = self._roles(policy)
        session.certificate[ATTENTION] = {"stream": stream, "roles": list(roles)}
        return CLEAN_RUN, attention_recorded(stream, roles, boxes)

    def extra_files(
        self, session: "ReplaySession", conditions: Sequence[Condition], outcomes: ConditionOutcomes
    ) -> dict[str, bytes]:
        """Return the attention of every inference as files; the certificate gets the axes of the array.

        Raises:
            CaptureChangedActionError: If recording changed an action.
        """
        largest = float(outcomes.max_action_change.max(initial=0.0))
        if largest:
            raise CaptureChangedActionError(
                f"with its attention recorded an action differs by {largest:.3g}; expected the same bit for bit. "
                "The adapter's `record_attention` changes the inference, or the model is not deterministic"
            )
        run, entries = session.run, session.certificate[ATTENTION]
        assert outcomes.mass is not None
        assert outcomes.inferences is not None
        axes = zip(("inferences", "blocks", "iterations", "heads"), outcomes.mass.shape, strict=False)
        entries |= {**dict(axes), "max_action_change": largest}
        rows, calls = run.episodes.iloc[outcomes.inferences[:, 0]], outcomes.inferences[:, 1]
        episodes, groups, categories = (
            rows[name].to_numpy(dtype=str) for name in ("episode_id", "group_id", "category")
        )
        sides = rows["side_correct"].to_numpy(dtype=str) if run.source.is_scene else np.full(len(rows), "")
        shares = AttentionShares(
            tuple(entries["roles"]), episodes, groups, categories, sides, calls, outcomes.mass
        )
        files = {ATTENTION_FILE: arrays_to_bytes(shares)}
        if outcomes.patches is not None:
            by_camera: Mapping[str, NDArray[np.float32]] = conditions[-1].details
            names = np.repeat(list(by_camera), [len(places) for places in by_camera.values()])
            boxes = np.concatenate(list(by_camera.values()))
            patches = PatchAttention(episodes, calls, outcomes.patches.astype(np.float16), names, boxes)
            files[PATCHES_FILE] = arrays_to_bytes(patches)
        return files

    @staticmethod
    def effects(measurement: Measurement) -> "list[AttentionRow]":
        """Return shares by block, iteration, head and role.

        Raises:
            RunDamagedError: If a stored file was changed.
        """
        return AttentionShares.stored(measurement).rows()

    @staticmethod
    def table(rows: "Sequence[AttentionRow]", context: Measurement) -> "Table":
        """Return one line per category and block of the backbone that is read."""
        del rows
        attention = AttentionShares.stored(context)
        means = attention.rows(("block",))
        roles = [role for role in dict.fromkeys(row.role for row in means) if role not in (CORRECT, OTHER)]
        lines: list[tuple[tuple[str, ...], tuple[dict[str, float], TableCell]]] = []
        for category, part in attention.by_category():
            apart = part.correct_minus_other(context.run.seed_text)
            for block in dict.fromkeys(row.block for row in means if row.category == category):
                shares = {row.role: row.share for row in means if (row.category, row.block) == (category, block)}
                lines.append(((category, f"block {block:02d}"), (shares, _difference(apart.get(block or 0)))))
        parts: dict[str, list[EffectColumn[Any]]] = {
            "Where the attention lies, %": [_share_column(role) for role in roles]
        }
        if set(TILE_ROLES) <= set(roles):
            parts["Tiles by answer"] = [EffectColumn("correct − other [95 %]", lambda row: row[1], _BY_ANSWER)]
        title = f"What does it attend to? {context.subject}, attention"
        return effect_table(
            title,
            ("category", "read"),
            lines,
            parts,
            before=[_LEGEND],
            after=["by iteration and head: --format csv"],
        )

    @staticmethod
    def notes(rows: "Sequence[AttentionRow]") -> list[str]:
        """Return a note that attention is descriptive, and what tests more."""
        del rows
        return [
            "Attention is descriptive, not causal, and does not enter the verdict. To test what is read, run "
            "--kind interchange --sites kv.*"
        ]

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the stored interventions that tables and figures read.

        Raises:
            RunDamagedError: If a stored intervention was changed.
        """
        return {result.stored.key for result, _ in preferred_attention(run).values()}

    def _roles(self, policy: "Policy") -> tuple[str, ...]:
        stream = backbone_of(policy)
        has_tiles = policy.interventions.supports("tiles")
        roles = self.roles or tuple(role for role in ROLES if has_tiles or role not in TILES)
        present = roles_of(policy, stream, roles)
        if missing := [role for role in self.roles if role not in present]:
            raise UsageError(
                f"no token of {stream} has the role {missing[0]!r}; there are "
                f"{', '.join(policy.role_names[policy.tokens_of(stream)])}"
            )
        return tuple(dict.fromkeys((ALL, *present)))


def attention_recorded(
    stream: str, roles: Sequence[str], boxes: Mapping[str, NDArray[np.float32]] = MappingProxyType({})
) -> Condition:
    """Return the clean inference with attention weights recorded; nothing is changed.

    Args:
        stream: Name of the stream whose tokens are attended to.
        roles: Roles of the recorded shares, in their order.
        boxes: By camera, the boxes (patches, 4) of its patches; empty where the family does not say.
    """

    def play(context: ConditionContext) -> ConditionResult:
        from probe_kit.hooks.capturing.attention import capture_attention

        masks: list[NDArray[np.bool_] | None] = []
        for role in roles:
            try:
                masks.append(context.tokens.mask(stream, role))
            except EmptyRoleError:  # a family may have the role, and a tile be hidden by the arm
                masks.append(None)
        with capture_attention(context.session.policy) as mass:
            chunk = context.act()
        on_cameras = [context.tokens.mask(stream, f"image.{camera}") for camera in boxes]
        patches = _on_patches(mass, on_cameras) if boxes else None
        return ConditionResult(chunk, mass=shares_by_role(mass, masks), patches=patches)

    return Condition(RECORDED, play, details=boxes)


def _on_patches(mass: "AttentionMass", masks: Sequence[NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Return the shares (B, P) on the patches of all cameras in turn, means over iterations and heads."""
    tokens = np.concatenate([np.flatnonzero(mask) for mask in masks])
    shares: list[list[NDArray[np.floating]]] = [[] for _ in range(max(block for block, _ in mass.by_head) + 1)]
    for (block, _), weights in mass.by_head.items():
        shares[block].append(weights[0][:, tokens].mean(axis=0))
    empty = np.full((1, tokens.size), np.nan)
    return np.array([np.mean(block or empty, axis=0) for block in shares], np.float32)


@dataclass(frozen=True)
class PatchAttention:
    """The attention of N inferences on the P patches of the cameras' pictures.

    Attributes:
        episodes: (N,) episode of every inference.
        calls: (N,) inference of the episode, counted from 0.
        weights: (N, B, P) float16, shares of the acting stream's attention, means over iterations and heads.
        cameras: (P,) names, with those of one camera together.
        boxes: (P, 4) places of the patches, see `token_boxes`.
    """

    AXES: ClassVar[Mapping[str, str]] = {
        "episodes": "U N",
        "calls": "iu N",
        "weights": "f NBP",
        "cameras": "U P",
        "boxes": "f P4",
    }

    episodes: NDArray[np.str_]
    calls: NDArray[np.int64]
    weights: NDArray[np.float16]
    cameras: NDArray[np.str_]
    boxes: NDArray[np.float32]

    def only(self, selected: NDArray[np.bool_]) -> Self:
        """Return some of the inferences, those where `selected` (N,) is true."""
        return replace(
            self, episodes=self.episodes[selected], calls=self.calls[selected], weights=self.weights[selected]
        )

    def on_frame(self, pictures: int) -> Self:
        """Return the attention on a frame with the first cameras' pictures side by side.

        Boxes are then shares of the frame.
        """
        first = list(dict.fromkeys(self.cameras.tolist()))[:pictures]
        visible = np.isin(self.cameras, first)
        offset = np.array([[first.index(name), 0.0] * 2 for name in self.cameras[visible]], np.float32)
        boxes = (self.boxes[visible] + offset) / np.array([len(first), 1.0] * 2, np.float32)
        return replace(
            self, weights=self.weights[..., visible], cameras=self.cameras[visible], boxes=boxes.astype(np.float32)
        )


def stored_patch_attention(run: RunReader) -> dict[str, PatchAttention]:
    """Return by category the patches of the attention that tables read; without those stored without patches.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    stored = {category: result.stored for category, (result, _) in preferred_attention(run).items()}
    read = {
        measured.key: PatchAttention(**measured.arrays(PATCHES_FILE, PatchAttention, PatchAttention.AXES))
        for measured in stored.values()
        if PATCHES_FILE in measured.files
    }
    return {category: read[measured.key] for category, measured in stored.items() if measured.key in read}


def shares_by_role(mass: "AttentionMass", masks: Sequence[NDArray[np.bool_] | None]) -> NDArray[np.float32]:
    """Return the shares (B, I, H, R) of one observation by block, iteration, head and role.

    NaN where a block is not read in an iteration, and for a role that no token has.

    Args:
        mass: Recorded attention of one inference.
        masks: (T,) tokens of each role; None for a role without tokens.

    Raises:
        CaptureError: For blocks with different numbers of heads.
    """
    shapes = {weights.shape[:2] for weights in mass.by_head.values()}
    if len(shapes) != 1 or next(iter(shapes))[0] != 1:
        raise CaptureError(f"attention has rows and heads {sorted(shapes)}; expected one row, as many heads each")
    blocks, iterations = (max(indices) + 1 for indices in zip(*mass.by_head, strict=True))
    shares = np.full((blocks, iterations, next(iter(shapes))[1], len(masks)), np.nan, np.float32)
    for role, tokens in enumerate(masks):
        if tokens is None:
            continue
        for (block, iteration), share in mass.heads_on(tokens).items():
            shares[block, iteration, :, role] = share[0]
    return shares


def backbone_of(policy: "Policy") -> str:
    """Return the name of the stream that the acting stream reads."""
    name = first_of("backbone", policy.streams.values())
    assert name is not None, "every policy has a backbone"
    return name


Axis = Literal["block", "iteration", "head", "call"]
_AXES: Mapping[str, int] = {"block": 1, "iteration": 2, "head": 3}
CORRECT, OTHER, ACTION = "image.correct", "image.other", "action"
"""Roles made of the stored ones: the correct picture's tile, the other tile, and the acting stream itself."""


@dataclass(frozen=True)
class AttentionShares:
    """Attention of N inferences.

    Attributes:
        roles: Names of the R roles, the first one `all`.
        episodes: (N,) episode of every inference.
        groups: (N,) group of items of every episode.
        categories: (N,) category of every episode.
        sides: (N,) side of the correct picture; empty in a run without sides.
        calls: (N,) inference of the episode, counted from 0.
        mass: (N, B, I, H, R) float32 shares. They are NaN where a block is not read in an iteration, and for roles
            without a token, such as a tile behind the arm.
    """

    AXES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("episodes", "groups", "categories", "sides"), "U N"),
        "roles": "U R",
        "calls": "iu N",
        "mass": "f NBIHR",
    }

    roles: tuple[str, ...]
    episodes: NDArray[np.str_]
    groups: NDArray[np.str_]
    categories: NDArray[np.str_]
    sides: NDArray[np.str_]
    calls: NDArray[np.int64]
    mass: NDArray[np.float32]

    def __post_init__(self) -> None:
        # Stored names are an array.
        object.__setattr__(self, "roles", tuple(map(str, self.roles)))

    @classmethod
    def stored(cls, measured: Measurement) -> Self:
        """Return those of a stored intervention. Raises RunDamagedError for a file that was changed."""
        return cls(**measured.arrays(ATTENTION_FILE, cls, cls.AXES))

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Load one from the bytes of `arrays_to_bytes`."""
        return cls(**arrays_from_bytes(content))

    def only(self, selected: NDArray[np.bool_]) -> Self:
        """Return some of the inferences, those where `selected` (N,) is true."""
        return replace(self, **{name: value[selected] for name, value in vars(self).items() if name != "roles"})

    def by_category(self) -> list[tuple[str, Self]]:
        """Return every category with its inferences, in the order of the episodes."""
        return [(name, self.only(self.categories == name)) for name in dict.fromkeys(map(str, self.categories))]

    def shares(self) -> dict[str, Matrix]:
        """Return the shares (N, B, I, H) by role.

        These are the stored ones, tiles also by the answer's side, and the difference to 1.
        """
        by_role = {role: self.mass[..., at].astype(np.float64) for at, role in enumerate(self.roles)}
        if set(TILE_ROLES) <= by_role.keys():
            left_tile, right_tile = (by_role[role] for role in TILE_ROLES)
            is_left = (self.sides == "left")[:, None, None, None]
            by_role |= {
                CORRECT: np.where(is_left, left_tile, right_tile),
                OTHER: np.where(is_left, right_tile, left_tile),
            }
        return {**by_role, ACTION: 1 - by_role[ALL]} if ALL in by_role else by_role

    def rows(self, by: Sequence[Axis] = ("block", "iteration", "head")) -> "list[AttentionRow]":
        """Return one row per category, role and place along the axes `by`.

        Shares are means over the other axes, with equal weight for every episode.

        Raises:
            UsageError: For an axis that does not exist.
        """
        if unknown := set(by) - set(get_args(Axis)):
            raise UsageError(f"attention has no axis {min(unknown)!r}; it has {', '.join(get_args(Axis))}")
        rows = []
        for category, inferences in self.by_category():
            calls = np.unique(inferences.calls).tolist() if "call" in by else [None]
            for call in calls:
                part = inferences if call is None else inferences.only(inferences.calls == call)
                rows += part._rows(category, call, by)
        return rows

    def frame(self, by: Sequence[Axis] = ("block", "iteration", "head")) -> "pd.DataFrame":
        """Return `rows` as a data frame, with the columns of the requested axes."""
        import pandas as pd

        unused = [axis for axis in get_args(Axis) if axis not in by]
        columns = [field.name for field in fields(AttentionRow)]
        return pd.DataFrame([asdict(row) for row in self.rows(by)], columns=columns).drop(columns=unused)

    def correct_minus_other(self, seed_text: str) -> "dict[int, tuple[float, tuple[float, float]]]":
        """Return by block the share on the correct tile minus the other's, with its 95 % interval by groups.

        The inferences must be of one category. The share is a mean over iterations, heads and calls. Empty without
        tiles.
        """
        shares = self.shares()
        if CORRECT not in shares:
            return {}
        episodes, groups = self._episodes()
        by_block = {}
        for block in range(self.mass.shape[1]):
            apart = (shares[CORRECT] - shares[OTHER])[:, block : block + 1]
            if np.isnan(apart).all():
                continue
            every = _mean(_per_episode(apart, episodes), (1, 2, 3))
            has_share = ~np.isnan(every)
            values, units = every[has_share], groups[has_share]
            limits = student_interval(values, units, units_seed(units, seed_text), GAINS)
            by_block[block] = float(values.mean()), limits
        return by_block

    def _rows(self, category: str, call: int | None, by: Sequence[Axis]) -> "list[AttentionRow]":
        episodes, _ = self._episodes()
        over = tuple(at for axis, at in _AXES.items() if axis not in by)
        rows = []
        for role, values in self.shares().items():
            every = _per_episode(values, episodes)
            means = _mean(every, (0, *over))
            for index, share in np.ndenumerate(means):
                if not np.isnan(share):
                    at: dict[str, Any] = dict(
                        zip((axis for axis in _AXES if axis in by), map(int, index), strict=True)
                    )
                    labels: dict[str, Any] = {"category": category, "role": role, "call": call}
                    rows.append(AttentionRow(**labels, **at, share=float(share), n_episodes=len(every)))
        return rows

    def _episodes(self) -> tuple[NDArray[np.int64], NDArray[np.str_]]:
        """Return (N,) the number of every inference's episode among the E, and the (E,) groups of these."""
        _, first, which = np.unique(self.episodes, return_index=True, return_inverse=True)
        return which, self.groups[first]


@dataclass(frozen=True, kw_only=True)
class AttentionRow(Effect):
    """The share of the attention on one role's tokens, in one category.

    Attributes:
        block: Block of the backbone; None for the mean over all.
        iteration: Iteration of the acting stream; None for the mean over all.
        head: Head of the block; None for the mean over all.
        call: Inference of the episode; None for the mean over all.
        share: Share of the acting stream's attention.
    """

    role: str
    block: int | None = None
    iteration: int | None = None
    head: int | None = None
    call: int | None = None
    share: float
    n_episodes: int

    def to_json(self) -> dict[str, Any]:
        """Return plain values, without the axes that it is a mean over."""
        axes = get_args(Axis)
        return {name: value for name, value in asdict(self).items() if value is not None or name not in axes}


def stored_attention(run: RunReader) -> dict[str, AttentionShares]:
    """Return by category the shares of most episodes, and of these of most roles; empty if there is none.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    return {category: category_shares for category, (_, category_shares) in preferred_attention(run).items()}


def preferred_attention(run: RunReader) -> dict[str, tuple[StoredResult, AttentionShares]]:
    """Return `stored_attention`, and the stored intervention of each."""
    preferred: dict[str, tuple[StoredResult, AttentionShares]] = {}
    read: dict[str, AttentionShares] = {}
    for result in stored_results(run, ATTENTION):
        key, before = result.stored.key, preferred.get(result.category)
        if key not in read:
            read[key] = AttentionShares.stored(result.stored)
        category_shares = read[key].only(read[key].categories == result.category)
        if before is None or (before[0].rank, len(before[1].roles)) <= (result.rank, len(category_shares.roles)):
            preferred[result.category] = result, category_shares
    return preferred


def _per_episode(values: Matrix, episodes: NDArray[np.int64]) -> Matrix:
    """Return the means (E, …) over the inferences of every episode, of values that are not NaN."""
    sums, counts = (np.zeros((episodes.max() + 1, *values.shape[1:])) for _ in range(2))
    has_share = ~np.isnan(values)
    np.add.at(sums, episodes, np.where(has_share, values, 0.0))
    np.add.at(counts, episodes, has_share)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _mean(values: Matrix, axes: tuple[int, ...]) -> Matrix:
    """Return the mean over some axes of values that are not NaN; NaN where there are none."""
    has_share = ~np.isnan(values)
    counts = has_share.sum(axis=axes)
    sums = np.where(has_share, values, 0.0).sum(axis=axes)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


_LEGEND = (
    "Descriptive, in no verdict: attended tokens need not be used. Percent of the acting stream's attention, "
    "means over heads, iterations and inferences"
)
_ROLE_TERMS = {
    ALL: "all: on the backbone's tokens",
    "action": "action: on its own",
    TILE_ROLES[0]: f"{', '.join(TILE_ROLES)}: on patches that see a tile",
}
"""The entries of the legend by role."""
_BY_ANSWER = (
    "correct − other: share on the correct picture's tile minus that on the other's, interval by groups of items"
)


def _share_column(role: str) -> EffectColumn[Any]:
    return EffectColumn(role, lambda row: TableCell(row[0].get(role), percent), _ROLE_TERMS.get(role, ""))


def _difference(apart: tuple[float, tuple[float, float]] | None) -> TableCell:
    value, limits = apart or (None, None)
    return TableCell(value, points, limits)


KIND = AttentionReadout
