"""The adapter under check: the model, the observations it is tried on, and its checkpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.conformance.check import SkipTest, require
from probe_kit.hooks.contract.model import AnswerModel, Model, Policy, Prompt, Reading
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.family import Family
from probe_kit.hooks.registry import find_family


class ContractSettings:
    """What checks need to know about a family, with defaults.

    family: name under which the registry loads the checkpoint; empty to leave out the checks of loading.
    options: what the checkpoint needs to load. unloadable_options: options that cannot be tried, such as
    quantisation without a GPU. configuration: a file of the checkpoint that the loader reads.
    tolerance: of a batch against its rows one by one, and of sums against the stream, float32.
    attention_tolerance: by how much shares of attention may add up to more than 1; they are means of rounded
    numbers. letters: the options of questions. other_words: what makes a question longer.
    """

    family: str = ""
    options: Mapping[str, Any] = {}
    unloadable_options: frozenset[str] = frozenset()
    configuration: str = "config.json"
    tolerance: float = 1e-5
    attention_tolerance: float = 1e-4
    letters: tuple[str, ...] = ("A", "B")
    other_words: str = " please"

    def questions(self, seen: Sequence[Observation]) -> list[Prompt]:
        """The observations' instructions as questions."""
        return [Prompt(own, own.instruction, self.letters) for own in seen]


class Given(Protocol):
    """What a check may ask for; each is made when it is asked for, and raises SkipTest where there is none."""

    @property
    def model(self) -> Model:
        """Under check."""

    @property
    def observations(self) -> list[Observation]:
        """Two whose instructions differ in length."""

    @property
    def alike(self) -> list[Observation]:
        """Two or more, of which at least two have instructions of equally many tokens."""

    @property
    def checkpoint(self) -> Path:
        """A folder that may be copied, changed and loaded."""

    @property
    def other_options(self) -> Mapping[str, Any]:
        """Per option another value than the default."""

    @property
    def folder(self) -> Path:
        """An empty one."""


class Subject:
    """A model with one way to run it. given: what it is tried on."""

    def __init__(self, settings: ContractSettings, given: Given) -> None:
        self.settings, self.given = settings, given

    @property
    def model(self) -> Model:
        """The model under check."""
        return self.given.model

    @property
    def seen(self) -> list[Observation]:
        """As many observations as one call takes."""
        return self.given.observations[: self.model.card.batch]

    @property
    def one(self) -> list[Observation]:
        """The first observation."""
        return self.given.observations[:1]

    @property
    def family(self) -> Family:
        """The family of the registry. Raises SkipTest if none was named."""
        if not self.settings.family:
            raise SkipTest("no family was named; set `family`")
        return find_family(self.settings.family)

    @property
    def probed_backbone(self) -> Stream:
        """The stream in which knowledge is probed."""
        streams = [own for own in self.model.streams.values() if own.part == "backbone" and own.probed]
        require(bool(streams), f"streams {list(self.model.streams)}", "a probed stream with part='backbone'")
        return streams[0]

    def load(self, checkpoint: Path, **options: Any) -> Model:
        """The model as users load it."""
        return self.family.load(str(checkpoint), options={**self.settings.options, **options})

    def run(self, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """One inference: a row of numbers per observation."""
        raise NotImplementedError

    def run_row(self, observation: Observation, row: int) -> NDArray[np.float32]:
        """What `run` gives for row `row` of a batch, alone."""
        del row
        return np.asarray(self.run([observation])[0])

    def roles_of(self, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles of what `run` makes of these observations."""
        return self.model.roles(seen)


class PolicySubject(Subject):
    """A policy; one inference gives actions."""

    @property
    def policy(self) -> Policy:
        """The model under check, which acts."""
        model = self.model
        require(isinstance(model, Policy), f"a {type(model).__name__}", "a subclass of probe_kit.hooks.Policy")
        assert isinstance(model, Policy)
        return model

    def run(self, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """Actions from the seeds 0, 1 …; what the network puts out where they do not fit this arm."""
        return self._infer(seen, range(len(seen)))

    def run_row(self, observation: Observation, row: int) -> NDArray[np.float32]:
        """With the row's own seed."""
        return np.asarray(self._infer([observation], [row])[0])

    def _infer(self, seen: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        policy = self.policy
        infer = policy.act if policy.embodiment_mismatch() is None else policy.infer_without_acting
        return infer(seen, seeds)


class AnswerSubject(Subject):
    """A model that answers; one inference gives the logits of the options."""

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
        """About all observations."""
        return self.settings.questions(self.given.observations)

    @property
    def asked(self) -> list[Prompt]:
        """About as many observations as one call takes."""
        return self.settings.questions(self.seen)

    def run(self, seen: Sequence[Observation]) -> NDArray[np.float32]:
        """The logits of the options."""
        return self.ask(self.settings.questions(seen))

    def roles_of(self, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Of the questions asked about them."""
        return self.answer_model.asked_roles(self.led(self.settings.questions(seen)))

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """One prefill of the questions."""
        return self.answer_model.read(self.led(questions))

    def ask(self, questions: Sequence[Prompt]) -> NDArray[np.float32]:
        """The logits of the options of each question."""
        return self.read(questions).option_logits

    def led(self, questions: Sequence[Prompt]) -> list[Prompt]:
        """With options as they stand behind the frame."""
        lead = self.answer_model.lead
        return [
            own if own.begun else replace(own, options=tuple(lead + letter for letter in own.options))
            for own in questions
        ]
