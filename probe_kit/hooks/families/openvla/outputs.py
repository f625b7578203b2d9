"""Quantities in which OpenVLA is compared with its golden references, beyond those of Prismatic."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from probe_kit.hooks.families.openvla.adapter import OpenVLA
from probe_kit.hooks.families.prismatic.checkpoint import prismatic_statistics
from probe_kit.hooks.families.prismatic.outputs import INPUTS, Reference
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics
from probe_kit.hooks.verification.outputs import Arrays, Outputs, Produce
from probe_kit.models.prismatic import PrismaticConfig

_ACTION = "action_"
_WITHOUT_EMPTY = "prompt_ids_without_empty"


def openvla_outputs(load: Callable[..., OpenVLA], folder: Path, recorded: Arrays) -> Outputs:
    """Compare a reference of a policy; each recorded `action_<data set>` with that data set's statistics.

    The adapter adds the empty token to ids that are recorded without it.
    """
    checkpoint = folder / "checkpoint"
    by_data_set = PrismaticConfig.from_folder(checkpoint).statistics
    keys = [key for key in by_data_set if _ACTION + key in recorded]
    policy = load(str(checkpoint), unnorm_key=next(iter(keys or by_data_set), None))
    added = _WITHOUT_EMPTY in recorded
    ids: list[int] = recorded[_WITHOUT_EMPTY if added else "input_ids"].ravel().tolist()
    reference = Reference(policy, recorded, policy.with_empty_token(ids) if added else ids)
    values = policy.action_tokens.values(reference.decoded.ids[0].numpy())
    statistics, _ = prismatic_statistics(policy.config, policy.loaded.folders)
    produced: dict[str, Produce] = {
        _ACTION + key: partial(ActionStatistics.choose(statistics, key).restore, values) for key in keys
    }
    every = np.arange(int(policy.config.text.vocab_size))
    inputs = INPUTS if added else (*INPUTS, "input_ids")
    return reference.outputs(inputs, detok_table=lambda: policy.action_tokens.values(every), **produced)
