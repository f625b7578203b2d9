"""The adapter under check, loaded once for all checks of its contract."""

from collections.abc import Iterator

import pytest

from probe_kit.hooks.conformance.subject import Subject


@pytest.fixture(scope="module")
def subject(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
    with request.param.subject(tmp_path_factory.mktemp("contract") / "checkpoint") as subject:
        yield subject
