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
    place = str(write(tmp_path / family))
    here, there = captured(family, place, "cpu", options), captured(family, place, device, options)
    assert list(there) == list(here)
    for name, expected in here.items():
        largest = np.abs(expected).max()
        np.testing.assert_allclose(there[name], expected, rtol=0, atol=OF_LARGEST * largest, err_msg=name)


def captured(family: str, place: str, device: str, options: dict[str, Any]) -> dict[str, NDArray[np.float32]]:
    """Every residual site by name, and what the model put out."""
    model = load_model(family, place, device, "float32", **options)
    assert model.card.device.startswith(device)
    scene = SceneSpec()
    picture, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
    seen = Observation(picture, state, "Put the cube on the red shape", scene.intrinsics)
    roles = model.roles([seen]) if isinstance(model, Policy) else {}
    with capture(model, model.sites()) as activations:
        if isinstance(model, Policy):
            out = model.infer_without_acting([seen], [0])
        else:
            assert isinstance(model, AnswerModel)
            out = model.read([Prompt(seen, "Which of them is red?", ("a", "b"))]).option_logits
    found = {str(site): activations[site].float().cpu().numpy() for site in model.sites()}
    for site in model.sites():
        if site.stream in roles:
            # What padding attends to, where a mask forbids it everything, is the kernel's choice.
            found[str(site)] = found[str(site)][:, ~roles[site.stream][0].mask("padding")]
    del model
    gc.collect()
    return {**found, "out": np.asarray(out)}
