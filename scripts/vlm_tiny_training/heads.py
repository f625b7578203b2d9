"""Auxiliary heads that exist only early in the VLM's training, until it sees and finds; the policy has none."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, binary_cross_entropy_with_logits, cross_entropy

from probe_kit.hooks.families.embedded import IMAGE_SIDE, SIZE
from vlm_tiny_training.batches import Pair
from vlm_tiny_training.painting import Place, Surface

SEES_PICTURE, MOSTLY_PICTURE = 0.25, 0.60
"""Share of a patch that a picture covers, from which its position belongs to the picture, or describes it."""


@dataclass(frozen=True)
class Looked:
    """What a batch showed: per sample the pair, the side of the asked picture, and the surface."""

    pairs: Sequence[Pair]
    sides: Sequence[int]
    surfaces: Sequence[str]


@dataclass
class Captured:
    """What a pass left, with gradients: what the projector put out, and what entered the last block."""

    projected: list[Tensor] = field(default_factory=list)
    middle: list[Tensor] = field(default_factory=list)


@contextmanager
def capturing(network: nn.Module) -> Iterator[Captured]:
    """Capture both in the pass inside."""
    captured, model = Captured(), network.model

    def projector(_module: nn.Module, _inputs: object, output: Tensor) -> None:
        captured.projected.append(output)

    def entering(_module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        captured.middle.append(inputs[0])

    handles = [
        model.multi_modal_projector.register_forward_hook(projector),
        model.language_model.layers[-1].input_layernorm.register_forward_pre_hook(entering),
    ]
    try:
        yield captured
    finally:
        for handle in handles:
            handle.remove()


class Heads(nn.Module):
    """Linear readouts, and the losses that make them right.

    named: what each picture is called, from its own patches where they enter the backbone.
    asked: whether a patch belongs to the asked picture, at the entrance of the last block.
    """

    def __init__(self, phrases: Sequence[str], surfaces: Mapping[str, Surface]) -> None:
        super().__init__()
        self._number = {phrase: number for number, phrase in enumerate(phrases)}
        self.named = nn.Linear(SIZE.vlm.width, len(phrases))
        self.asked = nn.Linear(SIZE.vlm.width, 1)
        cover = {
            name: torch.stack([_cover(area) for area in surface.places]) for name, surface in surfaces.items()
        }
        self._describes = {name: (mask >= MOSTLY_PICTURE).float() for name, mask in cover.items()}
        self._belongs = {name: (mask >= SEES_PICTURE).float() for name, mask in cover.items()}

    def losses(self, captured: Captured, looked: Looked, names_one: bool) -> dict[str, Tensor]:
        """Both, of one batch. names_one: whether its questions name one of the pictures, the asked one."""
        (projected,), (middle,) = captured.projected, captured.middle
        describes = torch.stack([self._describes[name] for name in looked.surfaces])
        belongs = torch.stack([self._belongs[name] for name in looked.surfaces])
        region_features = torch.einsum("bsp,bpw->bsw", describes / describes.sum(2, keepdim=True), projected)
        names = torch.tensor([
            [self._number[pair.phrases[int(side_index != side)]] for side_index in (0, 1)]
            for pair, side in zip(looked.pairs, looked.sides, strict=True)
        ])  # fmt: skip
        naming_loss = cross_entropy(self.named(region_features).flatten(0, 1), names.flatten())
        if not names_one:
            return {"head named": naming_loss}
        patches = belongs.shape[2]
        rows = torch.arange(len(names))
        target = belongs[rows, torch.tensor(looked.sides)]
        on_pictures = belongs.sum(1).clamp(max=1)
        asking_loss = binary_cross_entropy_with_logits(
            self.asked(middle[:, :patches])[..., 0], target, on_pictures, reduction="sum"
        )
        return {"head named": naming_loss, "head asked": asking_loss / on_pictures.sum()}


def _cover(area: Place) -> Tensor:
    """(patches,) share of each patch that a picture in this place covers."""
    picture = torch.zeros(IMAGE_SIDE, IMAGE_SIDE)
    picture[area.rows, area.columns] = torch.from_numpy(area.cover)
    return avg_pool2d(picture[None], SIZE.vision.patch)[0].flatten()
