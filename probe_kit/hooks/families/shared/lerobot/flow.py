"""Base adapter of lerobot's flow-matching policies: noise, the prompt's keys and values, gradients, taps."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.capturing.gradients import frozen
from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site, kv_stream
from probe_kit.hooks.families.shared.capabilities import FLOW
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy, checked_steps
from probe_kit.hooks.families.shared.prompt_kv import attach_prompt_kv, kv_tap


class LerobotFlow(LerobotPolicy):
    """A lerobot flow-matching policy behind the Policy contract."""

    interventions = FLOW
    draws_noise = True
    acting_stream = "expert"

    def __init__(self, network: Any, folder: Path) -> None:
        super().__init__(network, folder)
        checked_steps(self.iterations, folder)
        self._kept = attach_prompt_kv(self._joint, len(self.stacks["backbone"].layers))
        self.prompt_kv = kv_stream(len(self._kept.keys), self._kv_width)

    @property
    @abstractmethod
    def _joint(self) -> Any:
        """lerobot's module of backbone and expert, whose first pass reads the prompt."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """Flow-matching steps per inference."""

    @property
    def _kv_width(self) -> int:
        """Heads times size of a head of the backbone's keys."""
        projection: Any = self.stacks["backbone"].layers[0]
        return int(projection.self_attn.k_proj.out_features)

    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """The end of the flow from the noise of the seeds."""
        chunk: NDArray[np.float32] = self.infer(batch, self.noise(seeds)).float().cpu().numpy()
        return chunk

    def differentiable(self, seen: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        """The actions of `act`, bit for bit, with a graph of the whole flow; see the contract."""
        self.check_acting(seen, seeds)
        batch, noise = self.batch(seen), self.noise(seeds)
        with frozen(self.network), _with_graph(self.network.model):
            chunk: Tensor = undecorated(self.network.predict_action_chunk)(batch, noise=noise)
            return self.restored(chunk)

    def infer(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        """(B, chunk, D) normalised actions for a batch in lerobot's keys.

        noise: (B, chunk, max_action_dim) float32.
        Raises ObservationError as `check_pictures` does.
        """
        self.check_pictures(batch)
        with torch.inference_mode():
            chunk: Tensor = self.network.predict_action_chunk(batch, noise=noise)
        return chunk

    def noise(self, seeds: Sequence[int]) -> Tensor:
        """(B, chunk, max_action_dim) float32 flow noise, a row per seed, the same on every device."""
        return seeded_noise(seeds, (self.config.chunk_size, self.config.max_action_dim), self.config.device)

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the stack's final norm, or a block's output.

        Keys and values pass once the prompt is read; every iteration then begins with a copy of it.
        """
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self._kept, site)
        return self.stacks[site.stream].tap(site)


def seeded_noise(seeds: Sequence[int], shape: tuple[int, int], device: str) -> Tensor:
    """(B, *shape) float32 standard normal, a row per seed, the same on every device."""
    rows = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    return torch.stack(rows).to(device)


def undecorated(method: Callable[..., Any]) -> Callable[..., Any]:
    """A bound method without the decorator that turns gradients off; itself if it has none."""
    inner = getattr(getattr(method, "__func__", method), "__wrapped__", None)
    return method if inner is None else partial(inner, getattr(method, "__self__", None))


@contextmanager
def _with_graph(model: Any) -> Iterator[None]:
    """lerobot's sampling of a flow, without the decorator of its own."""
    model.sample_actions = undecorated(model.sample_actions)
    try:
        yield
    finally:
        del model.sample_actions
