"""The module `reach_env` can be imported by its name, in child processes too, as a user's own module can."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def _own_modules() -> Iterator[None]:
    folder = str(Path(__file__).parents[2] / "support")
    sys.path.append(folder)
    yield
    sys.path.remove(folder)
