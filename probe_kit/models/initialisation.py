"""Seeded random weights, for the embedded policy and for untrained controls of any family."""

import numpy as np
import torch
from torch import nn

from probe_kit.models.sizes_only import builds_sizes_only


@torch.no_grad()
def initialise(network: nn.Module, seed: int) -> None:
    """Fill every parameter with random numbers of a scale that keeps activations of order one.

    Matrices N(0, 1/fan_in), residual outputs half of that, embeddings 1/sqrt(width), position embeddings
    0.5, biases zero, norms untouched. Drawn by numpy in name order, so that a seed means the same bits
    on every machine.
    """
    if builds_sizes_only():
        return
    rng = np.random.Generator(np.random.PCG64(seed))
    residual_outputs = ("o_proj.weight", "out_proj.weight", "down_proj.weight", "fc2.weight")
    for name, parameter in sorted(network.named_parameters()):
        if parameter.ndim < 2:
            if name.endswith("bias"):
                parameter.zero_()  # torch draws them from its global generator
            continue
        scale = 1 / float(np.sqrt(parameter[0].numel()))
        if "position_embedding" in name or "pos_embed" in name:
            scale = 0.5
        elif name.endswith(residual_outputs):
            scale /= 2
        values = rng.standard_normal(tuple(parameter.shape), dtype=np.float32) * np.float32(scale)
        parameter.copy_(torch.from_numpy(values))
