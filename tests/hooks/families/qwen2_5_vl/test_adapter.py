from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.families.qwen2_5_vl.adapter import Qwen25VL, load_qwen2_5_vl
from probe_kit.hooks.testing import ReaderContract
from tests.support.vlm_checkpoints import write_qwen2_5_vl


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_qwen2_5_vl(tmp_path_factory.mktemp("qwen2_5_vl"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Qwen25VL:
    return load_qwen2_5_vl(str(folder))


class TestQwen25VL(ReaderContract):
    family = "qwen2.5-vl"

    @pytest.fixture(scope="class")
    def checkpoint(self, folder: Path) -> Path:
        return folder

    @pytest.fixture
    def other_options(self, folder: Path) -> dict[str, Any]:
        return {"tokenizer": str(folder)}

    @pytest.fixture
    def reader(self, loaded: Qwen25VL) -> Qwen25VL:
        return loaded
