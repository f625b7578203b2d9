"""Attention: how much the acting stream gives to every token, the patterns of every head, and cuts of attention.

with capture_attention(policy) as mass:
    policy.act([seen], [seed])
mass.of_role(policy.roles([seen])["backbone"], "image")  # {(block, iteration): (B,)}

with capture_patterns(policy, policy.streams["expert"].sites("heads")) as patterns:
    policy.act([seen], [0])
patterns["expert.02.heads@9"]  # (B, H, S, T): S positions of the stream attend to T

with cut_attention(policy, {site: AttentionCut(keys) for site in policy.streams["expert"].sites("heads")}) as log:
    policy.act([seen], [0])  # no head reads the tokens that `keys` marks

Queries, keys, masks and scales are those that reach torch's attention, after rotation and norms. Every pattern is
checked: multiplied with the values of the same call, it must give what the heads read. A token that gets attention
need not be used.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary, ref

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.overrides import TorchFunctionMode

from probe_kit.errors import CaptureError, RolesMismatchError, UnknownSiteError, UsageError
from probe_kit.hooks.capturing.capture_context import ActivationCache, capture, edit
from probe_kit.hooks.capturing.edits import ActiveEdits, EditLog
from probe_kit.hooks.contract.model import EVERY, Model, Policy, Tap
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import HEADS, Site, first_of

Read = tuple[int, int]
"""A block of the backbone whose keys and values are read, and the iteration in which it is."""


@dataclass
class AttentionMass:
    """The shares of attention, by (block of the backbone whose keys are read, iteration).

    They are not causal: a token can receive attention without being used. They serve an optional display only.

    Attributes:
        by_head: (B, H, T) float32, a mean over acting positions; what is missing to 1 lies on the acting part's
            own tokens.
    """

    by_head: dict[Read, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def by_read(self) -> dict[Read, NDArray[np.float32]]:
        """The shares (B, T) float32, a mean over heads as well."""
        return {read: mass.mean(axis=1) for read, mass in self.by_head.items()}

    def heads_on(self, tokens: NDArray[np.bool_]) -> dict[Read, NDArray[np.float64]]:
        """The share on some tokens by head, (B, H).

        Args:
            tokens: (T,) or (B, T) bool, such as the patches of a tile.

        Raises:
            RolesMismatchError: For another number of tokens.
        """
        shares: dict[Read, NDArray[np.float64]] = {}
        for read, mass in self.by_head.items():
            if tokens.shape[-1] != mass.shape[2]:
                raise RolesMismatchError(
                    f"{tokens.shape[-1]} tokens are asked for; attention lies on {mass.shape[2]}. Take the roles "
                    "of the observations that were acted on"
                )
            mask = tokens if tokens.ndim == 1 else tokens[:, None]
            shares[read] = np.where(mask, mass, 0).sum(axis=2, dtype=np.float64)
        return shares

    def on(self, tokens: NDArray[np.bool_]) -> dict[Read, NDArray[np.float64]]:
        """The share on some tokens, (T,) or (B, T) bool, as a mean over heads, (B,).

        Raises:
            RolesMismatchError: For another number of tokens.
        """
        return {read: share.mean(axis=1) for read, share in self.heads_on(tokens).items()}

    def of_role(self, roles: Sequence[Roles], role: str) -> dict[Read, NDArray[np.float64]]:
        """The share on the tokens of one role, (B,); `roles` are the backbone's, one per row.

        Raises:
            RolesMismatchError: For roles of another length.
        """
        return self.on(np.stack([row.mask(role) for row in roles]))


@contextmanager
def capture_attention(policy: Policy) -> Iterator[AttentionMass]:
    """Record the attention of the acting stream while `policy` acts once; its actions stay bit-identical.

    Raises:
        UnsupportedInterventionError: For a family without attention recording.
        CaptureError: If no attention was recorded, or that of a block twice in an iteration.
    """
    policy.interventions.check("attention", policy.card.family)
    mass = AttentionMass()

    def note(block: int, iteration: int, weights: Tensor) -> None:
        if (block, iteration) in mass.by_head:
            raise CaptureError(
                f"{policy.card.family} recorded block {block} twice at iteration {iteration}; act once per context"
            )
        mass.by_head[block, iteration] = weights.detach().float().mean(dim=2).cpu().numpy()

    with policy.record_attention(note):
        yield mass
    if not mass.by_head:
        raise CaptureError(f"{policy.card.family} computed no attention in this context; act once inside of it")


MOST_BYTES = 2_000_000_000
"""The largest size of all patterns of one capture together, as float32 on the host."""
TOLERANCE: Mapping[torch.dtype, float] = {torch.float32: 1e-4, torch.float16: 5e-3, torch.bfloat16: 3e-2}
"""The largest difference of what a pattern gives from what the heads read, as a share of its largest number."""
_FUSED: Callable[..., Any] = functional.scaled_dot_product_attention
_SOFTMAX = (functional.softmax, torch.softmax, Tensor.softmax)
_MATMUL = (torch.matmul, Tensor.matmul, Tensor.__matmul__)
_OF_ATTENTION = frozenset({_FUSED, *_SOFTMAX, *_MATMUL})


@contextmanager
def capture_patterns(
    model: Model, sites: Iterable[Site], most_bytes: int = MOST_BYTES
) -> Iterator[ActivationCache]:
    """Capture the attention patterns of blocks while the model runs once; its output stays bit-identical.

    The pattern of a site is (B, H, S, T) float32 on the host. Its rows sum to 1, or to 0 where a position attends
    to nothing.

    Args:
        model: The model that runs inside the context.
        sites: Sites of the quantity `heads`.
        most_bytes: The largest size of all patterns together.

    Raises:
        UnknownSiteError: For another quantity.
        UsageError: Beyond `most_bytes`.
        CaptureError: For a pattern that does not give what the heads read, and what `capture` raises.
    """
    head_sites = tuple(dict.fromkeys(sites))
    if other := [site for site in head_sites if site.quantity != HEADS]:
        raise UnknownSiteError(
            f"{other[0]} has no attention pattern; expected sites of the quantity heads, such as "
            f"{other[0].stream}.{other[0].layer:02d}.{HEADS}"
        )
    calls, used = _AttentionCalls(model, head_sites), 0

    def keep(site: Site, read: Tensor) -> Tensor:
        nonlocal used
        pattern, _ = calls.at(site, read)
        used += pattern.numel() * 4
        if used > most_bytes:
            raise UsageError(
                f"attention patterns of {len(head_sites)} sites take more than {most_bytes / 1e9:.2f} GB, with "
                f"{pattern.numel() * 4 / 1e6:.1f} MB at {site}. Capture fewer sites, or raise most_bytes"
            )
        return pattern.cpu()

    with calls.watching(), capture(model, head_sites, reduce=keep) as patterns:
        yield patterns


# -- knockout -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AttentionCut:
    """Tokens that some heads of a site no longer attend to.

    The weights on these tokens become 0, and the others are renormalised: w_t / Σ w. That equals scores of −∞ in
    front of the softmax.

    Attributes:
        keys: (T',) bool, the tokens that are cut, from the first position that the site attends to; positions
            behind T' stay.
        queries: (S,) bool, the positions of the site's stream that no longer attend to them; None for all.
        heads: The heads that no longer attend to them, counted from 0; None for all.
    """

    keys: NDArray[np.bool_]
    queries: NDArray[np.bool_] | None = None
    heads: tuple[int, ...] | None = None


@contextmanager
def cut_attention(model: Model, cuts: Mapping[Site, AttentionCut]) -> Iterator[EditLog]:
    """Cut the attention of heads to tokens while the model runs once.

    The attention of the site is computed once more from what reaches torch, and compared with what the heads read,
    as in `capture_patterns`. Only heads and positions that are cut change: a cut of no token changes no bit.

    Args:
        model: The model that runs inside the context.
        cuts: By site of the quantity `heads`, the tokens that are cut there.

    Raises:
        UnknownSiteError: For another quantity.
        UsageError: For a head that the stream does not have.
        RolesMismatchError: For more tokens than a site attends to, or another number of positions.
        CaptureError: For an attention that cannot be computed once more, and where the tokens that are left have
            no weight that float32 can hold.
    """
    for site, cut in cuts.items():
        if site.quantity != HEADS:
            raise UnknownSiteError(f"{site} has no attention to cut; expected a site of the quantity heads")
        count = model.stream_of(site).heads
        if outside := [head for head in cut.heads or () if not 0 <= head < count]:
            raise UsageError(f"{site} has {count} heads, counted from 0; there is no head {outside[0]}")
    calls, active, log = _AttentionCalls(model, cuts), ActiveEdits(), EditLog()
    # Sites with the same cut share its masks: every inference has many, and makes each mask once.
    by_cut = {id(cut): _HiddenTokens(torch.from_numpy(cut.keys)) for cut in cuts.values() if cut.keys.any()}

    def change(site: Site, read: Tensor) -> Tensor:
        new = _without(site, calls, read, cuts[site], by_cut.get(id(cuts[site])))
        active.fired.append((site, read, new))
        return new

    with calls.watching(), edit(model, {site: partial(change, site) for site in cuts}):
        yield log
    log.entries += active.measured()


class _HiddenTokens:
    """Tokens that are cut, as masks of every length that is attended to.

    Attributes:
        keys: (T',) bool.
    """

    def __init__(self, keys: Tensor) -> None:
        self.keys = keys
        self._masks: dict[tuple[int, torch.device], Tensor] = {}

    def mask(self, site: Site, count: int, device: torch.device) -> Tensor:
        """Return (T,) bool, False behind T'; raises RolesMismatchError for fewer tokens than T'."""
        if (count, device) not in self._masks:
            if len(self.keys) > count:
                raise RolesMismatchError(
                    f"{len(self.keys)} tokens are to be cut or kept; {site} attends to {count}. Take the roles "
                    "of the observation that is inferred"
                )
            self._masks[count, device] = functional.pad(self.keys, (0, count - len(self.keys))).to(device)
        return self._masks[count, device]


def _without(
    site: Site, calls: "_AttentionCalls", read: Tensor, cut: AttentionCut, hidden: "_HiddenTokens | None"
) -> Tensor:
    """Return what the heads read (B, S, H · E) without the tokens that are cut; None for none."""
    weights, values = calls.at(site, read)
    if hidden is None:
        return read
    with torch._C.DisableTorchFunction():  # what is computed here is no attention of the model
        without = _renormalise(site, weights, hidden) @ values
        by_token = without.transpose(1, 2).to(read.dtype)
        if cut.queries is None and cut.heads is None:
            return by_token.flatten(2)
        new = read.clone().view(*read.shape[:2], weights.shape[1], -1)
        positions: NDArray[np.intp] = np.arange(read.shape[1])
        if cut.queries is not None:
            if cut.queries.size != read.shape[1]:
                raise RolesMismatchError(
                    f"{site} has {read.shape[1]} positions; {cut.queries.size} are chosen among"
                )
            positions = np.flatnonzero(cut.queries)
        heads = range(weights.shape[1]) if cut.heads is None else cut.heads
        rows, columns = torch.from_numpy(positions).to(read.device)[:, None], torch.tensor([*heads])
        new[:, rows, columns] = by_token[:, rows, columns.to(read.device)]
        return new.flatten(2)


def _renormalise(site: Site, weights: Tensor, hidden: _HiddenTokens) -> Tensor:
    """Return weights (B, H, S, T) that are 0 on the cut tokens and sum to 1 over the others."""
    left = weights.masked_fill(hidden.mask(site, weights.shape[3], weights.device), 0.0)
    total = left.sum(dim=-1, keepdim=True)
    if float(total.min()) > 0:
        return left.div_(total)
    # A position that attended to nothing before, such as padding, has no weights to renormalise.
    if bool(((total == 0) & (weights.sum(dim=-1, keepdim=True) > 0)).any()):
        raise CaptureError(
            f"{site}: the tokens that are left have no weight that float32 can hold, and cannot be renormalised. "
            "Cut fewer tokens"
        )
    return left.div_(total.clamp_min(torch.finfo(left.dtype).tiny))


def attended_roles(model: Model, roles: Mapping[str, Sequence[Roles]], site: Site, tokens: int) -> list[Roles]:
    """The roles of the T = `tokens` positions that a site attends to, per row.

    A stream that acts reads the backbone's positions, then its own. Where a decoder puts out tokens, it reads
    those that came before.

    Args:
        model: The model that was inferred.
        roles: The roles of every stream, as `Model.token_roles` or `AnswerModel.asked_roles` says them.
        site: A site of the stream that attends.
        tokens: The number T of positions in the pattern of that site.

    Raises:
        RolesMismatchError: For a stream without roles, or a number of tokens that fits neither.
    """
    stream, backbone = model.stream_of(site), first_of("backbone", model.streams.values())
    acting = first_of("action", model.streams.values())
    stream_roles = roles.get(stream.name)
    if stream_roles is None or backbone is None:
        raise RolesMismatchError(f"the tokens of {stream.name} have no roles; those of {', '.join(roles)} have")
    before, behind = roles[backbone], stream_roles
    if stream.name == backbone:
        behind = roles.get(acting or "", stream_roles)
    elif len(stream_roles[0]) == tokens and model.prompt_kv is None:
        return list(stream_roles)
    joined = [_join_roles(first, last, tokens) for first, last in zip(before, behind, strict=True)]
    if any(row is None for row in joined):
        raise RolesMismatchError(
            f"{site} attends to {tokens} positions; {backbone} has {len(before[0])} and {stream.name} "
            f"{len(stream_roles[0])}. Take the roles of the observations that were inferred"
        )
    return [row for row in joined if row is not None]


def _join_roles(before: Roles, behind: Roles, tokens: int) -> Roles | None:
    """The roles of `before`, then `behind`: once or, of a single position, as often as `tokens` in all have room.

    The result is None if they do not fit.
    """
    labels = _labels(before)
    missing, repeated = tokens - len(labels), _labels(behind)
    if missing < 0 or (missing not in (0, len(repeated)) and len(repeated) != 1):
        return None
    return Roles.from_labels(labels + (repeated if len(repeated) == missing else repeated * missing))


def _labels(roles: Roles) -> list[str]:
    return [span.role for span in roles.spans for _ in range(span.start, span.stop)]


# -- patterns of calls ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Attention:
    """An attention that a model computed.

    Attributes:
        weights: Makes the pattern (B, H, S, T) float32.
        values: (B, G, T, E), H a multiple of G.
    """

    weights: Callable[[], Tensor]
    values: Tensor


@dataclass(frozen=True)
class _Attending:
    """A module inside which all attention was computed that an output projection put out.

    Attributes:
        owner: That module, which owns the projection.
        begin: Child that ended last before the attention, where every call of the owner has one attention;
            None to watch from the owner's beginning on.
    """

    owner: "ref[nn.Module]"
    begin: "ref[nn.Module] | None"


_ATTENDING: "WeakKeyDictionary[nn.Module, _Attending]" = WeakKeyDictionary()
"""By output projection the module that attends, once it was watched."""


class _AttentionCalls(TorchFunctionMode):
    """A mode that sees torch's calls while a model runs, and changes none.

    Attributes:
        model: Model that runs.
        taps: Taps of the sites whose attention is asked for.
        last: Latest attention.
        is_inside: Whether that was computed while a module ran that owns an output projection of a site.
        projections: By output projection, whether all its attention that was asked for was.
    """

    def __init__(self, model: Model, sites: Iterable[Site]) -> None:
        super().__init__()
        self.model = model
        # Sites that differ only in the iteration have one tap.
        taps: dict[tuple[str, int], Tap] = {}
        self.taps: dict[Site, Tap] = {}
        for site in sites:
            if (site.stream, site.layer) not in taps:
                taps[site.stream, site.layer] = model.tap(site)
            self.taps[site] = taps[site.stream, site.layer]
        self._unchecked: list[tuple[Site, Tensor, Tensor]] = []
        self._unchecked_bytes = 0
        self.last: _Attention | None = None
        self.is_inside = False
        self.projections: dict[nn.Module, bool] = {}
        self._shares: Tensor | None = None
        self._depth = 0
        self._is_entered = False
        self._ended: nn.Module | None = None
        self._begins: dict[nn.Module, set[nn.Module | None]] = {}
        self._owner: nn.Module | None = None
        self._noted = 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch the calls of the model while it runs.

        Seeing each call costs as much as a third of a small model's inference. Where attention was computed
        inside its own modules once, only these are watched, from the last child before the attention to the output
        projection.
        """
        projections = {tap.module for tap in self.taps.values()}
        attending = {module: _ATTENDING[module] for module in projections if module in _ATTENDING}
        owners = {module: owner for module, part in attending.items() if (owner := part.owner()) is not None}
        is_known = len(owners) == len(projections)
        if not is_known:
            owners = _owners(getattr(self.model, "network", None), projections)
        with ExitStack() as stack:
            for owner in dict.fromkeys(owners.values()):
                of_owner = [module for module, other in owners.items() if other is owner]
                begin = attending[of_owner[0]].begin if is_known and len(of_owner) == 1 else None
                self._watch(owner, of_owner, is_known, None if begin is None else begin(), stack)
            if not is_known:
                stack.enter_context(self)
            yield
        self._check_readings()
        for module, is_inside in self.projections.items():
            if is_inside and module in owners and not is_known:
                begins = self._begins.get(owners[module], set())
                child = next(iter(begins)) if len(begins) == 1 else None
                _ATTENDING[module] = _Attending(ref(owners[module]), None if child is None else ref(child))

    def _watch(
        self,
        owner: nn.Module,
        projections: Sequence[nn.Module],
        is_known: bool,
        begin: nn.Module | None,
        stack: ExitStack,
    ) -> None:
        """Attach the hooks to a module that attends; `begin` is the child behind which its calls are watched."""
        hooks = []
        if begin is not None:  # hooks of the owner itself would cost as much as those calls
            hooks.append(begin.register_forward_hook(self._begin))
            stack.callback(self._pause)
        else:
            hooks += [
                owner.register_forward_pre_hook(partial(self._enter, is_known), prepend=True),
                owner.register_forward_hook(partial(self._leave, is_known), always_call=True),
            ]
        if not is_known:
            hooks += [child.register_forward_hook(self._end_child) for child in owner.children()]
        if is_known and len(projections) == 1:
            hooks.append(projections[0].register_forward_pre_hook(self._pause, prepend=True))
        for hook in hooks:
            stack.callback(hook.remove)

    def at(self, site: Site, read: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pattern (B, H, S, T) of the positions of a site, whose heads read `read` (B, S, H · E).

        With it come the values (B, H, T, E) float32 that every head reads.

        Raises:
            CaptureError: If torch computed no attention, or one that does not give what the heads read.
        """
        tap, last = self.taps[site], self.last
        if last is None:
            raise CaptureError(
                f"{site}: no attention that torch computes came before the output projection. Load the model with "
                "the attention sdpa or eager; kernels of other libraries do not show what they weigh"
            )
        with torch._C.DisableTorchFunction():
            weights = last.weights()
            values = _repeat_for_heads(last.values, weights.shape[1]).float().to(weights.device)
            computed = tap.rows.of((weights @ values).transpose(1, 2))
            if tap.tokens != EVERY:
                computed, weights = computed[:, tap.tokens], weights[:, :, tap.tokens]
            self._compare(site, computed, read)
        self.projections[tap.module] = self.projections.get(tap.module, True) and self.is_inside
        return tap.rows.of(weights), tap.rows.of(values)

    def _compare(self, site: Site, computed: Tensor, read: Tensor) -> None:
        """Keep by how much (B, S, H, E) differs from what the heads read (B, S, H · E), for `_check_readings`.

        Raises:
            CaptureError: For other shapes.
        """
        stream, shape = self.model.stream_of(site), computed.shape
        if shape[2] != stream.heads or (*shape[:2], shape[2] * shape[3]) != tuple(read.shape):
            raise _unlike_reading(
                site, f"has {shape[2]} heads and {tuple(shape)}", f"{stream.heads} and {tuple(read.shape)}"
            )
        self._unchecked.append((site, computed - read.reshape(shape), read))
        self._unchecked_bytes += read.numel() * 8
        if self._unchecked_bytes > _UNCHECKED_BYTES:
            self._check_readings()

    def _check_readings(self) -> None:
        """Raise CaptureError unless every pattern gives what the heads read: all together, as that costs less."""
        if not self._unchecked:
            return
        sites, differences, readings = zip(*self._unchecked, strict=True)
        self._unchecked, self._unchecked_bytes = [], 0
        norms = [
            torch.stack(torch._foreach_norm(list(tensors), ord=torch.inf)).tolist()
            for tensors in (differences, readings)
        ]
        for site, apart, largest, read in zip(sites, *norms, readings, strict=True):
            limit = TOLERANCE.get(read.dtype, TOLERANCE[torch.float32]) * largest
            if not apart <= limit:  # negated, so that NaN is refused too
                raise _unlike_reading(site, f"is off by {apart:.3g}", f"at most {limit:.3g}")

    def _enter(self, watches: bool, owner: nn.Module, *_: Any) -> None:
        self._depth += 1
        if self._depth == 1:
            self._owner, self._ended, self._noted = owner, None, 0
        if watches and self._depth == 1:
            self.last = None
            self._begin()

    def _begin(self, *_: Any) -> None:
        if not self._is_entered:
            self.last, self._is_entered = None, True
            self.__enter__()  # type: ignore[no-untyped-call]

    def _pause(self, *_: Any) -> None:
        if self._is_entered:
            self._is_entered = False
            self.__exit__(None, None, None)  # type: ignore[no-untyped-call]

    def _leave(self, watches: bool, *_: Any) -> None:
        if watches and self._depth == 1:
            self._pause()
        self._depth -= 1

    def _end_child(self, child: nn.Module, *_: Any) -> None:
        self._ended = child

    def _note(self, attention: "_Attention | None") -> None:
        self.last, self.is_inside = attention, self._depth > 0
        if self.is_inside and self._owner is not None:
            self._noted += 1
            begin = self._ended if self._noted == 1 else None  # of several in one call, each is watched
            self._begins.setdefault(self._owner, set()).add(begin)

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        del types
        result = func(*args, **kwargs) if kwargs else func(*args)
        if func not in _OF_ATTENTION:  # nearly all calls: each costs time
            return result
        keywords = kwargs or {}
        if func is _FUSED:
            self._note(_fused_attention(*args, **keywords))
        elif func in _SOFTMAX and result.dim() == 4:
            self._shares = result
        elif func in _MATMUL and self._shares is not None and _is_reading(self._shares, *args[:2]):
            shares, self._shares = self._shares, None
            self._note(_Attention(shares.float, args[1]))
        return result


def _owners(network: object, modules: Collection[nn.Module]) -> dict[nn.Module, nn.Module]:
    """Return by module the one of a network that has it as a child; modules without any are left out."""
    if not isinstance(network, nn.Module):
        return {}
    return {child: owner for owner in network.modules() for child in owner.children() if child in modules}


def _is_reading(shares: Tensor, weights: Tensor, values: Tensor) -> bool:
    """Whether a product is of these shares, or a copy of them in another dtype, with values."""
    return weights.shape == shares.shape and values.dim() == 4 and values.shape[2] == shares.shape[3]


def _fused_attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attn_mask: Tensor | None = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
    scale: float | None = None,
    **_: Any,
) -> _Attention | None:
    """The fused attention of torch: queries (B, H, S, E), keys and values (B, G, T, E); None of other shapes."""
    if query.dim() != 4 or dropout_p:
        return None

    def weights() -> Tensor:
        keys = _repeat_for_heads(key, query.shape[1]).float()
        factor = query.shape[-1] ** -0.5 if scale is None else scale
        logits = query.float() @ keys.transpose(2, 3) * factor
        mask = attn_mask
        if is_causal:
            mask = torch.ones(logits.shape[2:], dtype=torch.bool, device=logits.device).tril()
        if mask is not None:
            logits = logits.masked_fill(~mask, -torch.inf) if mask.dtype == torch.bool else logits + mask
        return functional.softmax(logits, dim=-1).nan_to_num(0.0)  # a position that attends to nothing

    return _Attention(weights, value)


def _repeat_for_heads(heads: Tensor, count: int) -> Tensor:
    """Return keys or values (B, G, T, E) as (B, H, T, E), each of the G repeated for the heads that share it."""
    batch, groups, *shape = heads.shape
    if groups == count:
        return heads
    return heads[:, :, None].expand(batch, groups, count // groups, *shape).flatten(1, 2)


_UNCHECKED_BYTES = 64_000_000
"""Size of readings that are kept to be compared together."""


def _unlike_reading(site: Site, actual: str, expected: str) -> CaptureError:
    """Return the error of a pattern that does not give what the heads read."""
    return CaptureError(
        f"the attention in front of {site} does not give what its heads read: it {actual}; expected {expected}. "
        "The block computes something between its attention and its output projection; correct the tap of `heads`"
    )
