"""Contract tests of adapters; subclass `AdapterContract` (policies) or `AnswerModelContract` (answering models).

    class TestMyFamily(AdapterContract):
        family = "my-family"

        @pytest.fixture(scope="class")
        def checkpoint(self, tmp_path_factory):
            return write_tiny_checkpoint(tmp_path_factory.mktemp("mine"))

        @pytest.fixture
        def other_options(self):
            return {"crop": True}  # another value for each declared option

Needs pytest; `probe-kit check-adapter` runs the same checks without it. Override `observations` and `alike` if
your tokenizer does not know the default instructions, and `policy` if loading takes more than the checkpoint.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.conformance.check import Check
from probe_kit.hooks.conformance.contract import ANSWER_CHECKS, POLICY_CHECKS
from probe_kit.hooks.conformance.examples import example_observations, examples_for
from probe_kit.hooks.conformance.subject import AnswerSubject, ContractSettings, PolicySubject, Subject
from probe_kit.hooks.contract.model import AnswerModel, Model, Policy
from probe_kit.hooks.contract.observation import Observation

__all__ = ["AdapterContract", "AnswerModelContract", "ModelContract", "example_observations"]

_FIXTURES = {"folder": "tmp_path"}


class _Fixtures:
    """What checks ask for, from pytest's fixtures; a fixture that is not asked for is not made."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request

    def __getattr__(self, name: str) -> Any:
        return self._request.getfixturevalue(_FIXTURES.get(name, name))


def _test_of(own: Check) -> Callable[..., None]:
    def test(self: object, subject: Subject) -> None:
        del self
        own(subject)

    test.__name__, test.__doc__ = f"test_{own.name}", own.sentence
    return test


class ModelContract(ContractSettings):
    """What capture, edits, verification and the store rely on. Every test name is a promise."""

    subject_type: type[Subject] = Subject
    """How the model is run."""

    def __init_subclass__(cls, checks: Sequence[Check] = (), **keywords: Any) -> None:
        """Give the class a test per check, with the check's name behind `test_`."""
        super().__init_subclass__(**keywords)
        for own in checks:
            setattr(cls, f"test_{own.name}", _test_of(own))

    @pytest.fixture(scope="class")
    def checkpoint(self) -> Path:
        """The tiny checkpoint the model is loaded from, in the released layout."""
        pytest.skip("no checkpoint was named; override the fixture `checkpoint`")

    @pytest.fixture
    def other_options(self) -> Mapping[str, Any]:
        """For every declared option a value other than the default."""
        return {}

    @pytest.fixture
    def observations(self, model: Model) -> list[Observation]:
        """Two observations whose instructions differ in length."""
        return self.examples(model, "Put the cube on the star", "Put the cube on the red shape")

    @pytest.fixture
    def alike(self, model: Model) -> list[Observation]:
        """Two observations whose instructions differ, but not in their number of tokens."""
        return self.examples(model, "Put the cube on the star", "Put the cube on the cube")

    @pytest.fixture
    def subject(self, request: pytest.FixtureRequest) -> Subject:
        """The model with its observations and checkpoint, as the checks take it."""
        return self.subject_type(self, _Fixtures(request))

    @staticmethod
    def examples(model: Model, *instructions: str) -> list[Observation]:
        """Observations that hold what the model needs."""
        return examples_for(model, *instructions)


class AdapterContract(ModelContract, checks=POLICY_CHECKS):
    """What the rest of probe_kit relies on in a `Policy`."""

    subject_type = PolicySubject

    @pytest.fixture
    def policy(self, subject: Subject, checkpoint: Path) -> Policy:
        """The adapter under test; override it to load it once per module."""
        model = subject.load(checkpoint)
        assert isinstance(model, Policy)
        return model

    @pytest.fixture
    def model(self, policy: Policy) -> Policy:
        """The same, as the tests of every model know it."""
        return policy


class AnswerModelContract(ModelContract, checks=ANSWER_CHECKS):
    """What the rest of probe_kit relies on in an `AnswerModel`."""

    subject_type = AnswerSubject

    @pytest.fixture
    def answer_model(self, subject: Subject, checkpoint: Path) -> AnswerModel:
        """The adapter under test; override it to load it once per module."""
        model = subject.load(checkpoint)
        assert isinstance(model, AnswerModel)
        return model

    @pytest.fixture
    def model(self, answer_model: AnswerModel) -> AnswerModel:
        """The same, as the tests of every model know it."""
        return answer_model
