"""Base of vision-language models that load and are verified in the same way."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from numpy.typing import NDArray

from probe_kit.hooks.families.shared.vlm.adapter import VisionLanguageModel
from probe_kit.hooks.families.shared.vlm.loading import Recipe, load_vlm
from probe_kit.hooks.families.shared.vlm.verify import verify_vlm
from probe_kit.hooks.verification.verify import Comparison


class RecipeVLM(VisionLanguageModel):
    """A vision-language model whose `recipe` makes its network; `load` and `verify` are a family's entries."""

    recipe: ClassVar[Recipe]

    @classmethod
    def load(
        cls,
        checkpoint: str | None = None,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        *,
        tokenizer: str | None = None,
        weights_seed: int = 0,
        **settings: str,
    ) -> Self:
        """Load a model of any size from a folder or hub id; see `load_vlm`.

        tokenizer: folder of another one. settings: further options of the family, for its constructor.
        """
        loaded = load_vlm(cls.recipe, checkpoint, device, dtype, random_weights, weights_seed)
        return cls(loaded, tokenizer, **settings)

    @classmethod
    def verify(cls, folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
        """Compare the checkpoint in `folder` with recorded outputs; see `verify_vlm`."""
        return verify_vlm(cls.load(str(folder / "checkpoint"), dtype="float32"), folder, recorded)
