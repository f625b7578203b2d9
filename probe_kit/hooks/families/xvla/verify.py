"""Quantities in which X-VLA is compared with its golden reference: from raw picture and state to metres."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.shared.lerobot.policy import TOKENS
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.families.xvla.adapter import load_xvla
from probe_kit.hooks.verification.verify import Comparison, Produce, compare

TOLERANCE = 1e-5


def verify_xvla(folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
    """Run the recorded observation and noise through the adapter and compare everything."""
    policy = load_xvla(str(folder / "checkpoint"), dtype="float32")
    seen = Observation(recorded["in_image"], recorded["in_raw_state"], str(recorded["in_task"]))
    batch = policy.batch([seen])
    backbone, expert = policy.streams["backbone"], policy.streams["expert"]
    with ExitStack() as stack:
        predicted = outputs_of(policy.network.model.transformer.action_decoder, stack)
        tape = stack.enter_context(capture(policy, [*backbone.sites(), *expert.sites()]))
        actions = numpy_of(policy.infer(batch, torch.from_numpy(recorded["in_noise"])))
    produced: dict[str, Produce] = {
        "input_ids": lambda: numpy_of(batch[TOKENS]),
        "pixels": lambda: numpy_of(policy.network._prepare_images(batch)[0]),
        "backbone_resid": lambda: stacked(tape, backbone)[0],
        "expert_resid": lambda: stacked(tape, expert),
        "predicted": lambda: numpy_of(torch.stack(predicted)),
        "actions": lambda: actions,
        "actions_unnormalized": lambda: policy.action_units.restore(np.asarray(actions, np.float32)),
    }
    return compare(recorded, produced, TOLERANCE, {})
