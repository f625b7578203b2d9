"""What surrounds the training: the statistics of its data, where the policy starts, and its results."""

from pathlib import Path

import numpy as np
from safetensors.torch import load_file

from acting_training.demonstrations import Demonstrations
from probe_kit.hooks.families.embedded import Statistics, new_pi0_tiny, write_checkpoint
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.embedded import embedded_checkpoint

LEAST_SPREAD = 1e-2
"""Metres, radians or openness: less is tremor of the arm."""
VLM = "vlm-tiny"


def measured_statistics(demonstrations: Demonstrations) -> Statistics:
    """Mean and standard deviation of actions and states; a state that never varies is left at its scale."""
    actions, states = demonstrations.chunks[:, :, 0].reshape(-1, 7), demonstrations.states
    spread = states.std(0)
    return {
        "action": (actions.mean(0), actions.std(0)),
        "observation.state": (states.mean(0), np.where(spread < LEAST_SPREAD, 1.0, spread)),
    }


def start_of_policy(folder: Path, seed: int, statistics: Statistics) -> Pi0:
    """A policy whose backbone is the embedded VLM's, weight by weight, and whose expert is random."""
    network = new_pi0_tiny(seed)
    vlm = load_file(embedded_checkpoint(VLM) / "model.safetensors")
    backbone = network.model.paligemma_with_expert.paligemma
    vlm["lm_head.weight"] = vlm["model.language_model.embed_tokens.weight"]
    backbone.load_state_dict(vlm)
    write_checkpoint(folder, network, statistics, f"the backbone of {VLM}, random expert, seed {seed}")
    return Pi0.load(str(folder))
