"""Which writer and which options of loading make each family's tiny checkpoint."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tests.hooks.families.eo1 import checkpoints as eo1_checkpoints
from tests.hooks.families.groot import checkpoints as groot_checkpoints
from tests.hooks.families.internvla import checkpoints as internvla_checkpoints
from tests.hooks.families.magma import checkpoints as magma_checkpoints
from tests.hooks.families.molmoact2 import checkpoints as molmoact2_checkpoints
from tests.hooks.families.pi0 import checkpoints as pi0_checkpoints
from tests.hooks.families.pi0 import pi05_checkpoints
from tests.hooks.families.pi0_fast import checkpoints as pi0_fast_checkpoints
from tests.hooks.families.prismatic import checkpoints as prismatic_checkpoints
from tests.hooks.families.smolvla import checkpoints as smolvla_checkpoints
from tests.hooks.families.spatialvla import checkpoints as spatialvla_checkpoints
from tests.hooks.families.xiaomi import checkpoints as xiaomi_checkpoints
from tests.hooks.families.xvla import checkpoints as xvla_checkpoints
from tests.support import vlm_checkpoints
from tests.support.slow_cases import slow_but

WRITERS: dict[str, tuple[Callable[[Path], Path], dict[str, Any]]] = {
    "pi0": (pi0_checkpoints.write_intact, {}),
    "pi05": (pi05_checkpoints.write_pi05, {}),
    "pi0-fast": (pi0_fast_checkpoints.write_pi0_fast, {}),
    "molmoact2": (molmoact2_checkpoints.write_molmoact2, {}),
    "groot": (groot_checkpoints.write_groot, {}),
    "xvla": (xvla_checkpoints.write_xvla, {}),
    "eo1": (eo1_checkpoints.write_eo1, {}),
    "smolvla": (smolvla_checkpoints.write_smolvla, {}),
    "openvla": (prismatic_checkpoints.write_checkpoint, {}),
    "prismatic": (prismatic_checkpoints.write_checkpoint, {}),
    "spatialvla": (spatialvla_checkpoints.write_checkpoint, {}),
    "magma": (magma_checkpoints.write_checkpoint, {"unnorm_key": "bridge_orig"}),
    "xiaomi-r0": (xiaomi_checkpoints.write_checkpoint, {"robot": "bridge_delta"}),
    "internvla-m1": (internvla_checkpoints.write_checkpoint, {"unnorm_key": "bridge_dataset"}),
    "paligemma": (vlm_checkpoints.write_paligemma, {}),
    "qwen2.5-vl": (vlm_checkpoints.write_qwen2_5_vl, {}),
    "qwen3-vl": (vlm_checkpoints.write_qwen3_vl, {}),
    "internvl": (vlm_checkpoints.write_internvl, {}),
    "ovis2.5": (vlm_checkpoints.write_ovis2_5, {}),
}
REPRESENTATIVES = ("pi0", "groot", "openvla", "magma", "qwen2.5-vl")
"""A family of each kind of checkpoint: lerobot's, nvidia's, Prismatic's, its authors', a VLM's of transformers."""


def families(names: Iterable[str] = WRITERS) -> list[Any]:
    """Return parameters of a test of what one function does for all families: the others' are slow."""
    return slow_but(REPRESENTATIVES, names)
