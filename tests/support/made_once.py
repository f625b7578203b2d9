"""What several processes of the test suite need is made by one of them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The temporary folder of all processes of this suite."""
    base_folder = tmp_path_factory.getbasetemp()
    return base_folder.parent if "PYTEST_XDIST_WORKER" in os.environ else base_folder


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder that `make` fills: one process of the suite does so, and every other gets a copy of its own."""
    folder = tmp_path_factory.mktemp(name) / name
    if "PYTEST_XDIST_WORKER" not in os.environ:
        make(folder)
        return folder
    everybodys = shared_folder(tmp_path_factory) / name
    with FileLock(f"{everybodys}.lock"):
        if not everybodys.exists():
            make(folder)
            shutil.copytree(folder, f"{everybodys}.part")
            Path(f"{everybodys}.part").rename(everybodys)
            return folder
    shutil.copytree(everybodys, folder)
    return folder
