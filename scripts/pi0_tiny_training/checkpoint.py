"""What surrounds a training: the statistics of its data, and its result as a checkpoint."""

from pathlib import Path

import numpy as np
import pandas as pd
import torch

from pi0_tiny_training.demonstrations import Demonstrations
from pi0_tiny_training.training import Trainer
from probe_kit.models.pi0_tiny import Statistics, write_checkpoint

LEAST_SPREAD = 1e-3


def measured_statistics(demonstrations: Demonstrations) -> Statistics:
    """Mean and standard deviation of actions and states; a state that never varies is left at its scale."""
    actions, states = demonstrations.chunks[:, 0], demonstrations.states
    spread = states.std(0)
    return {
        "action": (actions.mean(0), actions.std(0)),
        "observation.state": (states.mean(0), np.where(spread < LEAST_SPREAD, 1.0, spread)),
    }


def write_trained(
    folder: Path, trainer: Trainer, statistics: Statistics, dtype: torch.dtype = torch.float32
) -> None:
    """The policy as it stands, without the heads."""
    note = f"trained, {trainer.step} steps, seed {trainer.seed}"
    write_checkpoint(folder, trainer.policy.network, statistics, note, dtype)


def draw_losses(log: Path, picture: Path) -> None:
    """The loss curves of a training as a PNG file."""
    losses = pd.read_csv(log, index_col="step").rolling(10, min_periods=1).mean()
    axes = losses.plot(logy=True, figsize=(8, 4), ylim=(1e-3, None))
    axes.set(xlabel="step of 32 samples", ylabel="loss, mean of 200 steps")
    axes.figure.savefig(picture, dpi=120, bbox_inches="tight")
