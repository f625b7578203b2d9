"""Activations of whole passes: hooks keep references, and one copy or product serves all layers of a stack.

On a GPU the number of operations costs time, not their size. Therefore a hook keeps a reference to its tensor and
does no more. When the last site of a pass has fired, the tensors of all n sites and R rows become one tensor (n *
R, T, D). One product of it makes all views.

A network may write into a tensor after the hook saw it. The first pass of each kind therefore also copies each
tensor at once, and compares at the end. Tensors that were written to are copied at once from then on. Two passes
are of one kind if their sites, rows and hooks are the same.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from probe_kit.errors import RolesMismatchError
from probe_kit.hooks.contract.model import ALL_ROWS, EVERY, Model, Rows, Tap
from probe_kit.hooks.contract.sites import Site

_MOST_KINDS = 10_000
"""The most kinds that are remembered of one model; who registers other hooks at every inference makes new ones."""

_overwritten: "WeakKeyDictionary[Model, dict[Any, frozenset[Site]]]" = WeakKeyDictionary()
"""By model and kind of pass, the sites whose tensor was written after it had passed. A new kind is missing."""

_hook_tables: "WeakKeyDictionary[Model, list[Any]]" = WeakKeyDictionary()
"""By model, the tables of hooks of all its modules."""


@contextmanager
def outside_inference_mode() -> Iterator[None]:
    """Make plain tensors in the body, without a graph: torch refuses to train on those of its inference mode."""
    if torch.is_inference_mode_enabled():
        with torch.inference_mode(False), torch.no_grad():
            yield
    else:
        with torch.no_grad():
            yield


@dataclass(frozen=True)
class PassBlock:
    """A tensor of what is kept of n sites that fired one after another.

    Attributes:
        flat: (n * R, …), site by site; R rows are those of the pass.
        sites: The count n.
        rows: The part of the R rows that belongs to the sites.
    """

    flat: Tensor
    sites: int
    rows: Rows = ALL_ROWS

    def of(self, position: int) -> Tensor:
        """Return what is kept of one site, (B, …), as a view."""
        count = self.flat.shape[0] // self.sites
        return self.rows.of(self.flat[position * count : (position + 1) * count])

    def tensor(self) -> Tensor:
        """Return what is kept of all sites, (n, B, …), as a view."""
        shape = self.flat.shape[1:]
        if self.rows == ALL_ROWS:
            return self.flat.view(self.sites, -1, *shape)
        return self.flat.view(self.sites, self.rows.blocks, -1, *shape)[:, self.rows.index]


@dataclass
class BlockPart:
    """A part of a block: what is kept of one site. The block may not be there yet.

    Attributes:
        settle: Makes the block now, while the pass still runs; None once it is there.
        block: The block, once it is there.
        position: The number of the site in it.
    """

    settle: Callable[[], None] | None
    block: PassBlock | None = None
    position: int = 0

    def tensor(self) -> Tensor:
        """Return the site's own tensor, which shares no memory with those of other sites."""
        block = self.settled()
        with outside_inference_mode():
            part = block.of(self.position)
            return part if block.flat.shape[0] == part.shape[0] else part.clone()

    def settled(self) -> PassBlock:
        """Return the block."""
        if self.block is None:
            assert self.settle is not None
            self.settle()
        assert self.block is not None
        return self.block


def block_of(parts: Sequence[Tensor | BlockPart]) -> Tensor:
    """Return what is kept of these sites as one tensor (n, B, …), from as few operations as their blocks allow."""
    with outside_inference_mode():
        pieces: list[PassBlock] = []
        at = 0
        while at < len(parts):
            part = parts[at]
            if isinstance(part, Tensor):
                pieces.append(PassBlock(part, 1))
                at += 1
                continue
            block = part.settled()
            neighbours = parts[at : at + block.sites]
            if [_position_of(part) for part in neighbours] == [
                (id(block), number) for number in range(block.sites)
            ]:
                pieces.append(block)
                at += block.sites
            else:
                pieces.append(PassBlock(block.of(part.position), 1))
                at += 1
        if len({piece.rows for piece in pieces}) > 1:
            return torch.cat([piece.tensor() for piece in pieces])
        flats = [piece.flat for piece in pieces]
        flat = flats[0] if len(flats) == 1 else torch.cat(flats)
        return PassBlock(flat, len(parts), pieces[0].rows).tensor()


def _position_of(part: Tensor | BlockPart) -> tuple[int, int] | None:
    return None if isinstance(part, Tensor) else (id(part.block), part.position)


class _Reading:
    """Sites of one stream, quantity and iteration in a pass: the same part of one tensor after another.

    Attributes:
        is_selected: Whether `tensors` are the sites' own part, not all that passes; None before the first firing.
        copies: While a kind of pass is new, a copy of each tensor from the moment at which it fired.
    """

    def __init__(self, tap: Tap, sites: Sequence[Site], weights: Tensor | None) -> None:
        self.tap, self.sites, self.weights = tap, sites, weights
        self.is_selected: bool | None = None
        self.clear()

    def clear(self) -> None:
        """Forget what fired."""
        self.parts: list[tuple[BlockPart | None, BlockPart | None]] = []
        self.fired: list[Site] = []
        self.tensors: list[Tensor] = []
        self.copies: list[Tensor] = []

    def decide(self, passing: Tensor, is_shared: bool) -> bool:
        """Decide whether a firing selects, which takes an operation, or the whole pass does so at its end."""
        tap = self.tap
        if type(tap) is not Tap or tap.view is not None or passing.dim() != 3:
            return True
        if is_shared or (tap.tokens == EVERY and tap.rows.blocks == 1):
            return False
        # Else the copy of all would be much larger than what is kept of it.
        return tap.rows.blocks > 1 or 2 * len(range(*tap.tokens.indices(passing.shape[1]))) < passing.shape[1]


class _Pass:
    """Readings that are made of the same calls of the same modules, in order.

    Attributes:
        left: The number of firings that are to come.
        size: Bytes of what waits, with its copies.
        kind: The kind of pass, once it began.
        overwritten: The sites of this kind that are copied as they fire; None while the kind is new.
        compared: Of a new kind, by site whether its tensor was written after it had passed, still on the device.
        is_proof: Whether a new kind can be learned from this pass.
    """

    def __init__(self, readings: list[_Reading]) -> None:
        self.readings = readings
        self.left = sum(len(reading.sites) for reading in readings)
        self.size = 0
        self.kind: Any = None
        self.overwritten: frozenset[Site] | None = None
        self.compared: dict[Site, Tensor] = {}
        self.is_proof = True


class PassCapture:
    """The capture of one inference, pass by pass.

    Args:
        model: The model.
        weights: By stream, the weights (B, V, T) float32 of its V views; None makes no views.
        views: Receives a part of a block (V, D) per site where there are weights.
        tokens: Receives a part of a block (T, D) per site; None keeps no tokens.
        most_bytes: The largest size of tensors that wait, with their copies; a pass beyond it is divided. None
            divides none. A single site may take more.
    """

    def __init__(
        self,
        model: Model,
        weights: Mapping[str, Tensor] | None,
        views: dict[Site, Any],
        tokens: dict[Site, Any] | None,
        most_bytes: int | None = None,
    ) -> None:
        self._known = _overwritten.setdefault(model, {})
        self._weights, self._views, self._tokens, self._most_bytes = weights, views, tokens, most_bytes
        self._size = 0
        self._reading_of: dict[Site, tuple[_Pass, _Reading]] = {}
        self._hooks: dict[tuple[int, str], int] = {}
        self._repeated: dict[Any, Tensor] = {}
        self._copies_at_once = False
        self._tables = _tables_of(model)
        self._registered: Any = None

    def arrange(self, tapped: Iterable[tuple[Tap, Mapping[int, Site]]], attached: Set[int]) -> None:
        """Take the taps, each with its sites by iteration; their hooks are attached already.

        Args:
            tapped: The taps with their sites.
            attached: The ids of hooks of captures and edits. Those of others belong to the kind of a pass, because
                they may write into what passed.
        """
        registered = [number for table in self._tables if table for number in table]
        self._registered = len(attached), frozenset(registered) - attached
        calls: dict[tuple[str, str, int | None], list[Any]] = defaultdict(list)
        members: dict[tuple[str, str, int | None], list[Site]] = defaultdict(list)
        taps: dict[tuple[str, str, int | None], Tap] = {}
        for tap, at_fire in tapped:
            self._hooks[id(tap.module), tap.end] = len(_hooks_of(tap))
            for number, site in at_fire.items():
                stack = (site.stream, site.quantity, site.iteration)
                calls[stack].append((id(tap.module), tap.end, tap.argument, tap.first + number))
                members[stack].append(site)
                taps[stack] = tap
        shared: dict[tuple[Any, ...], list[_Reading]] = defaultdict(list)
        for stack, sites in members.items():
            weights = None if self._weights is None else self._weights[stack[0]]
            shared[tuple(calls[stack])].append(_Reading(taps[stack], sites, weights))
        for readings in shared.values():
            stack_pass = _Pass(readings)
            self._reading_of |= {site: (stack_pass, reading) for reading in readings for site in reading.sites}

    def copy_at_once(self) -> None:
        """Let every further firing copy: an edit writes what passes, behind the hooks of this capture."""
        self._copies_at_once = True

    def fire(self, site: Site, tap: Tap, passing: Tensor) -> None:
        """Keep what passes at a site; where it is the last of its pass, make the blocks."""
        stack_pass, reading = self._reading_of[site]
        if stack_pass.kind is None:
            self._begin(stack_pass, passing)
        if reading.is_selected is None:
            reading.is_selected = reading.decide(passing, len(stack_pass.readings) > 1)
        tensor = passing
        if reading.is_selected:
            with outside_inference_mode():
                tensor = tap.select(passing)
        if self._most_bytes is not None:
            self._make_room(stack_pass, tensor)
        # Another hook behind ours may write into the tensor, in this inference alone.
        if self._copies_at_once or len(_hooks_of(tap)) != self._hooks[id(tap.module), tap.end]:
            stack_pass.is_proof, tensor = False, _copy(tensor)
        elif stack_pass.overwritten is None:
            if stack_pass.left > 1:
                reading.copies.append(_copy(tensor))
        elif site in stack_pass.overwritten:
            tensor = _copy(tensor)
        self._hold(stack_pass, reading, site, tensor)
        stack_pass.left -= 1
        if not stack_pass.left:
            self._settle(stack_pass)

    def learn(self) -> None:
        """Learn from passes of new kinds, after the inference: the answer waits for the device."""
        for stack_pass in self._passes():
            if stack_pass.overwritten is None and stack_pass.is_proof and stack_pass.kind is not None:
                flags = torch.stack(list(stack_pass.compared.values())).tolist() if stack_pass.compared else []
                written = (site for site, is_written in zip(stack_pass.compared, flags, strict=True) if is_written)
                if len(self._known) == _MOST_KINDS:
                    self._known.clear()
                self._known[stack_pass.kind] = frozenset(written)

    def _passes(self) -> list[_Pass]:
        return list({id(stack_pass): stack_pass for stack_pass, _ in self._reading_of.values()}.values())

    def _begin(self, stack_pass: _Pass, passing: Tensor) -> None:
        sites = tuple(site for reading in stack_pass.readings for site in reading.sites)
        stack_pass.kind = (sites, passing.shape[0], self._most_bytes, self._registered)
        stack_pass.overwritten = self._known.get(stack_pass.kind)

    def _make_room(self, stack_pass: _Pass, tensor: Tensor) -> None:
        """Count a tensor that is to wait; before it would exceed the bytes, make blocks of what waits."""
        size = 2 * tensor.numel() * tensor.element_size()
        if self._weights is not None and tensor.dtype != torch.float32:
            size += 4 * tensor.numel()
        if self._size and self._size + size > (self._most_bytes or 0):
            for waiting in self._passes():
                self._settle(waiting)
        stack_pass.size += size
        self._size += size

    def _hold(self, stack_pass: _Pass, reading: _Reading, site: Site, tensor: Tensor) -> None:
        settle = partial(self._settle, stack_pass)
        view = None if self._weights is None else BlockPart(settle)
        token = None if self._tokens is None else BlockPart(settle)
        if view is not None:
            self._views[site] = view
        if token is not None and self._tokens is not None:
            self._tokens[site] = token
        reading.fired.append(site)
        reading.tensors.append(tensor)
        reading.parts.append((view, token))

    def _settle(self, stack_pass: _Pass) -> None:
        """Make blocks of what waits in a pass."""
        with outside_inference_mode():
            joined: dict[Any, Tensor] = {}
            products: dict[Any, list[tuple[_Reading, slice]]] = defaultdict(list)
            for reading in stack_pass.readings:
                if reading.copies:
                    self._compare(stack_pass, reading)
                for same in _runs(reading.tensors):
                    key = tuple(map(id, reading.tensors[same])), str(self._tokens_of(reading))
                    if key not in joined:
                        joined[key] = self._join(reading, reading.tensors[same])
                    rows = ALL_ROWS if reading.is_selected else reading.tap.rows
                    self._assign(reading, same, 1, PassBlock(joined[key], same.stop - same.start, rows))
                    if reading.weights is not None:
                        alone = id(reading) if rows.blocks == 1 else 0
                        products[key, rows.blocks, reading.weights.shape[1], alone].append((reading, same))
            for (key, blocks, *_), members in products.items():
                same = members[0][1]
                count = same.stop - same.start
                weights = self._weights_of([reading for reading, _ in members], blocks, count)
                flat = _product(weights, joined[key])
                for reading, of_reading in members:
                    rows = ALL_ROWS if reading.is_selected else reading.tap.rows
                    self._assign(reading, of_reading, 0, PassBlock(flat, count, rows))
        for reading in stack_pass.readings:
            reading.clear()
        self._size, stack_pass.size = self._size - stack_pass.size, 0

    def _compare(self, stack_pass: _Pass, reading: _Reading) -> None:
        """Ask which tensors were written since they passed, and take the copies for them."""
        for number, copied in enumerate(reading.copies):
            stack_pass.compared[reading.fired[number]] = (
                copied != reading.tensors[number]
            ).any()  # NaN: to be sure
            reading.tensors[number] = copied

    def _tokens_of(self, reading: _Reading) -> slice:
        return EVERY if reading.is_selected else reading.tap.tokens

    def _join(self, reading: _Reading, tensors: Sequence[Tensor]) -> Tensor:
        """Return the sites' tokens (n * R, T, D) of one tensor each, as a copy where tokens are kept."""
        flat = tensors[0] if len(tensors) == 1 and self._tokens is None else torch.cat(list(tensors))
        tokens = self._tokens_of(reading)
        if len(range(*tokens.indices(flat.shape[1]))) == flat.shape[1]:
            return flat
        part = flat[:, tokens]
        return part if self._tokens is None or 2 * part.shape[1] > flat.shape[1] else part.clone()

    def _assign(self, reading: _Reading, same: slice, which: int, block: PassBlock) -> None:
        for position, parts in enumerate(reading.parts[same]):
            part = parts[which]
            if part is not None:
                part.settle, part.block, part.position = None, block, position

    def _weights_of(self, readings: Sequence[_Reading], blocks: int, count: int) -> Tensor:
        """Return the weights (n * R, V, T) of n sites; rows that no reading has weigh nothing."""
        key = tuple(id(reading.weights) for reading in readings), blocks, count
        if key not in self._repeated:
            of_readings = [(reading.tap.rows.index, reading.weights) for reading in readings]
            by_block = {index: of_stream for index, of_stream in of_readings if of_stream is not None}
            weights = next(iter(by_block.values()))
            if blocks > 1:
                absent = torch.zeros_like(weights)
                weights = torch.cat([by_block.get(number, absent) for number in range(blocks)])
            if count > 1:
                weights = weights.expand(count, -1, -1) if len(weights) == 1 else weights.repeat(count, 1, 1)
            self._repeated[key] = weights
        return self._repeated[key]


def _product(weights: Tensor, tokens: Tensor) -> Tensor:
    """Return the views (n * R, V, D) float32 of tokens (n * R, T, D).

    Raises:
        RolesMismatchError: For weights of another number of rows or tokens.
    """
    if weights.shape[2] != tokens.shape[1]:
        raise RolesMismatchError(
            f"the stream has {tokens.shape[1]} tokens but the model names roles for {weights.shape[2]}; "
            "the adapter's roles() does not describe this model's packing"
        )
    if weights.shape[0] != tokens.shape[0]:
        raise RolesMismatchError(
            f"{tokens.shape[0]} rows pass, of {weights.shape[0]} that have roles; the adapter's roles() does not "
            "describe this model's batch"
        )
    return torch.bmm(weights, tokens if tokens.dtype == torch.float32 else tokens.float())


def _copy(tensor: Tensor) -> Tensor:
    with outside_inference_mode():
        return tensor.clone()


def _tables_of(model: Model) -> list[Any]:
    if model not in _hook_tables:
        networks = [part for part in vars(model).values() if isinstance(part, nn.Module)]
        modules = {id(module): module for network in networks for module in network.modules()}.values()
        tables = [table for module in modules for table in (module._forward_hooks, module._forward_pre_hooks)]
        _hook_tables[model] = tables
    return _hook_tables[model]


def _hooks_of(tap: Tap) -> Any:
    return tap.module._forward_hooks if tap.end == "output" else tap.module._forward_pre_hooks


def _runs(tensors: Sequence[Tensor]) -> list[slice]:
    """Return slices of neighbours of one shape, type and device."""
    runs, start = [], 0
    for _, of_kind in groupby(tensors, key=lambda tensor: (tensor.shape, tensor.dtype, tensor.device)):
        stop = start + sum(1 for _ in of_kind)
        runs.append(slice(start, stop))
        start = stop
    return runs


def sums_of(parts: Iterable[Tensor | BlockPart]) -> list[Tensor]:
    """Return a number per block, which is not finite if one of the block is not; an overflow is none either."""
    flats: dict[int, Tensor] = {}
    for part in parts:
        flat = part if isinstance(part, Tensor) else part.settled().flat
        flats[id(flat)] = flat
    return [
        flat.sum(dtype=torch.float32) if flat.dtype == torch.float16 else flat.sum() for flat in flats.values()
    ]
