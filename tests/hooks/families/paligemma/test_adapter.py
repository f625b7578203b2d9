from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.families.paligemma.adapter import PaliGemma, load_paligemma
from probe_kit.hooks.testing import ReaderContract
from tests.support.vlm_checkpoints import write_paligemma


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_paligemma(tmp_path_factory.mktemp("paligemma"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> PaliGemma:
    return load_paligemma(str(folder))


class TestPaliGemma(ReaderContract):
    family = "paligemma"

    @pytest.fixture(scope="class")
    def checkpoint(self, folder: Path) -> Path:
        return folder

    @pytest.fixture
    def other_options(self, folder: Path) -> dict[str, Any]:
        return {"tokenizer": str(folder)}

    @pytest.fixture
    def reader(self, loaded: PaliGemma) -> PaliGemma:
        return loaded
