"""Every family on a device: what is heard and what comes out there is what it is on the CPU.

The golden references are compared on the CPU; here the same adapter carries their meaning to another device. On a
machine without a GPU the case `cuda` skips, and `cpu` loads every family twice.
"""

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.extract.play.examples import example_observations
from probe_kit.hooks import Policy, Reader, capture, load_model
from probe_kit.hooks.model import Question
from tests import (
    internvla_checkpoints,
    magma_checkpoints,
    pi0_checkpoints,
    prismatic_checkpoints,
    smolvla_checkpoints,
    spatialvla_checkpoints,
    vlm_checkpoints,
    xiaomi_checkpoints,
)

BYTES = {"tokenizer": "bytes"}
WRITERS: dict[str, tuple[Callable[[Path], Path], dict[str, Any]]] = {
    "pi0": (pi0_checkpoints.write_intact, {}),
    "smolvla": (smolvla_checkpoints.write_smolvla, {}),
    "openvla": (prismatic_checkpoints.write_checkpoint, BYTES),
    "prismatic": (prismatic_checkpoints.write_checkpoint, BYTES),
    "spatialvla": (spatialvla_checkpoints.write_checkpoint, {}),
    "magma": (magma_checkpoints.write_checkpoint, {}),
    "xiaomi-r0": (xiaomi_checkpoints.write_checkpoint, {}),
    "internvla-m1": (internvla_checkpoints.write_checkpoint, {}),
    "paligemma": (vlm_checkpoints.write_paligemma, {}),
    "qwen2.5-vl": (vlm_checkpoints.write_qwen2_5_vl, {}),
    "qwen3-vl": (vlm_checkpoints.write_qwen3_vl, {}),
    "internvl": (vlm_checkpoints.write_internvl, {}),
    "ovis2.5": (vlm_checkpoints.write_ovis2_5, {}),
}
OF_LARGEST = 2e-3
"""Difference allowed, as a share of a site's largest value: other kernels, other roundings, layer after layer."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens that name no action")
@pytest.mark.parametrize("family", WRITERS)
def test_a_device_changes_nothing_but_roundings(family: str, device: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    place = str(write(tmp_path / family))
    here, there = heard(family, place, "cpu", options), heard(family, place, device, options)
    assert list(there) == list(here)
    for name, expected in here.items():
        largest = np.abs(expected).max()
        np.testing.assert_allclose(there[name], expected, rtol=0, atol=OF_LARGEST * largest, err_msg=name)


def heard(family: str, place: str, device: str, options: dict[str, Any]) -> dict[str, NDArray[np.float32]]:
    """Every residual site by name, and what the model put out."""
    model = load_model(family, place, device, "float32", **options)
    assert model.card.device.startswith(device)
    (seen,) = example_observations(SceneSpec(), ["Put the cube on the red shape"])
    with capture(model, model.sites()) as tape:
        if isinstance(model, Policy):
            out = model.listen([seen], [0])
        else:
            assert isinstance(model, Reader)
            out = model.read([Question(seen, "Which of them is red?", ("a", "b"))]).option_logits
    found = {str(site): tape[site].float().cpu().numpy() for site in model.sites()}
    del model
    gc.collect()
    return {**found, "out": np.asarray(out)}
