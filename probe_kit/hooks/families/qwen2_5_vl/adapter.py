"""The adapter for Qwen2.5-VL: chat with a system turn; positions along time, height and width."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray
from transformers import Qwen2_5_VLConfig

from probe_kit.hooks.families.shared.qwen.reader import SYSTEM, QwenReader, qwen_frame
from probe_kit.hooks.families.shared.vlm.loading import Recipe, load_vlm
from probe_kit.hooks.families.shared.vlm.text import Frame
from probe_kit.hooks.families.shared.vlm.verify import verify_vlm
from probe_kit.hooks.verification.verify import Comparison
from probe_kit.models.qwen import QWEN2_5_NAMES, build_qwen2_5_vl

_RECIPE = Recipe(Qwen2_5_VLConfig.from_dict, build_qwen2_5_vl, QWEN2_5_NAMES)


class Qwen25VL(QwenReader):
    """A loaded Qwen2.5-VL."""

    family: ClassVar[str] = "qwen2.5-vl"
    frame: ClassVar[Frame] = qwen_frame(SYSTEM)


def load_qwen2_5_vl(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    tokenizer: str | None = None,
    weights_seed: int = 0,
) -> Qwen25VL:
    """Load Qwen2.5-VL of any size from a folder or hub id; see `load_vlm`. tokenizer: folder of another one."""
    return Qwen25VL(load_vlm(_RECIPE, checkpoint, device, dtype, random_weights, weights_seed), tokenizer)


def verify_qwen2_5_vl(folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
    """Compare a reference."""
    return verify_vlm(load_qwen2_5_vl(str(folder / "checkpoint"), dtype="float32"), folder, recorded)
