"""Staging buffers: host memory that holds an episode's activations until they are written."""

from collections.abc import Sequence
from functools import cache
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from probe_kit.runs.arrays import NOT_A_NUMBER
from probe_kit.runs.layout import MEAN_VIEW, LaterViews, StoredStream

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from probe_kit.hooks import Roles


class EpisodeBuffers:
    """Everything captured in one episode, shaped like its rows in the store.

    pooled: (S, *lead, V, D) float32 per stream, NaN where nothing was captured.
    tokens: (S, *lead, T, D) uint16 bits of bfloat16 per stream, zero where there is no token; empty if only
    views are stored.
    later: (S - 1, *lead, D) uint16 bits of bfloat16 per stream, the view `mean` of the inferences after the first;
    empty unless they keep that view alone, and pooled then holds the first one.
    roles: per captured inference and stream, the spans of roles.
    lens_margins: of a question that is answered by letter, see `letter_margins`; None for all else.
    pinned: page-locked memory, into which a GPU copies while it computes on.
    """

    def __init__(
        self, streams: Sequence[StoredStream], calls: int, with_tokens: bool, pinned: bool,
        later_views: LaterViews = "all",
    ) -> None:  # fmt: skip
        full = calls if later_views == "all" else 1  # `later` has the other calls
        self.later: dict[str, NDArray[np.uint16]] = {
            s.name: _memory((calls - 1, *s.lead, s.width), np.uint16, pinned)
            for s in streams
            if later_views == MEAN_VIEW
        }
        self._mean_of = {s.name: s.views.index(MEAN_VIEW) for s in streams if s.name in self.later}
        self.pooled: dict[str, NDArray[np.float32]] = {
            s.name: _memory((full, *s.lead, len(s.views), s.width), np.float32, pinned) for s in streams
        }
        self.tokens: dict[str, NDArray[np.uint16]] = {
            s.name: _memory((calls, *s.lead, s.stored_tokens, s.width), np.uint16, pinned)
            for s in streams
            if with_tokens
        }
        self._copies: list[Any] = []
        self.clear()

    def clear(self) -> None:
        """Forget the episode."""
        self.roles: list[dict[str, list[tuple[str, int, int]]]] = []
        self.lens_margins: list[float] | None = None
        for pooled in self.pooled.values():
            pooled.fill(np.nan)
        for tokens in self.tokens.values():
            tokens.fill(0)
        for later in self.later.values():
            later.fill(NOT_A_NUMBER)

    def keep_roles(self, roles: "dict[str, Roles]") -> None:
        """Begin the next captured inference."""
        self.roles.append(
            {name: [(s.role, s.start, s.stop) for s in stream_roles.spans] for name, stream_roles in roles.items()}
        )

    def keep_pooled(self, stream: str, values: "Tensor") -> None:
        """Copy (sites, V, D) of the last inference begun, or what is stored of it."""
        import torch

        call = len(self.roles) - 1
        if call and stream in self.later:
            # torch knows bfloat16 and numpy does not: the bits travel as integers.
            bits = values[..., self._mean_of[stream], :].to(torch.bfloat16).view(torch.int16)
            self._copy(bits, self.later[stream][call - 1].view(np.int16))
        else:
            self._copy(values, self.pooled[stream][call])

    def keep_tokens(self, stream: str, bits: "Tensor") -> None:
        """Copy (*lead, T, D) int16 bit patterns of the last inference begun; behind them come zeros.

        The zeros are added on the device: a copy into part of a row goes through memory that is not locked, and
        the model would wait for it.
        """
        from torch.nn.functional import pad

        row = self.tokens[stream][len(self.roles) - 1].view(np.int16)
        behind = row.shape[-2] - bits.shape[-2]
        self._copy(pad(bits, (0, 0, 0, behind)) if behind else bits, row)

    def _copy(self, source: "Tensor", target: NDArray[Any]) -> None:
        import torch

        arrival = copy_aside(source.reshape(target.shape), torch.from_numpy(target))
        if arrival is not None:
            self._copies.append(arrival)

    def wait(self) -> None:
        """Return when every copy has arrived."""
        while self._copies:
            self._copies.pop().synchronize()


def copy_aside(source: "Tensor", target: "Tensor") -> Any:
    """Copy to host memory while the device computes; returns the event of its completion, None on a CPU.

    target: contiguous, and page-locked where the source lies on a GPU. The copy goes through a stream of its own,
    which begins when the source is computed; the source's memory is not used again before the copy is through.
    """
    import torch

    if not source.is_cuda:
        target.copy_(source)
        return None
    stream = _side_stream(source.device)
    stream.wait_stream(torch.cuda.current_stream(source.device))
    with torch.cuda.stream(stream):
        target.copy_(source, non_blocking=True)
        arrival = torch.cuda.Event()  # type: ignore[no-untyped-call]
        arrival.record(stream)
    source.record_stream(stream)  # else torch would give its memory to the next tensor while it is copied
    return arrival


@cache
def _side_stream(device: "torch.device") -> "torch.cuda.Stream":
    """One per device: copies of several episodes queue there, behind each other and beside the model."""
    import torch

    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


def _memory(shape: tuple[int, ...], dtype: DTypeLike, pinned: bool) -> NDArray[Any]:
    if not pinned:
        return np.empty(shape, dtype)
    import torch

    # As bytes, so that no type of numpy needs a name in torch.
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    locked: NDArray[Any] = torch.empty(size, dtype=torch.uint8, pin_memory=True).numpy()
    return locked.view(dtype).reshape(shape)


class BufferPool:
    """A fixed number of buffers. Waiting for a free one is what keeps a GPU from outrunning the disk."""

    def __init__(self, buffers: Sequence[EpisodeBuffers]) -> None:
        self._free: SimpleQueue[EpisodeBuffers] = SimpleQueue()
        for free in buffers:
            self._free.put(free)

    def take(self) -> EpisodeBuffers:
        """Empty buffers; waits until some are given back."""
        return self._free.get()

    def give_back(self, buffers: EpisodeBuffers) -> None:
        """Make buffers available to the next episode."""
        buffers.clear()
        self._free.put(buffers)
