"""Reasons why a capture changes what a model puts out, found by repeating the inference; torch's fused encoder.

`torch.nn.TransformerEncoder` computes with fused kernels while no hook is registered in it. With hooks it runs its
submodules, and the rounding differs. `Family.load` switches these kernels off, so that both ways are the same.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray

Infer = Callable[[], NDArray[np.float32]]


def switch_off_fused_encoder() -> None:
    """Let every `nn.TransformerEncoder` of this process run its submodules, with and without hooks."""
    torch.backends.mha.set_fastpath_enabled(False)


@contextmanager
def without_fused_encoder() -> Iterator[None]:
    """The same inside the body; afterwards it is as it was."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)


def reason_of_change(infer: Infer, plain: NDArray[np.float32], infer_captured: Infer) -> str:
    """Why an inference under capture differs from `plain`, and what to change, as sentences.

    infer: the inference without hooks, whose output `plain` is, of any shape. infer_captured: the same with hooks.
    Both are repeated at most once.
    """
    if not same_bits(infer(), plain):
        return (
            "Without hooks the same inference does not repeat either. The adapter keeps state between calls, or "
            "its model is not deterministic: take all randomness from the seeds, and reset caches at every call"
        )
    with without_fused_encoder():
        repaired = same_bits(infer(), infer_captured())
    if repaired:
        return (
            "The cause is torch's fused encoder: nn.TransformerEncoder computes with other kernels while it has "
            "no hooks. Call torch.backends.mha.set_fastpath_enabled(False) in the loader, or load the model with "
            "probe_kit.hooks.load_model, which does so"
        )
    return (
        "Without hooks the same inference repeats bit for bit. A module computes in another way while it has "
        "hooks, as fused and compiled modules do: switch that off in the loader"
    )


def same_bits(array: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    """Equal shape, type and bytes; NaN equals itself."""
    return array.shape == other.shape and array.dtype == other.dtype and array.tobytes() == other.tobytes()
