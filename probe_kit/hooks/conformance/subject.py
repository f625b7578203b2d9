"""The adapter under check: the model, the observations it is tried on, and its checkpoint."""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.conformance.check import SkipTest, require
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.declared import Option, check_options
from probe_kit.hooks.contract.model import AnswerModel, Model, Policy, Prompt, Reading
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.family import SIZE, Family
from probe_kit.hooks.registry import find_family

LARGEST_COPY = 1_000_000_000
"""Bytes of a checkpoint that is copied and loaded several times; a larger one costs minutes and disk."""
INSTRUCTIONS = tuple(
    f"Put the cube on the {name}" for name in ("star", "red shape", "cube", "blue shape", "green shape", "arrow")
)
"""Instructions of different lengths; several have equally many letters, words or tokens."""
NONE: Mapping[str, Any] = MappingProxyType({})


class Subject:
    """An adapter under check; a context that removes what its checks wrote.

    Args:
        family: Name of the family; empty for a model that no registry loads, whose checks of loading are skipped.
        checkpoint: A folder or hub id; None for the default.
        options: Options of loading, by name.
        other_options: Values of options that are not in use; switches and closed lists of values need none.
        instructions: At least two; the first two differ in length, and two have equally many tokens.
        model: A model that is loaded; None lets a check that asks for it load it.
        device: Device on which the model is loaded.
        dtype: The dtype in which the model is loaded; None leaves the choice to the loader.
        tolerance: The tolerance of a batch against its rows one by one, and of sums against the stream, in
            float32.

    Raises:
        UsageError: For options that the family does not have.
    """

    acting: ClassVar[bool]
    """Whether it is checked as a policy."""
    attention_tolerance: ClassVar[float] = 1e-4
    """The amount by which shares of attention may add up to more than 1; they are means of rounded numbers."""
    letters: ClassVar[tuple[str, ...]] = ("A", "B")
    """The options of questions."""

    def __init__(
        self,
        family: str = "",
        checkpoint: str | Path | None = None,
        *,
        options: Mapping[str, Any] = NONE,
        other_options: Mapping[str, Any] = NONE,
        instructions: Sequence[str] = INSTRUCTIONS,
        model: Model | None = None,
        device: str = "cpu",
        dtype: str | None = None,
        tolerance: float = 1e-5,
    ) -> None:
        self.name, self.given_checkpoint = family, None if checkpoint is None else str(checkpoint)
        self.options = check_options(family, self.family.options, options) if family else dict(options)
        self._other_values, self.instructions, self.tolerance = other_options, tuple(instructions), tolerance
        self.device, self.dtype, self._model = device, dtype, model
        self._scratch: Path | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove what was written, and let the model go."""
        self._model = None
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)
            self._scratch = None

    # -- the model and its checkpoint ---------------------------------------------------------------------

    @property
    def model(self) -> Model:
        """The model under check, as users load it."""
        if self._model is None:
            self._model = self.family.load(self.given_checkpoint, self.device, self.dtype, options=self.options)
        return self._model

    def share_model(self, other: "Subject") -> None:
        """Check the model that another subject has loaded."""
        self._model = other.model

    @property
    def family(self) -> Family:
        """The family of the registry.

        Raises:
            SkipTest: If none was named.
        """
        if not self.name:
            raise SkipTest("no family was named")
        return find_family(self.name)

    @cached_property
    def checkpoint(self) -> Path:
        """A folder that may be copied and loaded.

        Raises:
            SkipTest: Where there is none, or a large one.
        """
        location = self.family.location(self.given_checkpoint, self.options.get(SIZE))
        if location is None:
            raise SkipTest("the family brings its own weights; give --checkpoint to check how it loads")
        folder = checkpoint_folder(location)
        if (size := sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())) > LARGEST_COPY:
            raise SkipTest(
                f"the checkpoint has {size / 1e9:.1f} GB and would be copied; check a tiny one of the same layout"
            )
        return folder

    @property
    def folder(self) -> Path:
        """A new empty folder."""
        if self._scratch is None:
            self._scratch = Path(tempfile.mkdtemp(prefix="probe-kit-check-"))
        return Path(tempfile.mkdtemp(dir=self._scratch))

    @property
    def other_options(self) -> dict[str, tuple[Any, ...]]:
        """The values of every option that are not in use, as far as they are known."""
        declared = [option for option in self.family.options if option.name != SIZE]
        declared_values = {
            option.name: _others_of(option, self.options.get(option.name, option.default)) for option in declared
        }
        passed_values = {name: (value,) for name, value in self._other_values.items()}
        return {name: values for name, values in declared_values.items() if values} | passed_values

    def load(self, checkpoint: Path, **options: Any) -> Model:
        """The model of another checkpoint."""
        return self.family.load(str(checkpoint), options={**self.loading_options, **options})

    @cached_property
    def stored_card(self) -> ModelCard:
        """The card of the checkpoint as it lies there, loaded by its folder."""
        return self.load(self.checkpoint).card

    @property
    def loading_options(self) -> dict[str, Any]:
        """The options in use without a size, which stands for a checkpoint."""
        return {name: value for name, value in self.options.items() if name != SIZE}

    # -- what it is tried on ------------------------------------------------------------------------------

    @property
    def observations(self) -> list[Observation]:
        """Two observations whose instructions differ in length."""
        return self.alike[:2]

    @cached_property
    def alike(self) -> list[Observation]:
        """The observations, one per instruction; at least two have equally many tokens."""
        return examples_for(self.model, *self.instructions)

    @property
    def batch(self) -> list[Observation]:
        """The observations that one call takes."""
        return self.observations[: self.model.card.batch]

    @property
    def single(self) -> list[Observation]:
        """The first observation."""
        return self.observations[:1]

    def require_float32(self) -> None:
        """Raise SkipTest for a model in a coarser precision, in which small differences are rounded away."""
        if self.model.card.dtype != "float32":
            raise SkipTest(f"in {self.model.card.dtype} a difference is rounded away; load the model in float32")

    @property
    def probed_backbone(self) -> Stream:
        """The stream in which knowledge is probed."""
        streams = [stream for stream in self.model.streams.values() if stream.part == "backbone" and stream.probed]
        require(bool(streams), f"streams {list(self.model.streams)}", "a probed stream with part='backbone'")
        return streams[0]

    # -- how it is run ------------------------------------------------------------------------------------

    def run(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Run one inference, which gives a row of numbers per observation."""
        raise NotImplementedError

    def run_row(self, observation: Observation, row: int) -> NDArray[np.float32]:
        """Return the numbers that `run` gives for row `row` of a batch, from an inference of that row alone."""
        del row
        return np.asarray(self.run([observation])[0])

    def roles_of(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of what `run` makes of these observations."""
        return self.model.roles(observations)


def _others_of(option: Option, used: Any) -> tuple[Any, ...]:
    """Return the values besides `used` that the declaration names."""
    if option.kind is bool:
        return (not (used is True or str(used).lower() in ("true", "yes", "on", "1")),)
    return tuple(value for value in option.choices if str(value) != str(used))


class PolicySubject(Subject):
    """A policy; one inference gives actions."""

    acting = True

    @property
    def policy(self) -> Policy:
        """The model under check, which acts."""
        model = self.model
        require(isinstance(model, Policy), f"a {type(model).__name__}", "a subclass of probe_kit.hooks.Policy")
        assert isinstance(model, Policy)
        return model

    def run(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Return actions from the seeds 0, 1 …; what the network puts out where they do not fit this arm."""
        return self._infer(observations, range(len(observations)))

    def run_row(self, observation: Observation, row: int) -> NDArray[np.float32]:
        """Return the actions of one observation, with the row's own seed."""
        return np.asarray(self._infer([observation], [row])[0])

    def _infer(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        policy = self.policy
        infer = policy.act if policy.embodiment_mismatch() is None else policy.infer_without_acting
        return infer(observations, seeds)


class AnswerSubject(Subject):
    """A model that answers; one inference gives the logits of the options."""

    acting = False

    @property
    def answer_model(self) -> AnswerModel:
        """The model under check, which answers."""
        model = self.model
        require(
            isinstance(model, AnswerModel),
            f"a {type(model).__name__}",
            "a subclass of probe_kit.hooks.AnswerModel",
        )
        assert isinstance(model, AnswerModel)
        return model

    @property
    def questions(self) -> list[Prompt]:
        """Questions about all observations."""
        return self.questions_of(self.observations)

    @property
    def questions_of_batch(self) -> list[Prompt]:
        """Questions about the observations that one call takes."""
        return self.questions_of(self.batch)

    def questions_of(self, observations: Sequence[Observation]) -> list[Prompt]:
        """The observations' instructions as questions."""
        return [Prompt(observation, observation.instruction, self.letters) for observation in observations]

    def run(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Return the logits of the options."""
        return self.ask(self.questions_of(observations))

    def roles_of(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of the questions about these observations."""
        return self.answer_model.asked_roles(self.led(self.questions_of(observations)))

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """Read the questions in one prefill."""
        return self.answer_model.read(self.led(questions))

    def ask(self, questions: Sequence[Prompt]) -> NDArray[np.float32]:
        """The logits of the options of each question."""
        return self.read(questions).option_logits

    def led(self, questions: Sequence[Prompt]) -> list[Prompt]:
        """Return questions whose options stand as they do behind the frame."""
        lead = self.answer_model.lead
        return [
            question
            if question.begun
            else replace(question, options=tuple(lead + letter for letter in question.options))
            for question in questions
        ]


def example_observations(instructions: Sequence[str], cameras: Sequence[str] = ()) -> list[Observation]:
    """Return observations, one per instruction: noise pictures, plausible states, intrinsics, of a fixed seed."""
    rng = np.random.default_rng(0)
    size = (48, 64, 3)
    intrinsics = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    return [
        Observation(
            rng.integers(0, 256, size, dtype=np.uint8),
            np.array([0.3, 0.02 * index, 0.15, 0, 0, 0, 0, 1], np.float32),
            text,
            intrinsics,
            {camera: rng.integers(0, 256, size, dtype=np.uint8) for camera in cameras},
        )
        for index, text in enumerate(instructions)
    ]


def examples_for(model: Model, *instructions: str) -> list[Observation]:
    """Return observations that hold what the model needs."""
    cameras = [need.removeprefix("camera.") for need in sorted(model.card.needs) if need.startswith("camera.")]
    return example_observations(instructions, cameras)
