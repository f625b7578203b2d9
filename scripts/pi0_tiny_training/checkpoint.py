"""What surrounds a training: the statistics of its data, and its result as a checkpoint."""

from pathlib import Path

import numpy as np

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


def write_trained(folder: Path, trainer: Trainer, statistics: Statistics) -> None:
    """The policy as it stands, without the heads."""
    note = f"trained, {trainer.step} steps, seed {trainer.seed}"
    write_checkpoint(folder, trainer.policy.network, statistics, note)
