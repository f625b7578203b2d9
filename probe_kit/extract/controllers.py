"""Who drives an episode: a captured policy, or the scripted expert that knows the answer."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureChangedActionError
from probe_kit.extract.layout import StoredStream
from probe_kit.identity import derive_seed
from probe_kit.suite import Episode

if TYPE_CHECKING:
    from probe_kit.env import Act2AnswerEnv
    from probe_kit.hooks import Observation, Policy, Roles, Tape

SCRIPTED = {
    "expert": "scripted: knows the answer and puts the cube on it; proves environment and scoring",
    "expert-mirrored": "scripted: knows the answer and puts the cube on the other picture",
}


# Below this many parameters a second thread costs more than it brings: ten times the time on a busy machine.
SMALL = 10_000_000


@dataclass(frozen=True)
class StreamCapture:
    """One stream at one inference of one episode.

    pooled: (*lead, V, D) float32. tokens: (*lead, T, D) uint16 bits of bfloat16, padding zero, or None.
    """

    pooled: NDArray[np.float32]
    tokens: NDArray[np.uint16] | None
    roles: "Roles"


Capture = dict[str, StreamCapture]


class Controller(Protocol):
    """Drives episodes one after the other; `threads` is what its network wants, None for torch's choice."""

    identity: dict[str, Any]
    streams: list[StoredStream]
    captured: list[Capture]
    threads: int | None

    def begin(self, env: "Act2AnswerEnv", episode: Episode, seed: int) -> None:
        """Forget the last episode; `env` has been reset to the new one."""

    def next_actions(self) -> NDArray[np.float32]:
        """The next (n, 7) float32 actions to execute, n >= 1."""

    def certificate(self) -> dict[str, Any]:
        """What was checked so far, for the run's certificate."""


class ScriptedController:
    """The scripted expert; it looks at nothing and leaves no activations."""

    def __init__(self, name: str) -> None:
        self.mirrored = name == "expert-mirrored"
        self.identity: dict[str, Any] = {"model": name, "random_weights": False, "weights_sha256": None}
        self.streams: list[StoredStream] = []
        self.threads: int | None = None
        self.captured: list[Capture] = []

    def begin(self, env: "Act2AnswerEnv", episode: Episode, seed: int) -> None:  # noqa: ARG002
        """Plan the way-points of this episode."""
        from probe_kit.env import ScriptedExpert

        self._expert = ScriptedExpert(env, mirrored=self.mirrored)
        self._expert.reset()

    def next_actions(self) -> NDArray[np.float32]:
        """One action towards the next way-point."""
        return self._expert.act()[None]

    def certificate(self) -> dict[str, Any]:
        """Nothing was loaded."""
        return {"policy": self.identity}


class PolicyController:
    """Looks, infers, executes the head of the chunk, and captures the first inferences of every episode."""

    def __init__(
        self, policy: "Policy", name: str, instructions: Sequence[str], execute: int | None, captured_calls: int,
        with_tokens: bool,
    ) -> None:  # fmt: skip
        self.policy = policy
        self.execute = execute or policy.card.execute
        self.captured_calls, self.with_tokens = captured_calls, with_tokens
        self.streams = _stored_streams(policy, instructions)
        card = policy.card
        self.threads = 1 if card.parameters < SMALL else None
        self.identity: dict[str, Any] = {
            "model": name,
            "random_weights": card.random_weights,
            "weights_sha256": card.weights_sha256,
            "dtype": card.dtype,
            "execute": self.execute,
        }
        self.captured: list[Capture] = []
        self._fires: dict[str, int] = {}

    def begin(self, env: "Act2AnswerEnv", episode: Episode, seed: int) -> None:
        """Start counting inferences anew."""
        self._env, self._instruction, self._seed = env, episode.item.instruction, seed
        self._calls, self.captured = 0, []

    def next_actions(self) -> NDArray[np.float32]:
        """The first `execute` actions of a fresh chunk."""
        observation = self._look()
        seed = derive_seed(self._seed, "inference", self._calls)
        if self._calls < self.captured_calls:
            chunk = self._act_and_capture(observation, seed)
        else:
            chunk = self.policy.act([observation], [seed])
        self._calls += 1
        return chunk[0, : self.execute]

    def certificate(self) -> dict[str, Any]:
        """The policy's card, fire counts of the last capture, and the check of `_act_and_capture`."""
        return {
            "policy": asdict(self.policy.card),
            "fires_per_inference": self._fires,
            "hooks_on_equals_hooks_off": True,
        }

    def _look(self) -> "Observation":
        from probe_kit.hooks import Observation

        seen = self._env.observe()
        return Observation(seen["pixels"]["image"], seen["agent_pos"], self._instruction)

    def _act_and_capture(self, observation: "Observation", seed: int) -> NDArray[np.float32]:
        from probe_kit.hooks import capture

        with capture(self.policy, self.policy.sites()) as tape:
            chunk = self.policy.act([observation], [seed])
        if not self._fires:
            self._prove_harmless(observation, seed, chunk)
        self._fires = tape.fires
        roles = self.policy.roles([observation])
        self.captured.append({s.name: self._pack(tape, s, roles[s.name][0]) for s in self.streams})
        return chunk

    def _prove_harmless(self, observation: "Observation", seed: int, chunk: NDArray[np.float32]) -> None:
        """Once per process: the same inference without hooks gives the same actions, bit for bit."""
        plain = self.policy.act([observation], [seed])
        if not np.array_equal(plain, chunk):
            raise CaptureChangedActionError(
                f"capturing changed the actions by up to {np.abs(plain - chunk).max():.3g}; they must be equal "
                "bit for bit. The adapter keeps state between calls, or its model is not deterministic"
            )

    def _pack(self, tape: "Tape", stored: StoredStream, roles: "Roles") -> StreamCapture:
        import torch

        from probe_kit.hooks import pool

        layers = torch.stack([tape[site][0] for site in stored.stream.sites()])
        layers = layers.reshape(*stored.lead, *layers.shape[1:])
        pooled = pool(layers, roles, stored.views).cpu().numpy()
        tokens = None
        if self.with_tokens:
            valid = torch.from_numpy(roles.valid).to(layers.device)
            bits = (layers * valid[:, None]).to(torch.bfloat16).view(torch.int16)
            tokens = bits.cpu().numpy().view(np.uint16)
        return StreamCapture(pooled, tokens, roles)


def _stored_streams(policy: "Policy", instructions: Sequence[str]) -> list[StoredStream]:
    """The streams at the longest sequence any of the instructions makes."""
    from probe_kit.hooks import Observation
    from probe_kit.hooks.roles import view_names

    blank = np.zeros((8, 8, 3), np.uint8)
    roles = policy.roles([Observation(blank, np.zeros(8, np.float32), text) for text in instructions])
    return [
        StoredStream(
            name=name,
            layers=stream.layers,
            width=stream.width,
            iterations=stream.iterations,
            tokens=max(len(row) for row in roles[name]),
            views=view_names(policy.role_names[name]),
        )
        for name, stream in policy.streams.items()
    ]
