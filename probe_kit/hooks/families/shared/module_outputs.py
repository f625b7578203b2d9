"""Outputs of modules beyond the sites, and captures as arrays, for the verification of native families."""

from contextlib import ExitStack
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.contract.sites import Stream


def outputs_of(module: nn.Module, stack: ExitStack) -> list[Any]:
    """A list that fills with copies of what `module` puts out, until `stack` is left; no tensor: as it is."""
    outputs: list[Any] = []

    def keep(_module: nn.Module, _inputs: object, output: Any) -> None:
        outputs.append(output.detach().clone() if isinstance(output, Tensor) else output)

    stack.callback(module.register_forward_hook(keep).remove)
    return outputs


def stacked(tape: ActivationCache, stream: Stream, quantity: str = "residual") -> NDArray[Any]:
    """(iterations or 1, layers, B, T, D) of one quantity."""
    sites = stream.sites(quantity)
    values = torch.stack([tape[site] for site in sites])
    steps = stream.iterations or 1
    return numpy_of(values.reshape(steps, len(sites) // steps, *values.shape[1:]))


def numpy_of(tensor: Tensor) -> NDArray[Any]:
    """On the CPU; floating point as float32."""
    return np.asarray(tensor.float().cpu().numpy() if tensor.is_floating_point() else tensor.cpu().numpy())
