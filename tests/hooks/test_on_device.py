"""Every family on a device: captures and outputs equal those on the CPU.

The golden references are compared on the CPU; here the same adapter carries their meaning to another device. On a
machine without a GPU the case `cuda` skips, and `cpu` loads every family twice.
"""

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.hooks import AnswerModel, Policy, capture, load_model
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from tests.support.every_checkpoint import WRITERS

OF_LARGEST = 2e-3
"""Difference allowed, as a share of a site's largest value: other kernels, other roundings, layer after layer."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
@pytest.mark.parametrize("family", WRITERS)
def test_a_device_changes_nothing_but_roundings(family: str, device: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    checkpoint = str(write(tmp_path / family))
    on_cpu, on_device = captured(family, checkpoint, "cpu", options), captured(family, checkpoint, device, options)
    assert list(on_device) == list(on_cpu)
    for name, expected in on_cpu.items():
        largest = np.abs(expected).max()
        np.testing.assert_allclose(on_device[name], expected, rtol=0, atol=OF_LARGEST * largest, err_msg=name)


def captured(family: str, checkpoint: str, device: str, options: dict[str, Any]) -> dict[str, NDArray[np.float32]]:
    """Every residual site by name, and what the model put out."""
    model = load_model(family, checkpoint, device, "float32", **options)
    assert model.card.device.startswith(device)
    scene = SceneSpec()
    picture, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
    observation = Observation(picture, state, "Put the cube on the red shape", scene.intrinsics)
    roles = model.roles([observation]) if isinstance(model, Policy) else {}
    with capture(model, model.sites()) as activations:
        if isinstance(model, Policy):
            out = model.infer_without_acting([observation], [0])
        else:
            assert isinstance(model, AnswerModel)
            out = model.read([Prompt(observation, "Which of them is red?", ("a", "b"))]).option_logits
    activations_by_site = {str(site): activations[site].float().cpu().numpy() for site in model.sites()}
    for site in model.sites():
        if site.stream in roles:
            # What padding attends to, where a mask forbids it everything, is the kernel's choice.
            activations_by_site[str(site)] = activations_by_site[str(site)][
                :, ~roles[site.stream][0].mask("padding")
            ]
    del model
    gc.collect()
    return {**activations_by_site, "out": np.asarray(out)}
