"""Quantities in which OpenVLA is compared with its golden references, beyond those of Prismatic."""

from functools import partial
from pathlib import Path

import numpy as np

from probe_kit.hooks.families.openvla.actions import ActionStatistics
from probe_kit.hooks.families.openvla.adapter import OpenVLA, load_openvla
from probe_kit.hooks.families.prismatic.verify import INPUTS, Arrays, Reference, compare_outputs
from probe_kit.hooks.verification.verify import Comparison, Produce
from probe_kit.models.prismatic import PrismaticConfig

_ACTION = "action_"
_WITHOUT_EMPTY = "prompt_ids_without_empty"


def verify_openvla(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Compare a reference of a policy; each recorded `action_<data set>` with that data set's statistics."""
    checkpoint = folder / "checkpoint"
    known = PrismaticConfig.from_folder(checkpoint).statistics
    keys = [key for key in known if _ACTION + key in recorded]
    policy = load_openvla(str(checkpoint), unnorm_key=next(iter(keys or known), None))
    reference = Reference(policy, recorded, _prompt(policy, recorded))
    inputs = INPUTS if _WITHOUT_EMPTY in recorded else {*INPUTS, "input_ids"}
    return compare_outputs(policy, recorded, reference.produced() | _actions(policy, reference, keys), inputs)


def _prompt(policy: OpenVLA, recorded: Arrays) -> list[int]:
    """The recorded ids; where they are recorded without the empty token, the adapter adds it."""
    if _WITHOUT_EMPTY in recorded:
        return policy.with_empty_token(recorded[_WITHOUT_EMPTY].ravel().tolist())
    ids: list[int] = recorded["input_ids"].ravel().tolist()
    return ids


def _actions(policy: OpenVLA, reference: Reference, keys: list[str]) -> dict[str, Produce]:
    ids = reference.decoded.ids[0].numpy()
    tokens, vocabulary = policy.action_tokens, int(policy.config.text.vocab_size)
    produced: dict[str, Produce] = {"detok_table": lambda: tokens.values(np.arange(vocabulary))}
    for key in keys:
        statistics = ActionStatistics.choose(policy.loaded.statistics, key)
        produced[_ACTION + key] = partial(statistics.restore, tokens.values(ids))
    return produced
