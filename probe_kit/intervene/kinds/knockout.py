"""Attention knockout: from which tokens, and in which layers, does the action read?

The attention of the acting stream to the tokens of a role is cut in a window of layers, on the clean inference.
The weights of these tokens become 0, and the others are renormalised. Windows grow from the first layer, or from
the last, or slide over the layers. A control cuts random tokens of other roles, as many, in the same layers.
Source: Geva, Bastings, Filippova, Globerson: Dissecting recall of factual associations in auto-regressive language
models, EMNLP 2023.

The cut removes the acting stream's view of the tokens, not their information. If the backbone has carried a word
into other tokens, it still reaches the action from there. So a cut that loses nothing shows that the action does
not read these tokens directly.

In a scene, the loss is a share of the effect of the picture's place. Each item is played with its pictures in both
orders. The difference between both actions is what the action knows of the order; the loss is the share of it that
the cut removes:

    lost = 2 · Σ s (x_clean − x_cut) / Σ s (x_clean − x_swapped)

over episodes, where x is the displacement and s the side of the correct picture. At 1 the action no longer tells
both orders apart; at 2 it acts as after the swap. Where the pictures have no such effect, and in runs without
sides, the size of the change counts instead, in spreads of the clean actions. It is compared with that of the
controls.

The other roles may have fewer tokens than the cut: beside a picture there are few words. In runs without sides a
control of less than half the size is left out. There a change counts from a tenth of the spread on.

The role `kv.NN` is a place: all that the acting stream reads of block NN of the backbone. That is every token of
the backbone, in the one layer that reads the block, so that no other token is left for a control.

With whole episodes in an environment, the loss is of success. It is the share of episodes that succeed without the
cut and fail with it, minus the share of the reverse.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import parse_json
from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.content import absent
from probe_kit._tables.numbers import number, percent, with_sign
from probe_kit.errors import EmptyRoleError, UnsupportedInterventionError, UsageError
from probe_kit.extract.sources.environment import SUCCESS
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.declared import InterventionKind
from probe_kit.hooks.contract.sites import HEADS, KV_STREAM, Site, first_of
from probe_kit.intervene.edited_cells import CONTROL, EditedCell
from probe_kit.intervene.exchange import NOTHING, SwapShare
from probe_kit.intervene.kinds.attention import backbone_of
from probe_kit.intervene.kinds.base import (
    UNRESOLVED,
    EffectColumn,
    EffectRow,
    Intervention,
    common_columns,
    compare_with_controls,
    effect_table,
    interval_cell,
    is_resolved,
    lines_of,
    mean_of,
    net_interval,
    p_of,
)
from probe_kit.intervene.kinds.closed_loop import CORRECT
from probe_kit.intervene.outcomes import CLEAN, UNCHANGED, ConditionOutcomes
from probe_kit.intervene.places import ALL, TILES, PlaceName, resolve_sites, roles_of
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, ConditionContext, ConditionResult
from probe_kit.intervene.settings import FIRST_CHUNK
from probe_kit.intervene.stored import Measurement, preferred_by_category, stored_interventions
from probe_kit.runs.layout import DATASET, ENVIRONMENT
from probe_kit.runs.reader import RunReader
from probe_kit.runs.records import as_json
from probe_kit.runs.run import Run
from probe_kit.statistics.paired_tests import smallest_flip_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import groups_for_interventions

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.hooks import Policy
    from probe_kit.intervene.sessions import ReplaySession

ROLES = ("image", "language", "state")
"""Roles that are cut by default, as many of them as the backbone's tokens have."""
CUT = "cut"
"""Direction of a condition that cuts the role itself, beside those of its controls."""
Growth = Literal["both", "first", "last"]


# -- the kind --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Knockout(Intervention):
    """Cuts of the attention to every role, in windows of layers.

    Attributes:
        roles: Roles of the backbone's tokens that are cut; empty for `ROLES`, as many as there are. `kv.02` and
            `kv.*` are all that the acting stream reads of a block of the backbone.
        window: `first`: layers 0 to n, for every n. `last`: layers n to the last, for every n. `both`. A number k:
            every k neighbouring layers.
        readers: Role of the backbone's tokens that no longer read; empty for the acting stream.
        heads: Heads that no longer read, counted from 0; empty for all.
        controls: Number of controls per window and role.
        seed: Seed of the controls.
        closed_loop: Whether whole episodes are played with the cut at every inference. The loss is then of where
            the cube ends, in an environment of success.
        untrained: The same knockout in a network with random weights, as it is stored with that run; None for
            none. `stored_twin` finds it.

    Raises:
        UsageError: For another window, and for controls that are fewer than one in runs without sides.
    """

    kind: ClassVar[str] = "knockout"
    summary: ClassVar[str] = "Attention knockout: from which tokens, up to which layer, does the action read?"
    position: ClassVar[int] = 8
    asks_where: ClassVar[bool] = True
    needs: ClassVar[tuple[InterventionKind, ...]] = ("edit", "attention", "knockout")
    options: ClassVar[Mapping[str, str]] = {
        "roles": "whose tokens are cut; default image,language,state. kv.02 or kv.*: all of a block",
        "window": "layers that are cut together: both (default), first, last, or a number of neighbours",
        "readers": "role of the backbone's tokens that no longer read; default the acting stream",
        "heads": "heads that no longer read; default all",
        "controls": "cuts of as many random tokens of other roles; default 2",
        "seed": "of the controls; default 0",
        "closed_loop": "play whole episodes with the cut at every inference",
        "untrained": "run with random weights, whose knockout is shown beside this one",
    }

    roles: tuple[str, ...] = ()
    window: str = "both"
    readers: str = ""
    heads: tuple[int, ...] = ()
    controls: int = 2
    seed: int = 0
    closed_loop: bool = False
    untrained: Measurement | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        is_number = self.window.isdecimal() and int(self.window) > 0
        if self.window not in get_args(Growth) and not is_number:
            raise UsageError(
                f"--window is {self.window!r}; expected {', '.join(get_args(Growth))} or a number of layers"
            )
        if self.readout != FIRST_CHUNK:
            raise UsageError("--kind knockout measures the first inference; leave --readout out")
        if ALL in self.roles:
            raise UsageError(
                "--roles all leaves no token of another role for a control; name roles, such as image,language"
            )

    @classmethod
    def from_options(cls, run: Run, **options: Any) -> Self:
        """Return the kind with the heads as numbers, and with the knockout of the untrained network.

        Raises:
            UsageError: For a head that is no number, and what `stored_twin` raises.
        """
        names = options.pop("heads", ())
        if wrong := [name for name in names if not str(name).isdecimal()]:
            raise UsageError(f"--heads has {wrong[0]!r}; expected numbers, counted from 0, such as 0,3")
        folder = options.pop("untrained", None)
        kind = super().from_options(run, heads=tuple(int(name) for name in names), **options)
        if folder is None:
            return kind
        from probe_kit.runs import open_run

        return replace(kind, untrained=stored_twin(kind, run, open_run(folder)))

    @property
    def plays_episodes(self) -> bool:
        """Whether whole episodes are played again."""
        return self.closed_loop

    def parameters(self) -> dict[str, Any]:
        """Return its own settings; the untrained network's knockout by its key."""
        return super().parameters() | {"untrained": "" if self.untrained is None else self.untrained.key}

    def check_run(self, run: Run) -> None:
        """Refuse a run that cannot be played, or without anything to compare with; raises as the base does too.

        Raises:
            UsageError: For no control in a run without sides, and for a closed loop of a run whose episodes cannot
                be played again, or do not say whether they succeed.
        """
        super().check_run(run)
        if self.closed_loop and not run.source.is_scene:
            _check_success(run)
        if not run.source.is_scene and not self.controls:
            raise UsageError(
                "--controls 0 leaves nothing to compare with: any cut changes an action. Take 1 or more"
            )

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, the pictures swapped where they have sides, and every cut with its controls.

        Raises:
            UsageError: For a role that the backbone's tokens do not have, and for a window or head that is too
                large.
        """
        policy = session.policy
        backbone = backbone_of(policy)
        stream = policy.streams[backbone if self.readers else acting_stream(policy)]
        if not stream.heads:
            raise UnsupportedInterventionError(
                f"the heads of {stream.name} of {policy.card.family} cannot be reached, so that their attention "
                "cannot be cut. Patch `kv` instead (--kind interchange --sites kv.*)"
            )
        if outside := [head for head in self.heads if head >= stream.heads]:
            raise UsageError(f"{stream.name} has {stream.heads} heads, counted from 0; there is no {outside[0]}")
        layers = stream.layers - 1
        conditions = [CLEAN_RUN, *([SOURCE_RUN] if session.run.source.is_scene else [])]
        for role in self._roles(policy, backbone):
            block = block_of(role)
            spans = windows(self.window, layers) if block is None else [(block, block)]
            controls = self.controls if block is None else 0  # no token of the backbone is left for one
            for first, last in spans:
                sites = [site for site in stream.sites(HEADS) if first <= site.layer <= last]
                for name in (CUT, *(f"{CONTROL}{at + 1}" for at in range(controls))):
                    cell = EditedCell(f"{stream.name}.{first:02d}-{last:02d}.{HEADS}", role, name)
                    conditions.append(self._cut(cell, backbone, (first, last), sites))
        return conditions

    def _roles(self, policy: "Policy", backbone: str) -> tuple[str, ...]:
        role_names = (*policy.role_names[policy.tokens_of(backbone)], *TILES)
        roles: list[str] = []
        for role in self.roles or ROLES:
            if role.partition(".")[0] == KV_STREAM:
                roles += self._blocks(policy, role)
            else:
                roles += roles_of(policy, backbone, (role,))
        for role in (*self.roles, *([self.readers] if self.readers else [])):
            is_block = role in self.roles and role.partition(".")[0] == KV_STREAM
            if not is_block and role not in roles_of(policy, backbone, (role,)):
                raise UsageError(
                    f"no token of {backbone} has the role {role!r}; there are {', '.join(role_names)}"
                )
        return tuple(dict.fromkeys(roles))

    def _blocks(self, policy: "Policy", pattern: str) -> list[str]:
        """Return the places of `kv` that a pattern such as `kv.*` names, each all that is read of one block.

        Raises:
            UnsupportedInterventionError: For a family without `kv`, or whose layers do not read one block each.
            UnknownSiteError: For a block that does not exist.
            UsageError: For a part of a place, and with other readers or windows, which a place has itself.
        """
        names = [PlaceName.parse(group.name) for group in resolve_sites(pattern, policy)]
        if any(name != PlaceName(KV_STREAM, name.layer) for name in names):
            raise UsageError(f"--roles {pattern} is a part of a place; expected kv.* or a block, such as kv.02")
        if self.readers:
            raise UsageError(
                f"--readers {self.readers} reads inside the backbone; {pattern} is what the acting part reads of "
                "it. Leave one of both out"
            )
        assert policy.prompt_kv is not None
        stream = policy.streams[acting_stream(policy)]
        if stream.layers != policy.prompt_kv.layers:
            raise UnsupportedInterventionError(
                f"{stream.name} of {policy.card.family} has {stream.layers - 1} layers and kv "
                f"{policy.prompt_kv.layers - 1} blocks: which layer reads which block is not said. Name a role "
                "with --window 1, or patch the place (--kind interchange --sites kv.*)"
            )
        return [str(name) for name in names]

    def _cut(self, cell: EditedCell, backbone: str, window: tuple[int, int], sites: Sequence[Site]) -> Condition:
        """Return the clean inference in which nothing at these sites reads the tokens of a role, or a control."""

        def play(context: ConditionContext) -> ConditionResult:
            from probe_kit.hooks.capturing.attention import AttentionCut, cut_attention

            tokens = context.tokens
            try:
                keys = tokens.mask(backbone, cell.role if block_of(cell.role) is None else ALL)
            except EmptyRoleError:  # a tile may be hidden by the arm
                return ConditionResult(context.act())
            readers = tokens.mask(backbone, self.readers) if self.readers else None
            remaining = int(tokens.mask(backbone, ALL).sum() - keys.sum())
            if cell.is_control:
                seed = derive_seed(
                    "knockout", self.seed, context.pair.episode, context.pair.step, str(cell), *window
                )
                count, keys = keys.sum(), random_tokens(keys, tokens.mask(backbone, ALL), seed)
                if not context.session.run.source.is_scene and 2 * keys.sum() < count:
                    return ConditionResult(context.act())  # no control of that size: nothing is cut
            # Where a control cuts all other tokens, every control is the same cut, and is inferred once.
            same = (cell.site, keys.tobytes())
            if same not in context.results:
                cut = AttentionCut(keys, readers, self.heads or None)
                with cut_attention(context.session.policy, dict.fromkeys(sites, cut)) as log:
                    chunk = context.act()
                context.results[same] = ConditionResult(chunk, log)
            return replace(context.results[same], token_counts=(int(keys.sum()), remaining))

        return Condition(str(cell), play, cell=cell)

    def extra_files(
        self, session: "ReplaySession", conditions: Sequence[Condition], outcomes: ConditionOutcomes
    ) -> dict[str, bytes]:
        """Return the effects of the same cuts in the untrained network, where there is one."""
        del session, conditions, outcomes
        if self.untrained is None:
            return {}
        rows = [row.to_json() for row in self.untrained.rows(knockout_effects) if not row.is_control]
        columns = ("category", "role", "first", "last", "lost", "size")
        return {UNTRAINED_FILE: as_json({"effects": [{name: row[name] for name in columns} for row in rows]})}

    @staticmethod
    def effects(measurement: Measurement) -> "list[KnockoutEffect]":
        """Return one row per category, role and window, controls among them."""
        rows = measurement.rows(knockout_effects)
        if not measurement.settings.get("untrained"):
            return rows
        stored = parse_json(measurement.read(UNTRAINED_FILE))["effects"]
        twin = {(row["category"], row["role"], row["first"], row["last"]): row for row in stored}
        twins = [twin.get((row.category, row.role, row.first, row.last), {}) for row in rows]
        return [
            row
            if row.is_control
            else replace(row, untrained_lost=other.get("lost"), untrained_size=other.get("size"))
            for row, other in zip(rows, twins, strict=True)
        ]

    @staticmethod
    def table(rows: "Sequence[KnockoutEffect]", context: Measurement) -> "Table":
        """Return one line per category, role and window; controls are columns."""
        cuts = [row for row in rows if not row.is_control]
        return effect_table(
            f"From which tokens does it read? {context.subject}, knockout",
            ("category", "cut"),
            lines_of(cuts, lambda row: f"{row.role}, {row.layers}"),
            {"What the action loses": _columns(cuts, context.is_scene)},
            lambda row: row.matters,
            before=[
                "layers: those in which the acting part cannot read the tokens",
                "every episode played again with the cut at every inference" if _is_played(cuts) else "",
                "kv.NN: all that the acting part reads of block NN of the backbone" if _has_blocks(cuts) else "",
            ],
            after=[UNRESOLVED if any(not row.is_resolved for row in cuts) else ""],
        )

    @staticmethod
    def sentence(rows: "Sequence[KnockoutEffect]", context: Measurement) -> str:
        """Return from which tokens the action reads, and in which layers, role by role."""
        del context
        text = "; ".join(reading_of(part) for part in by_role(rows).values())
        return f"{text} ({too_few_groups_text(rows[0].n_groups)})" if has_too_few_groups(rows) else text

    @staticmethod
    def finding(rows: "Sequence[KnockoutEffect]", context: Measurement) -> str:
        """Return the roles that the action reads, with their layers."""
        del context
        roles = by_role(rows)
        read = {role: span for role, part in roles.items() if (span := layers_read(part)) is not None}
        if has_too_few_groups(rows):
            return f"unknown: {too_few_groups_text(rows[0].n_groups)}"
        if any(row.has_nothing_to_lose for row in rows):
            return "unknown: no episode succeeds without a cut, so that a cut has no success to lose"
        if not read:
            return f"not read: no cut of {', '.join(roles)} loses more than its controls do, beyond chance"
        parts = [f"{role} in {span_text(*sorted(span))}" for role, span in read.items()]
        return f"read: {', '.join(parts)}"

    @staticmethod
    def notes(rows: "Sequence[KnockoutEffect]") -> list[str]:
        """Return how many tokens were cut, and what a cut that loses nothing does not say."""
        notes = [text for part in by_role(rows).values() if (text := describe_token_counts(part))]
        if all(layers_read(part) is not None for part in by_role(rows).values()):
            return notes
        return [
            *notes,
            "A cut that loses nothing says that the action does not read these tokens directly. What they say may "
            "still reach it through other tokens of the backbone (--kind interchange).",
        ]

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the stored knockouts that figures read.

        Raises:
            RunDamagedError: If a stored intervention was changed.
        """
        return {result.stored.key for result in preferred_by_category(run, Knockout.kind, FIRST_CHUNK).values()}


KIND = Knockout
UNTRAINED_FILE = "untrained.json"
"""The effects of the same cuts in a network with random weights."""
_SAME = ("roles", "window", "readers", "heads", "closed_loop", "controls", "seed", "wording")
"""Settings that two knockouts must share to be compared."""
_SAME_OF_RUN: Mapping[str, str] = {
    "model": "family",
    "suite": "suite",
    ENVIRONMENT: "environment",
    DATASET: "data set",
    "scene": "scene",
    "seed": "seed",
    "execute": "number of executed actions",
    "rotation": "rotation",
    "dtype": "dtype",
}
"""Settings that two runs must share so that their knockouts can be compared, with their names in messages."""


def stored_twin(kind: Knockout, run: Run, untrained: Run) -> Measurement:
    """Return the newest stored knockout of an untrained network that cuts as `kind` does, in the same episodes.

    Args:
        kind: The knockout that is compared.
        run: Its run.
        untrained: Run of the same episodes with random weights.

    Raises:
        UsageError: For the run itself, trained weights, another family, suite, seed or other setting of the run,
            and where no such knockout of the same items is stored.
    """
    where = f"--untrained {untrained.location}"
    if untrained.location.address == run.location.address or not untrained.random_weights:
        raise UsageError(
            f"{where} has trained weights; expected a run of the same episodes that was "
            "extracted with --random-weights"
        )
    for name, words in _SAME_OF_RUN.items():
        actual, expected = (_compared_setting(of_run, name, kind.closed_loop) for of_run in (untrained, run))
        if actual != expected:
            raise UsageError(
                f"{where} has another {words}{_difference(actual, expected)}. Extract it with the settings of "
                f"{run.location} and --random-weights"
            )
    settings = kind.parameters() | {"wording": run.wording}
    required = {name: settings[name] for name in _SAME}
    stored = list(stored_interventions(untrained, Knockout.kind))
    alike = [result for result in stored if {name: result.settings.get(name) for name in _SAME} == required]
    if not alike:
        last = max(stored, key=lambda result: result.newest, default=None)
        different = [] if last is None else [name for name in _SAME if last.settings.get(name) != required[name]]
        why = f"; the newest one has other {', '.join(different)}" if different else ""
        raise UsageError(
            f"{untrained.location} stores no knockout with these options{why}. Run "
            f"`probe-kit intervene {as_argument(untrained.location)} --kind knockout` with the same options first"
        )
    items = set(kind.items_in(run))
    same = [result for result in alike if set(map(str, result.outcomes.items)) == items]
    if not same:
        counts = ", ".join(str(np.unique(result.outcomes.items).size) for result in alike)
        raise UsageError(
            f"{untrained.location} stores this knockout of other items ({counts} of them; here {len(items)}). Run "
            f"`probe-kit intervene {as_argument(untrained.location)} --kind knockout` with the same --categories "
            "and --items first"
        )
    return max(same, key=lambda result: result.newest)


def _compared_setting(run: Run, name: str, closed_loop: bool) -> Any:
    """Return a setting of a run; that of the scene without its number of steps, unless episodes are played."""
    value = run.settings.get(name)
    if name != "scene" or value is None or closed_loop:
        return value
    return {part: content for part, content in value.items() if part != "max_steps"}


def _difference(actual: object, expected: object) -> str:
    """Return how a setting differs, for short values and for tables of them."""
    if isinstance(actual, Mapping) and isinstance(expected, Mapping):
        names = [name for name in {**actual, **expected} if actual.get(name) != expected.get(name)]
        return f" ({', '.join(map(str, names[:3]))})"
    return f": {actual!r}; expected {expected!r}"


def _check_success(run: Run) -> None:
    """Refuse a run without sides whose episodes cannot be played again, or do not say whether they succeed.

    Raises:
        UsageError: As said.
    """
    if not run.in_own_environment:
        raise UsageError(
            f"--closed-loop plays episodes again, and {run.location} shows stored pictures, in which nothing "
            "acts. Leave it out, or take a run of the scene or of an environment (--env)"
        )
    if SUCCESS not in (facts := run.settings[ENVIRONMENT]["columns"]):
        raise UsageError(
            f"--closed-loop counts the fact {SUCCESS!r}, and the environment of {run.location} has "
            f"{', '.join(facts) or 'no facts'}. Let step() say it, or leave --closed-loop out"
        )


def stored_knockouts(run: RunReader) -> dict[str, list["KnockoutEffect"]]:
    """Return by category the effects of the stored knockout of most episodes, the newest of equal ones.

    Closed loops are left out.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    preferred = preferred_by_category(run, Knockout.kind, FIRST_CHUNK)
    return {category: knockout_effects(result.outcomes) for category, result in preferred.items()}


def acting_stream(policy: "Policy") -> str:
    """Return the name of the stream whose heads read the backbone for the action."""
    name = first_of("action", policy.streams.values())
    assert name is not None, "every policy has a stream that acts"
    return name


def block_of(role: str) -> int | None:
    """Return the block of the backbone that a role such as `kv.02` names; None for a role of tokens."""
    stream, _, block = role.partition(".")
    return int(block) if stream == KV_STREAM and block.isdecimal() else None


def windows(window: str, layers: int) -> list[tuple[int, int]]:
    """Return the first and last layer of every window, without repetition.

    Raises:
        UsageError: For a window of more layers than there are.
    """
    first = [(0, at) for at in range(layers)]
    last = [(at, layers - 1) for at in range(layers)]
    if window in get_args(Growth):
        return [*dict.fromkeys((*(first if window != "last" else []), *(last if window != "first" else [])))]
    if (size := int(window)) > layers:
        raise UsageError(f"--window {size} is more than the {layers} layers that read")
    return [(at, at + size - 1) for at in range(layers - size + 1)]


def random_tokens(keys: NDArray[np.bool_], every: NDArray[np.bool_], seed: int) -> NDArray[np.bool_]:
    """Return (T,) as many random tokens of others as `keys` marks; all others where there are fewer.

    Args:
        keys: (T,) the tokens that are not drawn.
        every: (T,) all tokens but padding.
        seed: Seed of the draw.
    """
    drawable = np.flatnonzero(every & ~keys)
    count = min(int(keys.sum()), drawable.size)
    drawn = np.zeros_like(keys)
    drawn[np.random.default_rng(seed).choice(drawable, count, replace=False)] = True
    return drawn


# -- effects ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class KnockoutEffect(EffectRow):
    """The loss by one cut in one category; see `EffectRow`.

    Here `net` is the share of episodes whose action no longer goes to the correct picture's side, minus those that
    do only with the cut; 0 without sides.

    Attributes:
        first: First layer that is cut.
        last: Last layer that is cut.
        readable: Number of layers that could be cut.
        lost: Share of the picture's effect that is gone; of episodes in an environment, success that is gone. None
            for other runs without sides, and without such an effect.
        lost_ci: The 95 % interval of `lost`, by groups; None likewise.
        size: Mean change of the action, in spreads of the clean actions; of episodes in an environment, the share
            whose success changes.
        control_lost: Mean `lost` of the controls; None likewise, or without controls.
        control_size: Mean `size` of the controls; None without any.
        p: The p-value of the loss beyond the controls; without sides of the change. None for controls.
        p_fwe: Family-wise p-value over all cuts of the category; None likewise.
        success: Success rate of the episodes that were played with the cut; None without a closed loop.
        success_clean: Success rate of the same episodes without it; None likewise.
        n_groups: Number of groups of items.
        is_of_success: Whether `lost` is of success.
        cut_tokens: Mean number of tokens that are cut; None where it is not known, as in earlier versions.
        other_tokens: Mean number of the other tokens, from which controls are drawn; None likewise.
        control_tokens: Mean number of tokens that a control cuts; None likewise, and without controls.
        untrained_lost: `lost` of the same cut in an untrained network; None without one, or without an effect.
        untrained_size: `size` of the same; None without one.
    """

    first: int
    last: int
    readable: int
    lost: float | None
    lost_ci: tuple[float, float] | None
    size: float
    control_lost: float | None
    control_size: float | None
    p: float | None
    p_fwe: float | None
    success: float | None
    success_clean: float | None
    n_groups: int
    is_of_success: bool
    cut_tokens: float | None
    other_tokens: float | None
    control_tokens: float | None
    untrained_lost: float | None = None
    untrained_size: float | None = None

    @property
    def layers(self) -> str:
        """The layers that are cut, as text."""
        return span_text(self.first, self.last)

    @property
    def has_nothing_to_lose(self) -> bool:
        """Whether the loss is of success, and no episode succeeds without the cut."""
        return self.is_of_success and self.success_clean == 0

    @property
    def is_resolved(self) -> bool:
        """Whether the loss or the change is as large as the resolution of its measure."""
        return is_resolved(self.size if self.lost is None else self.lost)

    @property
    def matters(self) -> bool:
        """Whether it loses more than its controls beyond chance, and a share that would matter."""
        is_large = self.lost is None or self.lost - (self.control_lost or 0.0) >= NOTHING
        return self.is_resolved and is_large and self.p_fwe is not None and self.p_fwe < SIGNIFICANCE


def span_text(first: int, last: int) -> str:
    """Return a span of layers as text, such as `layer 2` or `layers 2 to 5`."""
    return f"layer {first}" if first == last else f"layers {first} to {last}"


def knockout_effects(outcomes: ConditionOutcomes) -> list[KnockoutEffect]:
    """Return one row per cut and control, of one category."""
    rows = [row for row, name in enumerate(outcomes.conditions) if name not in UNCHANGED]
    if not rows:
        return []
    cells = [outcomes.cells[row] for row in rows]
    spans = [layers_of(cell.site) for cell in cells]
    readable = 1 + max(last for _, last in spans)
    clean, correct = outcomes.of(CLEAN), outcomes.correct_sign
    moved = outcomes.displacement[rows] - clean
    # Of an episode that was played the change is where the cube ends.
    size = outcomes.size[rows] if outcomes.size is not None else np.abs(moved) / (clean.std() or 1.0)
    is_of_success = not outcomes.is_scene and outcomes.episode_outcomes is not None
    losses = _losses(outcomes, moved, is_of_success)
    # A control that cut nothing is none.
    is_cut = outcomes.edit_log[rows, :, 0] > 0
    broken = {at for at, cell in enumerate(cells) if cell.is_control and not is_cut[at].any()}
    # Where a picture has an effect, a loss is a move away from the correct one; else any change counts.
    if any(loss is not None for loss in losses):
        tested = -correct * moved if outcomes.is_scene else -moved
    else:
        lonely = [at for at in range(len(cells)) if not _has_control(cells, at, broken)]
        tested = size.copy()
        tested[lonely] -= NOTHING
        # Frames whose words are too few have no control, though others have: the same limit counts there.
        controls = [at for at, cell in enumerate(cells) if cell.is_control and at not in broken]
        tested[controls] = np.where(is_cut[controls], tested[controls], NOTHING)
    tests = compare_with_controls(np.asarray(tested), cells, outcomes, broken_controls=broken)
    ends = None if outcomes.episode_outcomes is None else (outcomes.episode_outcomes == CORRECT).mean(axis=1)
    ends = outcomes.displacement.mean(axis=1) if is_of_success else ends  # 1 for success
    effects = []
    for at, (row, cell, test) in enumerate(zip(rows, cells, tests, strict=True)):
        right_before, right = correct * clean > 0, correct * outcomes.displacement[row] > 0
        gains = right_before.astype(float) - right if outcomes.is_scene else np.zeros(clean.size)
        loss = losses[at]
        of_controls = [part.value for control in test.controls if (part := losses[control]) is not None]
        counts = _mean_counts(outcomes, row, [rows[control] for control in test.controls])
        effects.append(
            KnockoutEffect(
                **common_columns(outcomes, row, cell, gains),
                first=spans[at][0],
                last=spans[at][1],
                readable=readable,
                lost=None if loss is None else loss.value,
                lost_ci=None if loss is None else (loss.low, loss.high),
                size=float(size[at].mean()),
                control_lost=mean_of(np.array(of_controls)),
                control_size=mean_of(size[test.controls][is_cut[test.controls]]),
                p=test.p,
                p_fwe=test.p_fwe,
                success=None if ends is None else float(ends[row]),
                success_clean=None if ends is None else float(ends[0]),
                n_groups=np.unique(outcomes.groups).size,
                is_of_success=is_of_success,
                **counts,
            )
        )
    return effects


def _losses(
    outcomes: ConditionOutcomes, moved: NDArray[np.float64], is_of_success: bool
) -> list[SwapShare | None]:
    """Return the loss of each of K cuts that moved (K, E): of success or the picture's effect, None of neither."""
    if is_of_success:
        return [SwapShare(-float(away.mean()), *net_interval(-away, outcomes)) for away in moved]
    exchange = outcomes.exchange() if outcomes.is_scene else None
    shares = [None if exchange is None else exchange.share(away) for away in moved]
    return [None if share is None else SwapShare(*(2 * number for number in share)) for share in shares]


def _mean_counts(outcomes: ConditionOutcomes, row: int, controls: Sequence[int]) -> dict[str, Any]:
    """Return mean numbers of tokens: hidden by a cut, hidden by its controls, and of which these are drawn."""
    if outcomes.token_counts is None:
        return dict.fromkeys(("cut_tokens", "other_tokens", "control_tokens"))
    cut, remaining = outcomes.token_counts[row].T.astype(np.float64)
    hidden = outcomes.token_counts[controls, :, 0].astype(np.float64)
    return {
        "cut_tokens": mean_of(cut[cut > 0]),
        "other_tokens": mean_of(remaining[cut > 0]),
        "control_tokens": mean_of(hidden[hidden > 0]),
    }


def _has_control(cells: Sequence[EditedCell], at: int, broken: set[int]) -> bool:
    """Return whether a cell has a control that cut anything; a control is none of its own."""
    controls = {number for number, other in enumerate(cells) if other.is_control_of(cells[at])}
    return cells[at].is_control or bool(controls - broken)


def layers_of(site_name: str) -> tuple[int, int]:
    """Return the first and last layer of a place of a cut, such as `expert.00-03.heads`."""
    first, last = site_name.split(".")[1].split("-")
    return int(first), int(last)


def by_role(rows: "Sequence[KnockoutEffect]") -> dict[str, list[KnockoutEffect]]:
    """Return cuts by role, without controls; places of `kv` are together."""
    parts: dict[str, list[KnockoutEffect]] = {}
    for row in rows:
        if not row.is_control:
            parts.setdefault(row.role if block_of(row.role) is None else KV_STREAM, []).append(row)
    return parts


def has_too_few_groups(rows: "Sequence[KnockoutEffect]") -> bool:
    """Return whether there are so few groups of items that no cut can be significant."""
    return smallest_flip_p(rows[0].n_groups) >= SIGNIFICANCE


def too_few_groups_text(groups: int) -> str:
    """Return what so few groups of items cannot show, and how many can."""
    return (
        f"with {plural(groups, 'group')} of items no p can be below {smallest_flip_p(groups):.2g}; "
        f"{groups_for_interventions()} groups or more can show what is read"
    )


def describe_token_counts(rows: "Sequence[KnockoutEffect]") -> str:
    """Return a sentence on the tokens that the cuts of one role hide, and their controls; empty where unknown."""
    row = rows[0]
    if row.cut_tokens is None or row.other_tokens is None:
        return ""
    role = describe_role(rows)
    cut, remaining = _count(row.cut_tokens), _count(row.other_tokens)
    if block_of(row.role) is not None:
        return f"{role}: a cut hides {cut} tokens, all that the backbone has, so that there is no control."
    if row.control_tokens is None:
        return f"{role}: a cut hides {cut} tokens. There is no control; {remaining} tokens have other roles."
    control = _count(row.control_tokens)
    if row.control_tokens >= row.other_tokens:
        fewer = ", fewer than the cut" if row.control_tokens < row.cut_tokens else ""
        return (
            f"{role}: a cut hides {cut} tokens, a control all {remaining} others{fewer}. Nothing is drawn there: "
            "every control is the same cut."
        )
    return f"{role}: a cut hides {cut} tokens, a control {control} random ones of the {remaining} others."


def _count(mean: float) -> str:
    """Return a mean number of tokens as text: a whole number where every episode has as many."""
    return f"{mean:.0f}" if mean == round(mean) else f"{mean:.1f}"


def describe_role(rows: "Sequence[KnockoutEffect]") -> str:
    """Return the role of the cuts of one role, or the place or places of `kv`."""
    roles = list(dict.fromkeys(row.role for row in rows))
    return roles[0] if len(roles) == 1 else KV_STREAM


def windows_by_growth(rows: "Sequence[KnockoutEffect]") -> dict[str, list[KnockoutEffect]]:
    """Return the cuts of one role by how their windows grow.

    `up to`: from the first layer. `from`: to the last. `around`: neighbours that slide. The cut of all layers
    is in both of the first two.
    """
    if (len(rows) > 1 and are_sliding(rows)) or block_of(rows[0].role) is not None:
        return {"around": list(rows)}
    growths = {
        "up to": [row for row in rows if row.first == 0],
        "from": [row for row in rows if row.last == row.readable - 1],
    }
    return {growth: part for growth, part in growths.items() if len(part) > 1 or len(rows) == 1}


def are_sliding(rows: "Sequence[KnockoutEffect]") -> bool:
    """Return whether all cuts are of equally many layers."""
    return len({row.last - row.first for row in rows}) == 1


def layers_read(rows: "Sequence[KnockoutEffect]") -> tuple[int, int] | None:
    """Return the first and last layer in which a role is read, of the cuts of one role; None if it is not.

    With windows that grow from the first layer, reading begins where a loss is first beyond chance. With those
    that grow from the last, it ends in the last layer from which a cut still loses. One of both alone leaves the
    other limit at the end of the stack. Of windows that slide these are the outer limits of all that lose.
    """
    readable = rows[0].readable
    losing = [row for row in rows if row.matters]
    if not losing:
        return None
    if are_sliding(rows):
        return min(row.first for row in losing), max(row.last for row in losing)
    begin = min((row.last for row in losing if row.first == 0), default=0)
    end = max((row.first for row in losing if row.last == readable - 1), default=readable - 1)
    return begin, end


def reading_of(rows: "Sequence[KnockoutEffect]") -> str:
    """Return a clause on one role: the layers in which the action reads it, and what a cut loses."""
    role, read = describe_role(rows), layers_read(rows)
    widest = max(rows, key=lambda row: (row.last - row.first, row.size))
    cut = f"cut in {widest.layers}" if block_of(widest.role) is None else f"cut of {widest.role}"
    loss = _loss_text(widest)
    if read is None:
        loss += _controls_text(widest)
    if read is None and (has_too_few_groups(rows) or widest.has_nothing_to_lose):
        return f"whether the action reads {role} is unknown: a {cut} is a {loss}"
    if read is None and widest.is_of_success:
        return f"it is not shown that success needs {role}: a {cut} is a {loss}"
    if read is None and widest.lost is not None:
        return f"the picture's effect does not come directly from {role}: a {cut} is a {loss}"
    if read is None:
        return f"the action does not read {role} directly: a {cut} is a {loss}"
    begin, end = read
    if begin > end:
        return (
            f"the action reads {role} in {span_text(end, begin)}, where a part is enough: only cut "
            f"together they lose it ({loss})"
        )
    behind = f"; behind layer {end} nothing is lost" if end < rows[0].readable - 1 else ""
    return f"the action reads {role} in {span_text(begin, end)} ({loss}){behind}"


def _loss_text(row: KnockoutEffect) -> str:
    """Return what a cut loses, in words that follow *loss of* or *change of*."""
    rates = ""
    if row.success is not None:
        rates = f"success {percent(row.success)} % instead of {percent(row.success_clean)} %"
    if row.is_of_success:
        lost, ends = row.lost, row.lost_ci
        hundredfold = None if ends is None else (100 * ends[0], 100 * ends[1])
        points = interval_cell(None if lost is None else 100 * lost, hundredfold, partial(number, digits=0)).text
        return f"loss of {points} percentage points: {rates}"
    loss = (
        f"change of {number(row.size)} spreads"
        if row.lost is None
        else f"loss of {interval_cell(row.lost, row.lost_ci).text} of the picture's effect"
    )
    return ", ".join(filter(None, (loss, rates)))


def _controls_text(row: KnockoutEffect) -> str:
    """Return what the controls of a cut that is not beyond them lose; empty without any."""
    value = row.control_size if row.lost is None else row.control_lost
    if value is None:
        return ""
    return f"; its controls lose {f'{100 * value:.0f} points' if row.is_of_success else number(value)}"


def _has_blocks(rows: "Sequence[KnockoutEffect]") -> bool:
    """Return whether a place of `kv` is cut."""
    return any(block_of(row.role) is not None for row in rows)


def _is_played(rows: "Sequence[KnockoutEffect]") -> bool:
    """Return whether whole episodes were played."""
    return any(row.success is not None for row in rows)


def _columns(rows: "Sequence[KnockoutEffect]", is_scene: bool) -> list[EffectColumn[KnockoutEffect]]:
    """Return the columns of cuts; `is_scene` is whether a loss is a share of the picture's effect."""
    p = EffectColumn[KnockoutEffect](
        "p",
        lambda row: p_of(row.p_fwe, row.is_resolved),
        "p: family-wise over all cuts of the category, one-sided, against the controls",
    )
    change = EffectColumn[KnockoutEffect](
        "change",
        lambda row: TableCell(row.size, number),
        "change: how far the cut moves the action, in spreads (standard deviations) of the clean actions",
    )
    if _is_played(rows):
        change = EffectColumn[KnockoutEffect](
            "success % (without)",
            lambda row: TableCell(row.success, percent, after=f" ({percent(row.success_clean)})"),
            "success: of the episodes that are played with the cut, and without it in brackets",
        )
    controls = "controls: the same for as many random tokens of other roles"
    twin = EffectColumn[KnockoutEffect](
        "untrained",
        lambda row: TableCell(row.untrained_size, number),
        "untrained: change by the same cut in a network with random weights",
    )
    twins = [twin] if any(row.untrained_size is not None for row in rows) else []
    lost = "share of the picture's effect on the action that is gone, n/a where that effect is not beyond chance"
    if any(row.is_of_success for row in rows):
        lost = "success rate without the cut minus that with it, as a share of episodes"
    elif not is_scene:
        plain = EffectColumn[KnockoutEffect]("controls", lambda row: TableCell(row.control_size, number), controls)
        return [change, plain, *twins, p]
    wrong = EffectColumn[KnockoutEffect](
        "wrong side",
        lambda row: TableCell(row.net, with_sign),
        "wrong side: share of episodes whose action leaves the correct picture's side, minus the share that comes "
        "to it",
    )
    return [
        EffectColumn(
            "lost [95 %]",
            lambda row: absent("n/a") if row.lost is None else interval_cell(row.lost, row.lost_ci),
            f"lost: {lost}",
        ),
        EffectColumn("controls", lambda row: TableCell(row.control_lost, number), controls),
        change,
        *twins,
        *([wrong] if is_scene else []),
        p,
    ]
