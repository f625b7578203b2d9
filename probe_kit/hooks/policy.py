"""The contract every model family fulfils."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import nn

from probe_kit.hooks.roles import Roles
from probe_kit.hooks.sites import Site, Stream


@dataclass(frozen=True)
class Observation:
    """What the policy sees at one moment.

    image: (H, W, 3) uint8, the third-person camera.
    state: (8,) float32: TCP x, y, z in metres in the robot base frame, roll, pitch, yaw in radians relative
    to the gripper pointing down, 0, gripper openness in [0, 1].
    """

    image: NDArray[np.uint8]
    state: NDArray[np.float32]
    instruction: str


@dataclass(frozen=True)
class PolicyCard:
    """What was really loaded: enough to say whose numbers these are.

    settings: what else the actions and activations depend on, such as the prompt; part of a run's identity.
    exact: False if the weights that ran are only near those of the file, as after quantisation.
    """

    family: str
    checkpoint: str
    weights_sha256: str
    random_weights: bool
    parameters: int
    dtype: str
    device: str
    embodiment: str
    cameras: tuple[str, ...]
    chunk: int
    execute: int
    notes: tuple[str, ...] = ()
    audit: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    exact: bool = True


@dataclass(frozen=True)
class Tap:
    """Where a site is read and written: the first input or output of `module`, called `fires` times per inference.

    tokens: the positions of that (B, T, D) tensor which belong to the site, where one call serves two streams.

    The residual stream is read at inputs, not outputs: some families drive their layers piecewise or add in
    place, and then a layer's output is never seen or seen too late. The first submodule of a block is always
    called with the residual stream itself, so writing into that tensor writes the stream.
    """

    module: nn.Module
    fires: int
    end: Literal["input", "output"] = "input"
    tokens: slice = slice(None)


class Policy(ABC):
    """A model that turns observations and an instruction into actions, and can be listened to.

    Deterministic for given seeds. Capturing changes no action, bit for bit.
    """

    card: PolicyCard
    streams: Mapping[str, Stream]
    role_names: Mapping[str, tuple[str, ...]]

    @abstractmethod
    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """One chunk of actions per observation.

        Returns (B, chunk, 7) float32: xyz delta in metres and roll-pitch-yaw delta in radians in the robot
        base frame, gripper 1 = open and 0 = closed, at 5 Hz. All randomness of a row comes from its seed.
        Raises InstructionError or ObservationError for what the policy cannot take in whole.
        """

    @abstractmethod
    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Per stream, the roles of every token position of every row, from the model's own packing."""

    @abstractmethod
    def tap(self, site: Site) -> Tap:
        """Where `site` is read and written. Raises UnknownSiteError."""

    def sites(self, quantity: str = "residual") -> list[Site]:
        """All sites of one quantity, stream by stream."""
        return [site for stream in self.streams.values() for site in stream.sites(quantity)]
