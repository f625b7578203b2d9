"""Controllers of an episode: a captured policy, or a scripted one that needs no model."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.robot.controller import ACTION_SIZE
from probe_kit.errors import PolicyFailedError, ProbeKitError
from probe_kit.extract.rollout.capturing import SMALL, Capturer, stored_streams
from probe_kit.extract.rollout.executed_actions import executed_actions
from probe_kit.hashing import derive_seed
from probe_kit.hooks.capturing.edits import Edit, Vectors
from probe_kit.hooks.checkpoints.containment import begin_randomness, copied
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.protocol import PLAIN, Rotation
from probe_kit.runs.layout import StoredStream

if TYPE_CHECKING:
    from probe_kit.extract.rollout.episode_buffers import EpisodeBuffers
    from probe_kit.hooks import Policy

SCRIPTED = {
    "expert": "scripted: knows the answer and puts the cube on it; proves environment and scoring",
    "expert-mirrored": "scripted: knows the answer and puts the cube on the other picture",
    "idle": "scripted: does nothing; what a rule gives it is owed to no answer",
}


def count_lost_words(pack: Callable[[str], Sequence[int] | None], instruction: str) -> int:
    """How many words at the end of an instruction do not reach the network, because its prompt is cut.

    pack: the ids that the network is delivered, None if unknown. A word is lost if they stay the same without it.
    """
    whole, words = pack(instruction), instruction.split()
    lost = 0
    try:
        while whole is not None and lost + 1 < len(words) and pack(" ".join(words[: -lost - 1])) == whole:
            lost += 1
    except ProbeKitError:  # a shorter text is no instruction of the model
        return lost
    if lost:
        warnings.warn(
            "the model's prompt is cut: the last words of an instruction do not reach its network; the column "
            "lost_words of the run's episodes counts them. Use shorter instructions, or an adapter that refuses "
            "long ones",
            stacklevel=2,
        )
    return lost


@dataclass(frozen=True)
class Turn:
    """One inference that is due.

    seed: of the episode; every inference derives its own. call: how many inferences came before.
    buffers: where the activations of the first calls go. past: chunks of the inferences before, oldest first,
    which the controller keeps where a policy averages them. noise: the number that its seed is derived from, None
    for `call`.
    """

    seen: Observation
    seed: int
    call: int
    buffers: "EpisodeBuffers"
    past: list[NDArray[np.float32]] = field(default_factory=list)
    noise: int | None = None

    def derived_seed(self, of: str) -> int:
        """The seed of this inference for `of`."""
        return derive_seed(self.seed, of, self.call if self.noise is None else self.noise)


class Controller(Protocol):
    """Decides what happens on every stage: by acting, or by answering a question.

    script: for `Stage`, None if this controller acts itself.
    threads: what its network wants, None for torch's choice. on_gpu: whether activations come from a GPU.
    """

    identity: dict[str, Any]
    streams: list[StoredStream]
    script: str | None
    threads: int | None
    on_gpu: bool

    def certificate(self) -> dict[str, Any]:
        """What was checked so far, for the run's certificate."""


class ActingController(Controller, Protocol):
    """Acts.

    flagged: of the last `act`, the turns whose inference put out no action; None if that is unknown.
    capture_only: whether `act` only captures, and the episode ends after it.
    """

    capture_only: bool
    flagged: NDArray[np.bool_] | None

    def act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        """Per turn the next (n, 7) float32 actions to execute, n >= 1."""

    def instruction_ids(self, instruction: str) -> tuple[int, ...] | None:
        """What the network is delivered as this instruction; None if it reads none or cannot say."""


class ScriptedController:
    """A script plays on the stage itself, looks at nothing and leaves no activations."""

    def __init__(self, name: str) -> None:
        self.identity: dict[str, Any] = {"model": name, "random_weights": False, "weights_sha256": None}
        self.streams: list[StoredStream] = []
        self.script: str | None = name
        self.threads: int | None = None
        self.on_gpu = self.capture_only = False
        self.flagged: NDArray[np.bool_] | None = None

    def act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        """Never asked: a scripted stage plays to the end by itself."""
        raise AssertionError(f"a scripted stage asked for {len(turns)} actions")

    def instruction_ids(self, instruction: str) -> None:
        """None: it reads no instruction."""

    def certificate(self) -> dict[str, Any]:
        """Nothing was loaded."""
        return {"policy": self.identity}


class PolicyController:
    """Infers, executes the head of the chunk, and captures the first inferences of every episode.

    With `capture_only`, it infers and captures once per episode and executes nothing.
    """

    def __init__(
        self,
        policy: "Policy",
        name: str,
        examples: Sequence[Observation],
        execute: int | None,
        captured_calls: int,
        with_tokens: bool,
        edits: Sequence[Edit] = (),
        vectors: Vectors | None = None,
        capture_only: bool = False,
        limit: float | None = None,
        rotation: Rotation | None = None,
    ) -> None:
        """examples: an observation per instruction of the suite, as the scene will show them.

        limit: seconds that a call of the policy may take, after which this process ends. rotation: see
        `ProtocolRow.rotation`; None for the angles as they are.
        """
        self.policy, self.capture_only, self._limit = policy, capture_only, limit
        self._infer = policy.infer_without_acting if capture_only else policy.act
        self.execute = execute or policy.card.execute
        self.rotation: Rotation = rotation or PLAIN
        self.captured_calls = captured_calls
        self._edits, self._vectors = edits, vectors
        with while_acting(name, policy.card.checkpoint):
            self.streams = stored_streams(policy, policy.roles(examples))
        self._capturer = Capturer(policy, self.streams, with_tokens, "actions")
        card = policy.card
        self.script: str | None = None
        self.threads = 1 if card.parameters < SMALL else None
        self.on_gpu = card.device.startswith("cuda")
        self.flagged: NDArray[np.bool_] | None = None
        self.identity: dict[str, Any] = {
            "model": name,
            "random_weights": card.random_weights,
            "weights_sha256": card.weights_sha256,
            "dtype": card.dtype,
            "execute": self.execute,
        }
        if card.settings:
            self.identity["policy"] = dict(card.settings)
        if capture_only and (deaf := policy.zero_filled_inputs()):
            self.identity["zeros_for"] = list(deaf)
        self._instruction_ids: dict[str, tuple[int, ...] | None] = {}
        self._edit_log: list[dict[str, Any]] = []

    def act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        """Per turn the first `execute` actions of a fresh chunk, from one call of the policy.

        Where the policy's card asks for it, one action averaged over the plans of this and earlier chunks.
        """
        with self._acting():
            begin_randomness(derive_seed("global", *(turn.derived_seed("call") for turn in turns)))
            return self._act(turns)

    def _acting(self) -> AbstractContextManager[None]:
        return while_acting(self.identity["model"], self.policy.card.checkpoint, self._limit)

    def _act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        observations = copied([turn.seen for turn in turns])
        seeds = [turn.derived_seed("inference") for turn in turns]
        captured = {row: turn.buffers for row, turn in enumerate(turns) if turn.call < self.captured_calls}
        if captured:
            chunks = self._capturer.run(
                lambda: self._chunks(turns, seeds),
                lambda actions: actions,
                self.policy.roles(observations),
                captured,
                lambda: self._edited(observations),
            )
        else:
            with self._edited(observations):
                chunks = self._chunks(turns, seeds)
        self.flagged = _own_flags(self.policy.flagged, len(turns))
        return [self._executed(turn, chunk) for turn, chunk in zip(turns, chunks, strict=True)]

    def _chunks(self, turns: Sequence[Turn], seeds: Sequence[int]) -> NDArray[np.float32]:
        """What the policy gives for observations that it may write to, and cannot change later."""
        chunks = self._infer(copied([turn.seen for turn in turns]), list(seeds))
        if not self.capture_only:
            _check_chunks(chunks, len(turns))
        return np.array(chunks)

    def run_preflight(self, observations: Sequence[Observation], seeds: Sequence[int]) -> None:
        """One inference of which nothing is kept: what another one will take."""
        with self._acting():
            self._infer(copied(observations), list(seeds))

    def instruction_ids(self, instruction: str) -> tuple[int, ...] | None:
        """The ids that the policy's own packing makes of it, frames around it included."""
        if instruction not in self._instruction_ids:
            with self._acting():
                ids = self.policy.token_ids([instruction])
                self._instruction_ids[instruction] = None if ids is None else tuple(map(int, ids[0]))
        return self._instruction_ids[instruction]

    def _executed(self, turn: Turn, chunk: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.capture_only:
            return chunk[: self.execute]
        exponent = self.policy.card.ensemble
        chunks = [chunk]
        if exponent is not None:
            turn.past.append(chunk)
            chunks = turn.past
        return executed_actions(chunks, self.execute, exponent, self.rotation)

    def certificate(self) -> dict[str, Any]:
        """The policy's card, fire counts of the last capture, and what the capture proved."""
        return {
            "policy": self.policy.card.to_json(),
            **({} if self.capture_only else {"rotation": self.rotation}),
            "fires_per_inference": self._capturer.fires,
            "capture_check": self._capturer.check,
            **({"edits": self._edit_log} if self._edits else {}),
        }

    @contextmanager
    def _edited(self, observations: Sequence[Observation]) -> Iterator[None]:
        """The edits of this run, for one inference; the certificate shows what the last one did."""
        if not self._edits:
            yield
            return
        from probe_kit.hooks import apply_edits

        with apply_edits(self.policy, self._edits, observations, self._vectors) as edit_log:
            yield
        self._edit_log = [asdict(entry) for entry in edit_log.entries]


def _check_chunks(chunks: NDArray[np.float32], count: int) -> None:
    """Raise PolicyFailedError unless these are chunks of actions for so many observations.

    Actions that are NaN cost their own episode only, so the environment is left to say that.
    """
    given = chunks if isinstance(chunks, np.ndarray) else None
    shape = () if given is None else given.shape
    fits = len(shape) == 3 and shape[0] == count and shape[1] >= 1 and shape[2] == ACTION_SIZE
    if given is None or not fits or given.dtype != np.float32:
        seen = type(chunks).__name__ if given is None else f"ndarray of shape {shape} and {given.dtype}"
        raise PolicyFailedError(
            f"the policy gave a {seen} for {count} observations; expected a numpy array "
            f"({count}, chunk, {ACTION_SIZE}) of float32 actions"
        )


def _own_flags(flagged: object, count: int) -> NDArray[np.bool_] | None:
    """(count,): a copy of what a policy flags in its last call. Raises PolicyFailedError for anything else."""
    if flagged is None:
        return None
    if not isinstance(flagged, np.ndarray) or flagged.shape != (count,) or flagged.dtype != np.bool_:
        raise PolicyFailedError(
            f"the policy's `flagged` is {str(flagged)[:80]!r} for {count} observations; expected a bool array "
            f"({count},), or None"
        )
    return flagged.copy()
