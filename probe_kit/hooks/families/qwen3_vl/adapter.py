"""The adapter for Qwen3-VL: chat without a system turn; DeepStack adds pictures between its first blocks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray
from transformers import Qwen3VLConfig

from probe_kit.hooks.families.shared.qwen.reader import QwenReader, qwen_frame
from probe_kit.hooks.families.shared.vlm.loading import Recipe, load_vlm
from probe_kit.hooks.families.shared.vlm.text import Frame
from probe_kit.hooks.families.shared.vlm.verify import verify_vlm
from probe_kit.hooks.verification.verify import Comparison
from probe_kit.models.qwen import build_qwen3_vl

_RECIPE = Recipe(Qwen3VLConfig.from_dict, build_qwen3_vl)


class Qwen3VL(QwenReader):
    """A loaded Qwen3-VL."""

    family: ClassVar[str] = "qwen3-vl"
    frame: ClassVar[Frame] = qwen_frame()
    sums: ClassVar[bool] = False


def load_qwen3_vl(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    tokenizer: str | None = None,
    weights_seed: int = 0,
) -> Qwen3VL:
    """Load Qwen3-VL of any size from a folder or hub id; see `load_vlm`. tokenizer: folder of another one."""
    return Qwen3VL(load_vlm(_RECIPE, checkpoint, device, dtype, random_weights, weights_seed), tokenizer)


def verify_qwen3_vl(folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
    """Compare a reference."""
    return verify_vlm(load_qwen3_vl(str(folder / "checkpoint"), dtype="float32"), folder, recorded)
