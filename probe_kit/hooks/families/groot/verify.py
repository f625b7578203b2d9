"""Quantities in which GR00T is compared with its golden reference: from raw picture and state to metres."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.groot.adapter import load_groot
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.verification.verify import Comparison, Produce, compare

TOLERANCE = 1e-5


def verify_groot(folder: Path, recorded: Mapping[str, NDArray[Any]]) -> tuple[Comparison, ...]:
    """Run the recorded observation and noise through the adapter and compare everything."""
    policy = load_groot(str(folder / "checkpoint"), dtype="float32")
    seen = Observation(recorded["in_image"], recorded["in_raw_state"], str(recorded["in_task"]))
    batch, noise = policy.batch([seen]), torch.from_numpy(recorded["in_noise"])
    end = policy.streams["backbone"].sites()[-1:]
    sites = [*end, *policy.streams["backbone"].sites("final_norm")]
    sites += [*policy.streams["bridge"].sites(), *policy.streams["expert"].sites()]
    with ExitStack() as stack:
        decoded = outputs_of(policy.network._groot_model.action_head.action_decoder, stack)
        tape = stack.enter_context(capture(policy, sites))
        actions = numpy_of(policy.infer(batch, noise))
    produced: dict[str, Produce] = {
        **{name: lambda name=name: numpy_of(batch[name]) for name in ("input_ids", "pixel_values", "state")},  # type: ignore[misc]
        "backbone_end": lambda: numpy_of(tape[end[0]]),
        "backbone_final_norm": lambda: stacked(tape, policy.streams["backbone"], "final_norm")[0, 0],
        "bridge_resid": lambda: stacked(tape, policy.streams["bridge"])[0],
        "expert_resid": lambda: stacked(tape, policy.streams["expert"]),
        "velocity": lambda: numpy_of(torch.stack(decoded)[:, :, -noise.shape[1] :]),
        "actions": lambda: actions,
        "actions_unnormalized": lambda: policy.action_units.restore(np.asarray(actions, np.float32)),
    }
    return compare(recorded, produced, TOLERANCE, {})
