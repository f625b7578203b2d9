"""Auxiliary heads that exist during training only; what they do to probes is said in the model card."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

from pi0_tiny_training.batches import Batch
from pi0_tiny_training.painting import Brush
from pi0_tiny_training.pictures import CONCEPTS
from probe_kit.models.pi0_tiny import IMAGE_SIDE, SIZE

SEES_TILE, MOSTLY_TILE = 0.25, 0.60
"""Share of a patch that a tile covers, from which its token belongs to the tile, or describes it."""


@dataclass
class Heard:
    """What one forward pass left: projected (B, patches, width), and middle (B, tokens, width)."""

    projected: Tensor | None = None
    middle: Tensor | None = None


@contextmanager
def listening(model: nn.Module) -> Iterator[Heard]:
    """Catch the projector's output and what enters the last backbone layer, gradients included."""
    heard = Heard()
    vlm = model.paligemma_with_expert.paligemma.model
    norm = vlm.language_model.layers[-1].input_layernorm

    def projector(_module: nn.Module, _inputs: object, output: Tensor) -> None:
        heard.projected = output

    def entering(_module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        heard.middle = inputs[0]

    handles = [
        vlm.multi_modal_projector.register_forward_hook(projector),
        norm.register_forward_pre_hook(entering),
    ]
    try:
        yield heard
    finally:
        for handle in handles:
            handle.remove()


class Heads(nn.Module):
    """Linear readers, and the losses that make them right.

    concept: what each tile shows, read from its own patches where they enter the backbone.
    asked: whether a patch belongs to the asked tile, read at the middle layer. For the unused category the
    right answer is always no, so that the expert finds nothing to act on.
    seen: the asked side from the mean over the patches at the middle layer; for the unused category: neither.
    told: the asked side of the unused category alone, from the mean over the words at the middle layer.
    """

    def __init__(self, brushes: tuple[Brush, Brush]) -> None:
        super().__init__()
        width = SIZE.vlm.width
        self.concept = nn.ModuleList(nn.Linear(width, len(names)) for names in CONCEPTS.values())
        self.asked, self.seen, self.told = (nn.Linear(width, 1) for _ in range(3))
        cover = torch.stack([_patch_cover(brush) for brush in brushes])
        self.register_buffer("describes", (cover >= MOSTLY_TILE).float())
        self.register_buffer("belongs", (cover >= SEES_TILE).float())

    def losses(self, heard: Heard, batch: Batch, words: Tensor) -> dict[str, Tensor]:
        """The four losses. words: (B, text tokens) bool, true for words."""
        assert heard.projected is not None
        assert heard.middle is not None
        patches, used = self.belongs.shape[1], batch.used.float()
        image, text = heard.middle[:, :patches], heard.middle[:, patches : patches + words.shape[1]]
        share = self.describes / self.describes.sum(1, keepdim=True)
        tiles = torch.einsum("sp,bpw->bsw", share, heard.projected)
        side = batch.side.float()
        belongs_asked = self.belongs[batch.side] * used[:, None]
        on_tiles = self.belongs.sum(0).clamp(max=1).expand_as(belongs_asked)
        asked = binary_cross_entropy_with_logits(self.asked(image)[..., 0], belongs_asked, on_tiles)
        seen = binary_cross_entropy_with_logits(self.seen(image.mean(1))[:, 0], torch.where(batch.used, side, 0.5))
        mean_word = (text * words[..., None]).sum(1) / words.sum(1, keepdim=True)
        told = binary_cross_entropy_with_logits(self.told(mean_word)[:, 0], side, 1 - used, reduction="sum")
        return {
            "concept": self._concept_loss(tiles, batch),
            "asked": asked * on_tiles.numel() / on_tiles.sum(),
            "seen": seen,
            "told": told / (1 - used).sum().clamp(min=1),
        }

    def _concept_loss(self, tiles: Tensor, batch: Batch) -> Tensor:
        losses = [
            cross_entropy(head(tiles).flatten(0, 1), batch.concepts[..., axis].flatten(), reduction="sum")
            for axis, head in enumerate(self.concept)
        ]
        return torch.stack(losses).sum() / (2 * len(batch.texts))


def _patch_cover(brush: Brush) -> Tensor:
    """(patches,) share of each patch that the tile of this side covers."""
    whole = torch.zeros(IMAGE_SIDE, IMAGE_SIDE)
    whole[brush.rows, brush.columns] = torch.from_numpy(brush.cover)
    patch = SIZE.vision.patch
    return nn.functional.avg_pool2d(whole[None], patch)[0].flatten()
