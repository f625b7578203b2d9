"""A suite of two items that most tests of extraction play."""

from pathlib import Path

import pytest

from probe_kit.suite import Suite, build_suite, load_suite
from tests.support.made_once import made_once


@pytest.fixture(scope="session")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """Two items of Color, in both layouts."""

    def make(folder: Path) -> None:
        build_suite(folder / "two", ["color"], 2)

    return load_suite(made_once(tmp_path_factory, "two-items", make) / "two")
