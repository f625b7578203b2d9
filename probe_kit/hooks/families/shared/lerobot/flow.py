"""Base adapter of lerobot's flow-matching policies: noise, the prompt's keys and values, gradients, taps."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.capturing.gradients import frozen
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site, kv_stream
from probe_kit.hooks.families.shared.kinds import FLOW
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy, checked_steps
from probe_kit.hooks.families.shared.prompt_kv import attach_prompt_kv
from probe_kit.hooks.families.shared.sampling import seeded_noise
from probe_kit.hooks.verification.outputs import Arrays, Produce, RecordedRun, euler_path, numpy_of


class DenoisingPolicy(LerobotPolicy):
    """A lerobot policy that makes its chunk of actions from noise, in steps."""

    draws_noise = True
    acting_stream = "expert"

    @abstractmethod
    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """(B, chunk, D) normalised actions for a batch in lerobot's keys, with a graph where gradients are on.

        noise: (B, *noise_shape) float32.
        """

    @property
    def noise_shape(self) -> tuple[int, int]:
        """The shape of one row's noise: actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.config.max_action_dim

    def infer(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """(B, chunk, D) normalised actions, as `denoise` makes them, without a graph."""
        with torch.inference_mode():
            return self.denoise(batch, noise)

    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """The actions from the noise of the seeds."""
        chunk: NDArray[np.float32] = self.infer(batch, self.noise(seeds)).float().cpu().numpy()
        return chunk

    def differentiable(self, observations: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        """The actions of `act`, bit for bit, with a graph of every step; see the contract."""
        self.interventions.check("gradients", self.card.family)
        self.check_acting(observations, seeds)
        with frozen(self.network):
            return self.restored(self.denoise(self.batch(observations), self.noise(seeds)))

    def noise(self, seeds: Sequence[int]) -> Tensor:
        """(B, *noise_shape) float32 noise, a row per seed, the same on every device."""
        return seeded_noise(seeds, self.noise_shape, self.config.device)

    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """Return the actions from the recorded noise."""
        return {"actions": numpy_of(self.infer(batch, torch.from_numpy(recorded["in_noise"])))}


class LerobotFlow(DenoisingPolicy):
    """A lerobot flow-matching policy behind the Policy contract."""

    interventions = FLOW

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        checked_steps(self.iterations, folder)
        # Before the streams are asked for: `prompt_kv` is one of them from now on.
        self.passages = attach_prompt_kv(self._joint, len(self.stacks["backbone"].layers))
        self.prompt_kv = kv_stream(len(self.passages.keys), self._kv_width)

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

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """See the base. Raises ObservationError as `check_pictures` does."""
        self.check_pictures(batch)
        with _with_graph(self.network.model):
            chunk: Tensor = undecorated(self.network.predict_action_chunk)(batch, noise=noise)
        return chunk

    # -- verification ------------------------------------------------------------------------------------

    def watched(self) -> dict[str, nn.Module]:
        """The velocity, and the connector of a backbone that has one."""
        model = self.network.model
        connected = hasattr(model, "vlm_with_expert")
        connector = {"connector_out": model.vlm_with_expert.vlm.model.connector} if connected else {}
        return {"velocity": model.action_out_proj, **connector}

    def watched_inputs(self) -> dict[str, nn.Module]:
        """The first block of the backbone, for its position ids."""
        return {"backbone": self.stacks["backbone"].layers[0]}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Prepared inputs, and the path of the flow: Euler steps x ← x - v/S from the network's velocities."""
        steps, noise = self.iterations, torch.from_numpy(run.recorded["in_noise"])
        prepare = getattr(self.network, "_preprocess_images", None) or self.network.prepare_images

        def images(part: int) -> NDArray[Any]:
            return numpy_of(torch.stack(prepare(run.batch)[part]))

        def path() -> NDArray[Any]:
            return euler_path(noise, run.calls["velocity"], lambda velocity: -velocity / steps)

        produced: dict[str, Produce] = {
            "prefix_embs": lambda: numpy_of(run.tape[Site("backbone", 0)]),
            "prefix_pad": lambda: self.recorded_padding(run.recorded),
            "prep_images": lambda: images(0),
            "prep_image_masks": lambda: images(1),
            "prep_state": lambda: numpy_of(self.network.prepare_state(run.batch)),
            "x_t": path,
            "actions_padded": lambda: np.asarray(path()[-1]),
            "denoise_times": lambda: np.array([1 - step / steps for step in range(steps)], np.float32),
        }
        if run.calls["backbone"]:  # lerobot calls some backbones past their blocks
            produced["prefix_position_ids"] = lambda: numpy_of(run.calls["backbone"][0][1]["position_ids"])
        return produced


def undecorated(method: Callable[..., Any]) -> Callable[..., Any]:
    """A bound method without the decorator that turns gradients off; itself if it has none."""
    inner = getattr(getattr(method, "__func__", method), "__wrapped__", None)
    return method if inner is None else partial(inner, getattr(method, "__self__", None))


@contextmanager
def _with_graph(model: Any) -> Iterator[None]:
    """lerobot's sampling of a flow, without the decorator of its own."""
    # An attribute of the instance hides the method of its class; `del` uncovers it again.
    model.sample_actions = undecorated(model.sample_actions)
    try:
        yield
    finally:
        del model.sample_actions
