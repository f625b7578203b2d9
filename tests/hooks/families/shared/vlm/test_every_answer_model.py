"""Every vision-language model without actions keeps the contract, on a tiny checkpoint in the released layout."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, cast

import pytest

from probe_kit.hooks import AnswerModel, load_model
from probe_kit.hooks.testing import AnswerModelContract
from tests.support.vlm_checkpoints import (
    write_internvl,
    write_ovis2_5,
    write_paligemma,
    write_qwen2_5_vl,
    write_qwen3_vl,
)


class OfTinyCheckpoint(AnswerModelContract):
    """write: writes the checkpoint into a folder. further_options: of the family, other than their defaults."""

    write: Callable[[Path], Path]
    further_options: ClassVar[Mapping[str, Any]] = MappingProxyType({})

    @pytest.fixture(scope="class")
    def checkpoint(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return type(self).write(tmp_path_factory.mktemp("vlm"))

    @pytest.fixture
    def other_options(self, checkpoint: Path) -> dict[str, Any]:
        return {"tokenizer": str(checkpoint), **self.further_options}

    @pytest.fixture(scope="class")
    def loaded(self, checkpoint: Path) -> AnswerModel:
        return cast(AnswerModel, load_model(self.family, str(checkpoint)))

    @pytest.fixture
    def answer_model(self, loaded: AnswerModel) -> AnswerModel:
        return loaded


class TestQwen25VL(OfTinyCheckpoint):
    family = "qwen2.5-vl"
    write = staticmethod(write_qwen2_5_vl)


class TestQwen3VL(OfTinyCheckpoint):
    family = "qwen3-vl"
    write = staticmethod(write_qwen3_vl)


class TestInternVL(OfTinyCheckpoint):
    family = "internvl"
    write = staticmethod(write_internvl)
    further_options = MappingProxyType({"tiles": "1"})


class TestOvis25(OfTinyCheckpoint):
    family = "ovis2.5"
    write = staticmethod(write_ovis2_5)


class TestPaliGemma(OfTinyCheckpoint):
    family = "paligemma"
    write = staticmethod(write_paligemma)
