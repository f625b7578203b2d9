from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.families.ovis2_5.adapter import Ovis25, load_ovis2_5
from probe_kit.hooks.testing import ReaderContract
from tests.support.vlm_checkpoints import write_ovis2_5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ovis2_5(tmp_path_factory.mktemp("ovis2_5"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Ovis25:
    return load_ovis2_5(str(folder))


class TestOvis25(ReaderContract):
    family = "ovis2.5"

    @pytest.fixture(scope="class")
    def checkpoint(self, folder: Path) -> Path:
        return folder

    @pytest.fixture
    def other_options(self, folder: Path) -> dict[str, Any]:
        return {"tokenizer": str(folder)}

    @pytest.fixture
    def reader(self, loaded: Ovis25) -> Ovis25:
        return loaded
