"""Quantities in which MolmoAct2 is compared with its golden references: from raw pictures and states to metres."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.molmoact2.adapter import load_molmoact2
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.verification.verify import Comparison, Produce, compare

TOLERANCE = 1e-5


def verify_molmoact2(folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
    """Run the recorded observations and noise through the adapter and compare everything."""
    policy = load_molmoact2(str(folder / "checkpoint"))
    rows = zip(recorded["in_image_image"], recorded["in_raw_state"], recorded["in_tasks"], strict=True)
    batch = policy.batch([Observation(image, state, str(task)) for image, state, task in rows])
    kv = policy.every_stream()["kv"]
    sites = [site for part in ("keys", "values") for site in kv.sites(part)]
    sites += [*policy.further_streams["vision"].sites(), *policy.sites(), *policy.sites("final_norm")]
    with ExitStack() as stack:
        velocity = outputs_of(policy.network._backbone().action_expert.final_layer, stack)
        tape = stack.enter_context(capture(policy, sites))
        actions = numpy_of(policy.infer(batch, torch.from_numpy(recorded["in_noise"])))
    backbone, expert = policy.streams["backbone"], policy.streams["expert"]
    produced: dict[str, Produce] = {
        "input_ids": lambda: numpy_of(batch["input_ids"]),
        "attention_mask": lambda: numpy_of(batch["attention_mask"]),
        "pixel_values": lambda: numpy_of(batch["pixel_values"]),
        "vision_resid": lambda: stacked(tape, policy.further_streams["vision"])[0],
        "backbone_resid": lambda: stacked(tape, backbone)[0][:-1],
        "backbone_final_norm": lambda: stacked(tape, backbone, "final_norm")[0, 0],
        "keys": lambda: stacked(tape, kv, "keys")[0],
        "values": lambda: stacked(tape, kv, "values")[0],
        "expert_resid": lambda: stacked(tape, expert),
        "expert_final_norm": lambda: stacked(tape, expert, "final_norm")[:, 0],
        "velocity": lambda: numpy_of(torch.stack(velocity)),
        "actions": lambda: actions,
        "actions_unnormalized": lambda: policy.action_units.restore(np.asarray(actions, np.float32)),
    }
    return compare(recorded, produced, TOLERANCE, {})
