from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.families.internvl.adapter import InternVL, load_internvl
from probe_kit.hooks.testing import ReaderContract
from tests.support.vlm_checkpoints import write_internvl


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_internvl(tmp_path_factory.mktemp("internvl"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> InternVL:
    return load_internvl(str(folder))


class TestInternVL(ReaderContract):
    family = "internvl"

    @pytest.fixture(scope="class")
    def checkpoint(self, folder: Path) -> Path:
        return folder

    @pytest.fixture
    def other_options(self, folder: Path) -> dict[str, Any]:
        return {"tiles": "1", "tokenizer": str(folder)}

    @pytest.fixture
    def reader(self, loaded: InternVL) -> InternVL:
        return loaded
