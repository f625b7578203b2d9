"""The adapter under check, written and loaded once for all checks of its contract."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from probe_kit.hooks.conformance.subject import Subject
from tests.support.contracts import Case


@pytest.fixture(scope="module")
def subject_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[Case], Subject]]:
    """The subject of a case until another is asked for.

    As a parameter of a fixture, a case would be made anew for every test: to pytest each has a value of its own.
    """
    with ExitStack() as open_subject:
        latest: list[tuple[Case, Subject]] = []

        def of(case: Case) -> Subject:
            if not latest or latest[0][0] is not case:
                open_subject.close()
                subject = case.subject(tmp_path_factory.mktemp("contract") / "checkpoint")
                latest[:] = [(case, open_subject.enter_context(subject))]
            return latest[0][1]

        yield of


@pytest.fixture
def subject(request: pytest.FixtureRequest, subject_of: Callable[[Case], Subject]) -> Subject:
    return subject_of(request.param)
