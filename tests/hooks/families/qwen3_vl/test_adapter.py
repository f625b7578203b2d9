from pathlib import Path
from typing import Any

import pytest

from probe_kit.hooks.families.qwen3_vl.adapter import Qwen3VL, load_qwen3_vl
from probe_kit.hooks.testing import ReaderContract
from tests.support.vlm_checkpoints import write_qwen3_vl


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_qwen3_vl(tmp_path_factory.mktemp("qwen3_vl"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Qwen3VL:
    return load_qwen3_vl(str(folder))


class TestQwen3VL(ReaderContract):
    family = "qwen3-vl"

    @pytest.fixture(scope="class")
    def checkpoint(self, folder: Path) -> Path:
        return folder

    @pytest.fixture
    def other_options(self, folder: Path) -> dict[str, Any]:
        return {"tokenizer": str(folder)}

    @pytest.fixture
    def reader(self, loaded: Qwen3VL) -> Qwen3VL:
        return loaded
