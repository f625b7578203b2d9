"""Controllers decide the actions of an episode: a policy whose inferences are captured, or a script.

This file also has the conversion of predicted actions to executed ones, and the check of inputs before a run. The
check finds only inputs that change nothing. That a model uses an input cannot be shown by one inference;
`probe-kit diagnose` shows it.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.arm import ACTION_SIZE
from probe_kit.env.rotations import from_rpy, to_vector
from probe_kit.errors import IgnoredInputsError, InstructionError, PolicyFailedError, ProbeKitError
from probe_kit.extract.rollout.capturing import FEWEST_FOR_THREADS, Capturer, stored_streams
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.inputs import INSTRUCTION, PICTURE, blank_of, normal_form, same_input, with_input
from probe_kit.extract.sources.source import Source, check_predictions
from probe_kit.extract.states import count_calls
from probe_kit.hashing import derive_seed
from probe_kit.hooks.checkpoints.third_party import begin_randomness, copy_observations, while_acting
from probe_kit.hooks.contract.declared import PLAIN, Rotation
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import CONDITION, CONDITIONS, StoredStream
from probe_kit.runs.plan import Row
from probe_kit.runs.provenance import INPUT_CHECK

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.extract.rollout.capturing import EpisodeBuffers
    from probe_kit.extract.settings import Settings
    from probe_kit.hooks import Model, Policy, Site


Reach = Literal["output", "last layer", "nothing", "not the output", "not tested"]
"""The last thing on the way to the output that changed with an input.

`nothing`: neither the last layer nor the output changed. `not the output`: the output did not change, and no layer
was read. `not tested`: there was no other value of the input to show.
"""
MOST_TEXTS = 32
"""The most other instructions that are searched for one with as many tokens; each of them is tokenized."""
Ids = Callable[[str], tuple[int, ...] | None]


def check_inputs[Question](
    model: "Model",
    infer: Callable[[Question], NDArray[np.float32]],
    clean: Question,
    variants: Mapping[str, Iterable[Question]],
    last: "Site | None",
    around: Callable[[Question], AbstractContextManager[None]],
) -> dict[str, Reach]:
    """Return, by input, how far a change of it came.

    Args:
        model: The model whose last residual is captured.
        infer: A function that makes one inference, always with the same seed, and returns its output.
        clean: The unchanged observation or prompt.
        variants: Observations or prompts by input that differ from the clean one in it alone. The first that the
            model accepts is used; if it accepts none, the input is untested.
        last: The last residual before the output; None where no site may be captured.
        around: A context manager that changes the model at every inference as the run does.
    """
    if not variants:
        return {}

    def infer_as_run(question: Question) -> NDArray[np.float32]:
        with around(question):
            return infer(question)

    def residual(site: "Site", question: Question) -> "Tensor":
        from probe_kit.hooks import capture

        # The capture is entered last, so that it reads what edits left.
        with around(question), capture(model, [site]) as cache:
            infer(question)
        return cache[site]

    output = infer_as_run(clean)
    layer = None if last is None else partial(residual, last)
    return {name: _reach(infer_as_run, layer, clean, output, changed) for name, changed in variants.items()}


def _reach[Question](
    infer: Callable[[Question], NDArray[np.float32]],
    residual: "Callable[[Question], Tensor] | None",
    clean: Question,
    output: NDArray[np.float32],
    variants: Iterable[Question],
) -> Reach:
    for variant in variants:
        try:
            changed = infer(variant)
        except InstructionError:  # the model cannot take this one in; the next may do
            continue
        if not np.array_equal(changed, output, equal_nan=True):
            return "output"
        if residual is None:
            return "not the output"
        # Actions that are chosen among bins stay the same under small changes; the layer before them does not.
        return "nothing" if _same(residual(clean), residual(variant)) else "last layer"
    return "not tested"


def _same(first: "Tensor", second: "Tensor") -> bool:
    return first.shape == second.shape and bool((first == second).all())


def vary_observation(
    clean: Observation, texts: Iterable[str], ids: Ids, absent: Collection[str] = ()
) -> dict[str, Iterator[Observation]]:
    """Return, by input, observations that differ from a clean one in it alone, the best first.

    Args:
        clean: The unchanged observation.
        texts: Other instructions.
        ids: A function that returns the tokens of a text, None if they are unknown.
        absent: The inputs that the model lacks.
    """
    variants = {PICTURE: _without_picture(clean), INSTRUCTION: _with_other_words(clean, texts, ids)}
    return {name: observations for name, observations in variants.items() if name not in absent}


def _without_picture(clean: Observation) -> Iterator[Observation]:
    blank = with_input(clean, PICTURE, blank_of([clean]))
    # A picture of one colour is its own blank: then nothing would change, and no input could be called dead.
    if not same_input(clean, blank, PICTURE):
        yield blank


def _with_other_words(clean: Observation, texts: Iterable[str], ids: Ids) -> Iterator[Observation]:
    """Yield observations with other instructions, then with the words in reverse; those of as many tokens first.

    A model that reads no word still notices how many there are.
    """
    words = clean.instruction
    # Another spelling may be the same tokens: a model that reads every word would be called one that reads none.
    other_texts = (text for text in texts if normal_form(text) != normal_form(words))
    candidates = dict.fromkeys([*islice(other_texts, MOST_TEXTS), " ".join(reversed(words.split()))])
    candidates.pop(words, None)
    length = _length(words, ids)
    for text in sorted(candidates, key=lambda text: _length(text, ids) != length):
        yield replace(clean, instruction=text)


def _length(text: str, ids: Ids) -> int | None:
    try:
        tokens = ids(text)
    except InstructionError:
        return None
    return None if tokens is None else len(tokens)


def check_not_ignored(reaches: Mapping[str, Reach], model: str) -> None:
    """Raise IgnoredInputsError if inputs were tested and none of them changes anything that was read."""
    tested = [name for name, reach in reaches.items() if reach != "not tested"]
    # One dead input is a finding, which the certificate keeps; only where none arrives a run would be void. Where
    # a single input could be tested, the model may be one that is not made to read it.
    if len(tested) > 1 and all(reaches[name] in ("nothing", "not the output") for name in tested):
        layer = ", nor of its last layer" if "nothing" in reaches.values() else ""
        raise IgnoredInputsError(
            f"another {' and another '.join(tested)} changed no number of the first output of {model}{layer}; "
            "expected that at least one of them does. `probe-kit diagnose` takes the same settings and finds "
            "where the input is lost. To extract nevertheless, add --accept-ignored-inputs"
        )


# -- actions -----------------------------------------------------------------------------------------------------


_TURN = slice(3, 6)
"""The place of roll, pitch and yaw among the seven numbers of an action."""
_GRIPPER_OPEN = 0.5
"""The bound between a closed gripper, which is 0, and an open one, which is 1."""


def executed_actions(
    chunks: Sequence[NDArray[np.float32]], execute: int, exponent: float | None, rotation: Rotation = PLAIN
) -> NDArray[np.float32]:
    """Return the actions (n, 7) float32 that are executed after the newest chunk of an episode, oldest first.

    Args:
        chunks: (chunk, 7) of the episode's inferences so far, oldest first.
        execute: The number of actions from the head of the newest chunk.
        exponent: The exponent of `ensemble`, which makes one action of all chunks; None to execute the head.
        rotation: The form in which a rotation reaches the controller, see `ProtocolRow.rotation`.
    """
    actions = chunks[-1][:execute] if exponent is None else ensemble(chunks, exponent)[None]
    return actions if rotation == PLAIN else with_rotation_vectors(actions)


def with_rotation_vectors(actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a copy of actions (n, 7) with axis times angle, in radians, in place of roll, pitch and yaw.

    Axis and angle are those of R = Rz(yaw) Ry(pitch) Rx(roll), as `euler2axangle` of transforms3d gives them. The
    released evaluation converts so, and its controller reads the three numbers as Euler angles.
    """
    converted = actions.copy()
    converted[:, _TURN] = [to_vector(from_rpy(angles)) for angles in actions[:, _TURN].astype(np.float64)]
    return converted


def ensemble(chunks: Sequence[NDArray[np.float32]], exponent: float) -> NDArray[np.float32]:
    """Return the action (7,) float32 for this step, from the chunks (chunk, 7) of an episode, oldest first.

    There is an inference per step, so a chunk made n steps ago contributes its n-th action. One that is too old
    contributes nothing. Weights grow by e^exponent from each chunk to the next; the gripper is open or closed by
    their majority.
    """
    length = len(chunks[-1])
    # `reversed` counts ages from the newest chunk; the last [::-1] puts the oldest first again, as weights count.
    plans = np.array([chunk[age] for age, chunk in enumerate(reversed(chunks[-length:]))], np.float64)[::-1]
    weights = np.exp(exponent * np.arange(len(plans)))
    action = np.asarray(weights @ plans / weights.sum(), np.float32)
    action[-1] = action[-1] > _GRIPPER_OPEN
    return action


def count_lost_words(pack: Callable[[str], Sequence[int] | None], instruction: str) -> int:
    """Count the words at the end of an instruction that do not reach the network, and warn if there are any.

    The prompt of a model may be cut. A word is lost if the ids stay the same without it.

    Args:
        pack: A function of the instruction that returns the ids that the network receives; None where they are
            unknown.
        instruction: The words as the source has them.
    """
    ids, words = pack(instruction), instruction.split()
    lost = 0
    try:
        # From the end, because prompts are cut there. One word always stays: no instruction is empty.
        while ids is not None and lost + 1 < len(words) and pack(" ".join(words[: -lost - 1])) == ids:
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


# -- controllers -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Turn:
    """An inference that is due.

    Attributes:
        call: The number of inferences of the row that came before.
        buffers: The buffers for the activations of the first calls; None for an inference that is not captured.
        past: The chunks of the inferences before, oldest first, which the controller keeps where a policy averages
            them.
    """

    observation: Observation
    row: Row
    call: int
    buffers: "EpisodeBuffers | None"
    past: list[NDArray[np.float32]] = field(default_factory=list)

    @property
    def condition(self) -> str:
        """The condition whose edits the inference gets; empty for those of the run."""
        return str(self.row.columns.get(CONDITION, ""))

    def derived_seed(self, of: str) -> int:
        """Return the seed of this inference for the purpose `of`."""
        return derive_seed(self.row.policy_seed, of, self.row.noise_of(self.call))


@dataclass(frozen=True)
class Inference:
    """The result of one inference.

    Attributes:
        actions: (n, D) float32 to execute, n >= 1; None ends the episode.
        flagged: Whether the policy put out no valid action; None if that is unknown.
        columns: Columns of the episode's outcome.
    """

    actions: NDArray[np.float32] | None
    flagged: bool | None = None
    columns: Mapping[str, Any] = field(default_factory=dict)


class Controller(ABC):
    """The controller of a task: act, capture or ask.

    Attributes:
        identity: The part of a run's identity that the loaded model decides.
        streams: The storage of the captured streams; empty if nothing is captured.
        script: The name of the script for the player, None if the controller infers.
        execute: The number of actions per inference, 0 for none.
        threads: The number of threads of its network, None for torch's choice.
        on_gpu: Whether activations come from a GPU.
    """

    identity: dict[str, Any]
    streams: list[StoredStream]
    script: str | None = None
    execute: int = 0
    threads: int | None = None
    on_gpu: bool = False

    @abstractmethod
    def infer(self, turns: Sequence[Turn]) -> list[Inference]:
        """Call the model once about all of these turns, and return an inference per turn."""

    def instruction_ids(self, instruction: str) -> tuple[int, ...] | None:
        """Return the ids that the network receives as this instruction; None if it reads none or cannot say."""
        del instruction
        return None

    def certificate(self) -> dict[str, Any]:
        """Return the checks so far, for the run's certificate."""
        return {"policy": self.identity}


class ScriptedController(Controller):
    """A controller of a script, which plays by itself, looks at nothing and leaves no activations."""

    execute = 1

    def __init__(self, name: str) -> None:
        self.identity = {"model": name, "random_weights": False, "weights_sha256": None}
        self.streams, self.script = [], name

    def infer(self, turns: Sequence[Turn]) -> list[Inference]:
        """Raise AssertionError: a scripted player plays to the end by itself."""
        raise AssertionError(f"a scripted player asked for {len(turns)} actions")


class ModelController[Loaded: "Model", Question](Controller):
    """A model that infers: its capture, its part of a run's identity, and what it certifies.

    Attributes:
        outputs: The name of what an inference returns, in a word.
    """

    outputs: ClassVar[str]

    def __init__(self, model: Loaded, settings: "Settings", streams: list[StoredStream]) -> None:
        card = model.card
        self.model, self.streams, self._machine = model, streams, settings.machine
        self.threads = 1 if card.parameters < FEWEST_FOR_THREADS else None
        self.on_gpu = card.device.startswith("cuda")
        tokens, most_bytes = settings.capture.tokens == "all", settings.machine.capture_bytes
        self._capturer = Capturer(model, streams, tokens, self.outputs, most_bytes)
        self._input_check: dict[str, Reach] | None = None
        self._instruction_ids: dict[str, tuple[int, ...] | None] = {}
        self.identity = {
            "model": settings.model.family,
            "random_weights": card.random_weights,
            "weights_sha256": card.weights_sha256,
            "dtype": card.dtype,
            **({"policy": dict(card.settings)} if card.settings else {}),
        }

    def certificate(self) -> dict[str, Any]:
        """Return the model's card, fire counts of the last capture, and what capture and input check proved."""
        return {
            "policy": self.model.card.to_json(),
            "fires_per_inference": self._capturer.fires,
            "capture_check": self._capturer.check,
            INPUT_CHECK: dict(self._input_check or {}),
        }

    def instruction_ids(self, instruction: str) -> tuple[int, ...] | None:
        """Return the ids that the model's own packing makes of an instruction, frames around it included."""
        if instruction not in self._instruction_ids:
            with self._acting():
                self._instruction_ids[instruction] = self._ids_of(instruction)
        return self._instruction_ids[instruction]

    def _acting(self) -> AbstractContextManager[None]:
        return while_acting(self.identity["model"], self.model.card.checkpoint, self._machine.inference_limit)

    def _ids_of(self, text: str) -> tuple[int, ...] | None:
        ids = self.model.token_ids([text])
        return None if ids is None else tuple(map(int, ids[0]))

    def _check_inputs(
        self,
        infer: Callable[[Question], NDArray[np.float32]],
        clean: Question,
        variants: Mapping[str, Iterable[Question]],
        around: Callable[[Question], AbstractContextManager[None]] = lambda _: nullcontext(),
    ) -> None:
        """Record how far changes of an inference's inputs come. Raises IgnoredInputsError if none does."""
        # A run that stores nothing hooks nothing: its model may have no layer that can be captured.
        last = self.model.sites()[-1] if self.streams else None
        self._input_check = check_inputs(self.model, infer, clean, variants, last, around)
        if not self._machine.accept_ignored_inputs:
            check_not_ignored(self._input_check, self.identity["model"])


class PolicyController(ModelController["Policy", Observation]):
    """A controller that infers, executes the head of the chunk, and captures an episode's first inferences.

    Actions are in the checkpoint's own units where the source asks for them; where nothing is executed, the whole
    chunk goes back to the player. With `capture_only` in a scene, it infers and captures once per episode.
    """

    outputs = "actions"

    def __init__(self, policy: "Policy", source: Source[Any], settings: ExtractSettings) -> None:
        """Prepare a policy for a source as it is shown it."""
        task, card, self._source = settings.task, policy.card, source
        with while_acting(settings.model.family, card.checkpoint):
            # Of all instructions: the store makes room for the longest prompt.
            examples = [source.example(text) for text in source.instructions]
            super().__init__(policy, settings, stored_streams(policy, policy.roles(examples)))
        self.capture_only = task.capture_only and source.executes
        self.execute = task.execute or card.execute
        self.rotation: Rotation = task.rotation or PLAIN
        self.captured_calls = count_calls(settings, self.execute).calls
        self._edits = {"": (task.edits, task.vectors), **source.edits_by_condition()}
        self.identity |= {"execute": self.execute} if source.executes else {}
        if self.capture_only and (deaf := policy.zero_filled_inputs()):
            self.identity["zeros_for"] = list(deaf)
        self._edit_logs: dict[str, list[dict[str, Any]]] = {}

    def infer(self, turns: Sequence[Turn]) -> list[Inference]:
        """Return per turn the first `execute` actions of a fresh chunk, from one call of the policy.

        Where the policy's card asks for it, this is one action averaged over the plans of this and earlier chunks.
        """
        with self._acting():
            if self._input_check is None:
                self._try_inputs(turns[0])
            # After the check, which draws too. Adapters draw from the seeds they are given; this one is for global
            # generators that an author's code may use.
            begin_randomness(derive_seed("global", *(turn.derived_seed("call") for turn in turns)))
            chunks = self._capture_chunks(turns)
        flags = _own_flags(self.model.flagged, len(turns))
        return [
            Inference(self._executed_actions(turn, chunk), None if flags is None else bool(flags[row]))
            for row, (turn, chunk) in enumerate(zip(turns, chunks, strict=True))
        ]

    def _capture_chunks(self, turns: Sequence[Turn]) -> NDArray[np.float32]:
        """Return the chunks (B, chunk, D) of one call, with activations kept for the turns that are captured."""
        observations = copy_observations([turn.observation for turn in turns])
        edited = partial(self._apply_edits, observations, turns[0].condition)
        assert {turn.condition for turn in turns} == {turns[0].condition}, (
            "one call makes the edits of one condition"
        )
        seeds = [turn.derived_seed("inference") for turn in turns]
        infer = partial(self._chunks, [turn.observation for turn in turns], seeds)
        captured = {
            row: turn.buffers
            for row, turn in enumerate(turns)
            if turn.buffers is not None and len(turn.buffers.roles) < self.captured_calls
        }
        if not captured:
            with edited():
                return infer()
        return self._capturer.run(
            infer,
            lambda actions: actions,
            self.model.roles(observations),
            captured,
            edited,
        )

    def infer_plainly(self, turn: Turn) -> NDArray[np.float32]:
        """Return the chunk (chunk, D) of a turn as `infer` makes it, without a check, a proof or a capture."""
        with self._acting():
            begin_randomness(derive_seed("global", turn.derived_seed("call")))
            observations = copy_observations([turn.observation])
            with self._apply_edits(observations, turn.condition):
                chunk: NDArray[np.float32] = self._chunks(observations, [turn.derived_seed("inference")])[0]
        return chunk

    def _chunks(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return the chunks (B, chunk, D) of one call: a copy of the answer, which the policy cannot change later.

        Raises:
            PolicyFailedError: For an answer that is no such array.
        """
        policy, own_units = self.model, self._source.own_units
        acts = policy.infer_without_acting if self.capture_only else policy.act
        # Copies: adapters of others may write into what they are given, and a proof of capture reads it again.
        chunks = (policy.predict if own_units else acts)(copy_observations(observations), list(seeds))
        if own_units or not self.capture_only:
            check_predictions(chunks, len(observations), None if own_units else ACTION_SIZE)
        return np.array(chunks)

    def _try_inputs(self, turn: Turn) -> None:
        seed = turn.derived_seed("inference")

        def infer(observation: Observation) -> NDArray[np.float32]:
            begin_randomness(derive_seed("global", turn.derived_seed("call")))
            return self._chunks([observation], [seed])

        (observation,) = copy_observations([turn.observation])
        variants = vary_observation(observation, self._source.instructions, self._ids_of, self.model.absent_inputs)
        self._check_inputs(infer, observation, variants, lambda changed: self._apply_edits([changed]))

    def run_preflight(self, observations: Sequence[Observation], seeds: Sequence[int]) -> None:
        """Make one inference of which nothing is kept, to measure what another one will take."""
        with self._acting():
            self._chunks(observations, seeds)

    def _executed_actions(self, turn: Turn, chunk: NDArray[np.float32]) -> NDArray[np.float32] | None:
        if self.capture_only:
            return None
        if self._source.own_units:
            return chunk[: self.execute] if self._source.executes else chunk
        exponent = self.model.card.ensemble
        chunks = [chunk]
        if exponent is not None:
            turn.past.append(chunk)
            chunks = turn.past
        return executed_actions(chunks, self.execute, exponent, self.rotation)

    def certificate(self) -> dict[str, Any]:
        """Return the certificate of every model, with the rotation that reached the arm's controller and edits."""
        rotation = {} if self.capture_only or self._source.own_units else {"rotation": self.rotation}
        logs: dict[str, Any] = {"edits": self._edit_logs.get("", [])} if self._edits[""][0] else {}
        if len(self._edits) > 1:
            # A copy: a server asks for it on the thread that writes.
            logs[CONDITIONS] = {name: log for name, log in dict(self._edit_logs).items() if name}
        return {**super().certificate(), **rotation, **logs}

    @contextmanager
    def _apply_edits(self, observations: Sequence[Observation], condition: str = "") -> Iterator[None]:
        """Apply the edits of this run or of a condition for one inference.

        The certificate shows what the last one did.
        """
        edits, vectors = self._edits[condition]
        if not edits:
            yield
            if condition:
                self._edit_logs[condition] = []
            return
        from probe_kit.hooks import apply_edits

        with apply_edits(self.model, edits, observations, vectors) as edit_log:
            yield
        self._edit_logs[condition] = [asdict(entry) for entry in edit_log.entries]


def _own_flags(flagged: object, count: int) -> NDArray[np.bool_] | None:
    """Return a copy (count,) of what a policy flags in its last call. Raises PolicyFailedError."""
    if flagged is None:
        return None
    if not isinstance(flagged, np.ndarray) or flagged.shape != (count,) or flagged.dtype != np.bool_:
        raise PolicyFailedError(
            f"the policy's `flagged` is {str(flagged)[:80]!r} for {count} observations; expected a bool array "
            f"({count},), or None"
        )
    return flagged.copy()
