"""Every family with a network of its own keeps the contract, on tiny checkpoints in the released layouts."""

import pytest

from probe_kit.hooks.conformance.check import Check
from probe_kit.hooks.conformance.subject import Subject
from tests.support.contracts import MECHANISMS, NATIVE, pairs

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.mark.parametrize(("subject", "check"), pairs(NATIVE, MECHANISMS), indirect=["subject"])
def test_the_contract_is_kept(subject: Subject, check: Check) -> None:
    check(subject)
