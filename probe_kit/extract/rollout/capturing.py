"""Capture of one inference, its buffers in host memory, and a one-time proof that capture changes no action."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from probe_kit.errors import CaptureChangedActionError
from probe_kit.hooks.contract.sites import view_names
from probe_kit.runs.arrays import NOT_A_NUMBER
from probe_kit.runs.layout import LATER, MEAN_VIEW, LaterViews, StoredStream
from probe_kit.runs.plan import Row
from probe_kit.runs.writer import EpisodeRecord

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from probe_kit.hooks import Model, Roles
    from probe_kit.hooks.capturing.capture_context import CapturedViews


class EpisodeBuffers:
    """Everything captured in one episode, shaped like its rows in the store.

    S counts captured inferences. `lead` is (iterations, layers) of a stream with iterations, else (layers,).

    Attributes:
        pooled: (S, *lead, V, D) float32 per stream, NaN where nothing was captured.
        tokens: (S, *lead, T, D) uint16 bits of bfloat16 per stream, zero where there is no token; empty if only
            views are stored.
        later: (S - 1, *lead, D) uint16 bits of bfloat16 per stream, the view `mean` of the inferences after the
            first. It is empty unless they keep that view alone, and `pooled` then holds the first one.
        roles: The spans of roles, per captured inference and stream.
        lens_margins: The logit lens of a question that is answered by letter, see `letter_margins`; None for any
            other.

    Args:
        streams: The storage of the streams.
        calls: The number S of captured inferences.
        with_tokens: Whether every token is stored.
        pinned: Whether memory is page-locked, so that a GPU copies into it while it computes on.
        later_views: `mean` keeps of the inferences after the first the view `mean` alone.
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
        """Make the buffers empty for the next episode."""
        self.roles: list[dict[str, list[tuple[str, int, int]]]] = []
        self.lens_margins: list[float] | None = None
        for pooled in self.pooled.values():
            pooled.fill(np.nan)
        for tokens in self.tokens.values():
            tokens.fill(0)
        for later in self.later.values():
            later.fill(NOT_A_NUMBER)

    def record(self, planned: Row, outcome: Mapping[str, Any], **fields: Any) -> EpisodeRecord:
        """Return the part of the episode that the run stores; `fields` are others of an `EpisodeRecord`."""
        arrays: dict[str, Mapping[str, NDArray[Any]]] = {
            "pooled": self.pooled, "tokens": self.tokens, LATER: self.later,
        }  # fmt: skip
        return EpisodeRecord(
            planned, outcome, arrays, self.roles, lens_margins=self.lens_margins, **fields
        )  # fmt: skip

    def keep_roles(self, roles: "dict[str, Roles]") -> None:
        """Begin the next captured inference with its spans of roles."""
        self.roles.append(
            {name: [(s.role, s.start, s.stop) for s in stream_roles.spans] for name, stream_roles in roles.items()}
        )

    def keep_pooled(self, stream: str, values: "Tensor") -> None:
        """Copy the rows (sites, V, D) of the last inference begun, or what is stored of them."""
        import torch

        call = len(self.roles) - 1
        if call and stream in self.later:
            # torch knows bfloat16 and numpy does not: the bits travel as integers.
            bits = values[..., self._mean_of[stream], :].to(torch.bfloat16).view(torch.int16)
            self._copy(bits, self.later[stream][call - 1].view(np.int16))
        else:
            self._copy(values, self.pooled[stream][call])

    def keep_tokens(self, stream: str, bits: "Tensor") -> None:
        """Copy int16 bit patterns (*lead, T, D) of the last inference begun; behind them come zeros.

        The zeros are added on the device: a copy into part of a row goes through memory that is not locked. The
        model would wait for it.
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
        """Wait until every copy has arrived."""
        while self._copies:
            self._copies.pop().synchronize()


def copy_aside(source: "Tensor", target: "Tensor") -> Any:
    """Copy to host memory while the device computes; return the event of its completion, None on a CPU.

    The copy goes through a stream of its own, which begins when the source is computed. The source's memory is not
    used again before the copy is complete.

    Args:
        source: The tensor on the device.
        target: The contiguous tensor in host memory, page-locked where the source lies on a GPU.
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
    """Return one stream per device: copies of several episodes queue in it one by one, beside the model."""
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


FEWEST_FOR_THREADS = 10_000_000
"""The parameters below which a second thread costs more than it brings: ten times the time on a busy machine."""

RolesByStream = Mapping[str, "Sequence[Roles]"]


class Capturer:
    """The capture of one inference of several episodes, whose activations go into the buffers of each.

    Attributes:
        fires: The counts of the last capture.
        check: The hashes of the first outputs with and without hooks.

    Args:
        model: The model whose sites are captured.
        streams: The storage of the streams.
        with_tokens: Whether every token is stored.
        outputs: The name of what an inference returns, in a word.
        most_bytes: The largest size of what waits on the device to be pooled, see `capture_views`.
    """

    def __init__(
        self,
        model: "Model",
        streams: Sequence[StoredStream],
        with_tokens: bool,
        outputs: str,
        most_bytes: int | None = None,
    ) -> None:
        self._model, self._streams, self._with_tokens, self._outputs = model, streams, with_tokens, outputs
        self._most_bytes = most_bytes
        self.fires: dict[str, int] = {}
        self.check: dict[str, Any] = {}

    def run[Result](
        self,
        infer: Callable[[], Result],
        output_of: Callable[[Result], NDArray[np.float32]],
        roles: RolesByStream,
        buffers: "Mapping[int, EpisodeBuffers]",
        around: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> Result:
        """Return the result of `infer`, whose activations are kept for the rows that have buffers.

        Args:
            infer: A function that makes the inference.
            output_of: A function that returns the numbers that a capture must not change.
            roles: Per stream, the roles of every row of the batch.
            buffers: The buffers by row of the batch; rows without buffers are not captured.
            around: A context manager that changes the model at every inference, such as edits.

        Raises:
            CaptureChangedActionError: If the first capture of this process changes a number of the output.
            CaptureError: If a capture cannot be started.
        """
        from probe_kit.hooks.capturing.capture_context import capture_views
        from probe_kit.hooks.contract.roles import pool_weights

        # Before the model runs: a copy to a GPU inside a hook would stall it.
        weights = {
            stream.name: pool_weights(roles[stream.name], stream.views, self._model.card.device)
            for stream in self._streams
        }
        # The capture is entered last, so that it reads what edits left.
        capturing = capture_views(self._model, self._model.sites(), weights, self._with_tokens, self._most_bytes)
        with around(), capturing as captured:
            result = infer()
        if not self.fires:
            self._prove_harmless(infer, output_of, output_of(result), around)
        self.fires = captured.views.fires
        for row, episode_buffers in buffers.items():
            episode_buffers.keep_roles({name: rows[row] for name, rows in roles.items()})
        for stored in self._streams:
            self._keep(captured, stored, roles[stored.name], buffers)
        return result

    def _prove_harmless[Result](
        self,
        infer: Callable[[], Result],
        output_of: Callable[[Result], NDArray[np.float32]],
        captured: NDArray[np.float32],
        around: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Check once per process that the same inference without hooks gives the same outputs, bit for bit."""

        def without_hooks() -> NDArray[np.float32]:
            with around():
                return output_of(infer())

        def with_hooks() -> NDArray[np.float32]:
            from probe_kit.hooks import capture

            # Hooks that keep nothing: the explanation is about hooks, not about memory.
            with around(), capture(self._model, self._model.sites(), lambda _, activation: activation[:0].clone()):
                return output_of(infer())

        plain = without_hooks()
        name = self._outputs
        self.check = {
            f"{name}_with_hooks_sha256": _sha256(captured),
            f"{name}_without_hooks_sha256": _sha256(plain),
            "observations": len(captured),
        }
        if _sha256(captured) != _sha256(plain):
            from probe_kit.hooks.capturing.capture_context import reason_of_change

            raise CaptureChangedActionError(
                f"capturing changed the {name} by up to {np.abs(plain - captured).max():.3g}; they must be equal "
                f"bit for bit. {reason_of_change(without_hooks, plain, with_hooks)}"
            )

    def _keep(
        self,
        captured: "CapturedViews",
        stored: StoredStream,
        roles: "Sequence[Roles]",
        buffers: "Mapping[int, EpisodeBuffers]",
    ) -> None:
        """Hand one stream's share of a capture to the buffers of the episodes."""
        import torch

        sites = stored.stream.sites()
        views = captured.views.block(sites)
        tokens = captured.tokens.block(sites) if self._with_tokens else None
        for row, episode_buffers in buffers.items():
            if tokens is not None:
                valid = torch.from_numpy(roles[row].valid).to(tokens.device)
                # Padding means nothing, and zeros compress well. NaN stays NaN there; readers go by the mask.
                bits = (tokens[:, row] * valid[:, None]).to(torch.bfloat16).view(torch.int16)
                episode_buffers.keep_tokens(stored.name, bits.view(*stored.lead, *bits.shape[1:]))
            episode_buffers.keep_pooled(stored.name, views[:, row])


def stored_streams(
    model: "Model", roles: RolesByStream, role_names: Mapping[str, Sequence[str]] | None = None
) -> list[StoredStream]:
    """Return the storage of a model's streams at the longest of these sequences, with a view per role.

    Args:
        model: The model whose streams are stored.
        roles: Per stream, the roles of every sequence.
        role_names: Per stream, the roles that get a view; None for all that the model declares.
    """
    names = model.role_names if role_names is None else role_names
    return [
        StoredStream.of(stream, max(len(row) for row in roles[name]), view_names(names[name]))
        for name, stream in model.streams.items()
    ]


def _sha256(outputs: NDArray[np.float32]) -> str:
    """Hash shape, type and every bit."""
    return sha256(
        f"{outputs.dtype} {outputs.shape}".encode() + np.ascontiguousarray(outputs).tobytes()
    ).hexdigest()
