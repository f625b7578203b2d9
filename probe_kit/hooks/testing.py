"""The contract of adapters for tests of your own: one test per check, on a subject that is loaded once.

    @pytest.fixture(scope="module")
    def subject(tmp_path_factory):
        checkpoint = write_tiny_checkpoint(tmp_path_factory.mktemp("mine"))
        with PolicySubject("my-vla", checkpoint, other_options={"steps": 3}) as subject:
            yield subject

    @pytest.mark.parametrize("check", POLICY_CHECKS, ids=str)
    def test_my_adapter_keeps_the_contract(check, subject):
        check(subject)

A check that is not about this adapter raises `unittest.SkipTest`. `probe-kit check-adapter` runs the same checks
without pytest.
"""

from collections.abc import Mapping, Sequence

from probe_kit.hooks.conformance import answering, captures, loading, policies
from probe_kit.hooks.conformance.check import Check, checks_of
from probe_kit.hooks.conformance.subject import AnswerSubject, PolicySubject, Subject, example_observations

__all__ = [
    "ANSWER_CHECKS",
    "POLICY_CHECKS",
    "AnswerSubject",
    "PolicySubject",
    "example_observations",
]


_MODEL_CHECKS = checks_of(captures, loading)
POLICY_CHECKS: Sequence[Check] = (*_MODEL_CHECKS, *checks_of(policies))
ANSWER_CHECKS: Sequence[Check] = (*_MODEL_CHECKS, *checks_of(answering))
CONTRACTS: Mapping[type[Subject], Sequence[Check]] = {PolicySubject: POLICY_CHECKS, AnswerSubject: ANSWER_CHECKS}
