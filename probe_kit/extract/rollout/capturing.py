"""Capture of one inference for the store, with a one-time proof that capture changes no action."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError
from probe_kit.hooks.contract.sites import view_names
from probe_kit.runs.layout import StoredStream

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.extract.rollout.episode_buffers import EpisodeBuffers
    from probe_kit.hooks import ActivationCache, Model, Roles, Site

SMALL = 10_000_000
"""Parameters below which a second thread costs more than it brings: ten times the time on a busy machine."""

RolesByStream = Mapping[str, "Sequence[Roles]"]


class Capturer:
    """Hands the activations of an inference to the buffers of its episodes.

    streams: what is stored. outputs: what comes out of an inference, in a word. fires: counts of the last capture.
    check: hashes of the first outputs with and without hooks.
    """

    def __init__(self, model: "Model", streams: Sequence[StoredStream], with_tokens: bool, outputs: str) -> None:
        self._model, self._streams, self._with_tokens, self._outputs = model, streams, with_tokens, outputs
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

        output_of: the numbers that a capture must not change. around: what is done to the model at every
        inference. Raises CaptureChangedActionError as `_prove_harmless` does, and what `capture` raises.
        """
        from probe_kit.hooks import capture
        from probe_kit.hooks.contract.roles import prepare_pool

        views = {stream.name: stream.views for stream in self._streams}
        # Before the model runs: a copy to a GPU inside a hook would stall it.
        for name, own_views in views.items():
            prepare_pool(roles[name], own_views, self._model.card.device)

        def pool_rows(site: "Site", activation: "Tensor") -> "Tensor":
            return _pool_rows(activation, roles[site.stream], views[site.stream])

        # Pooled at once, so that the device never holds all tokens of all sites; with --tokens all it has to.
        reduce = None if self._with_tokens else pool_rows
        # The capture is entered last, so that it reads what edits left.
        with around(), capture(self._model, self._model.sites(), reduce) as tape:
            result = infer()
        if not self.fires:
            self._prove_harmless(infer, output_of, output_of(result), around)
        self.fires = tape.fires
        for row, episode_buffers in buffers.items():
            self._keep(tape, row, {name: rows[row] for name, rows in roles.items()}, episode_buffers)
        return result

    def _prove_harmless[Result](
        self,
        infer: Callable[[], Result],
        output_of: Callable[[Result], NDArray[np.float32]],
        captured: NDArray[np.float32],
        around: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Once per process: the same inference without hooks gives the same outputs, bit for bit."""

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
        self, tape: "ActivationCache", row: int, roles: "dict[str, Roles]", buffers: "EpisodeBuffers"
    ) -> None:
        """Hand one episode's share of a capture to its buffers."""
        import torch

        buffers.keep_roles(roles)
        for stored in self._streams:
            stream_roles = roles[stored.name]
            values = torch.stack([tape[site][row] for site in stored.stream.sites()])
            if self._with_tokens:
                valid = torch.from_numpy(stream_roles.valid).to(values.device)
                # Padding means nothing, and zeros compress well. NaN stays NaN there; readers go by the mask.
                bits = (values * valid[:, None]).to(torch.bfloat16).view(torch.int16)
                buffers.keep_tokens(stored.name, bits.reshape(*stored.lead, *bits.shape[1:]))
                values = torch.stack([_pool_rows(site[None], [stream_roles], stored.views)[0] for site in values])
            buffers.keep_pooled(stored.name, values)


def stored_streams(
    model: "Model", roles: RolesByStream, role_names: Mapping[str, Sequence[str]] | None = None
) -> list[StoredStream]:
    """The streams of a model at the longest of these sequences, with a view per role.

    role_names: per stream, those that are viewed; by default all that the model declares.
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


def _pool_rows(activation: "Tensor", roles: "Sequence[Roles]", views: Sequence[str]) -> "Tensor":
    """(B, V, D) float32 from (B, T, D), on its device."""
    import torch

    from probe_kit.hooks import pool

    return torch.stack(
        [pool(tokens, row_roles, views) for tokens, row_roles in zip(activation, roles, strict=True)]
    )
