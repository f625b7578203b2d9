"""Frequencies of sinusoidal time embeddings."""

import math

import torch
from torch import Tensor


def frequencies(count: int, longest: float) -> Tensor:
    """(count,) float32 angular frequencies on the CPU, geometrically from 1 down to nearly 1 / `longest`.

    The exponents are float32, as in the original implementations, and their exponential is rounded correctly: that
    of torch differs in the last bit between versions and processors, and a time of 600 makes 600 times that of it.
    """
    exponents = -math.log(longest) * torch.arange(count, dtype=torch.float32) / count
    return torch.exp(exponents.double()).float()
