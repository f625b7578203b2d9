"""Every model that answers keeps the contract of adapters, on tiny checkpoints in the released layouts."""

import pytest

from probe_kit.hooks.conformance.check import Check
from probe_kit.hooks.conformance.subject import Subject
from tests.support.contracts import ANSWERING, LOADING, MECHANISMS, pairs

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.mark.parametrize(("subject", "check"), pairs(ANSWERING, MECHANISMS | LOADING), indirect=["subject"])
def test_the_contract_is_kept(subject: Subject, check: Check) -> None:
    check(subject)
