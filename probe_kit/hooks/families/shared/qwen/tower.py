"""Taps of a vision tower that runs over the patches of all pictures at once, as Qwen's towers do."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from probe_kit.hooks.contract.model import Tap


def tower_tap(tower: Any, layer: int, view: Callable[[Tensor], Tensor]) -> Tap:
    """The first norm of a block, or the merger's norm, which reads the last one; patches in the tower's order.

    view: from patches (N, D) to the activation of a site.
    """
    if layer < len(tower.blocks):
        return Tap(tower.blocks[layer].norm1, 1, view=view)
    merger = tower.merger
    return Tap(merger.ln_q if hasattr(merger, "ln_q") else merger.norm, 1, view=view)


def by_picture(patches: Tensor, grid: Tensor | None) -> Tensor:
    """(pictures, patches of one, D) of (patches, D); (1, patches, D) where pictures differ in size.

    grid: (pictures, 3) patches of each picture along time, height and width.
    """
    count = 1 if grid is None or bool((grid != grid[0]).any()) else len(grid)
    return patches.view(count, -1, patches.shape[-1])
