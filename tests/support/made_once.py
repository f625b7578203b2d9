"""What several processes of the test suite need is made by one of them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The temporary folder of all processes of this suite."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder that `make` fills: one process of the suite does so, and every other gets a copy of its own."""
    own = tmp_path_factory.mktemp(name) / name
    if "PYTEST_XDIST_WORKER" not in os.environ:
        make(own)
        return own
    everybodys = shared_folder(tmp_path_factory) / name
    with FileLock(f"{everybodys}.lock"):
        if not everybodys.exists():
            make(own)
            shutil.copytree(own, f"{everybodys}.part")
            Path(f"{everybodys}.part").rename(everybodys)
            return own
    shutil.copytree(everybodys, own)
    return own
