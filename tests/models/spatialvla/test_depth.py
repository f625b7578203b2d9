from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from probe_kit.hooks.checkpoints.weights import load_weights, read_weights
from probe_kit.models.spatialvla import (
    DEPTH_SIDE,
    MARGIN,
    SpatialVLAConfig,
    SpatialVLANetwork,
    build_spatialvla,
    depth_input,
    estimate_depth,
)
from tests.support.spatialvla_checkpoints import SIDE, network


def pictures() -> Tensor:
    """A dark, a bright and a striped one."""
    noise = torch.rand((3, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(0))
    noise[0] *= 0.2
    noise[1] = 1 - 0.2 * noise[1]
    noise[2, :, ::7] = 0
    return noise


@pytest.fixture
def divided() -> SpatialVLANetwork:
    """A network whose depth head takes one of the pictures for another domain than the other two."""
    made = network(seed=2)
    with torch.inference_mode():
        logits = estimate_depth(made.vision_zoe_model, pictures()).domains
    assert logits is not None
    difference = (logits[:, 1] - logits[:, 0]).sort().values
    between = float(difference[:2].mean())
    with torch.no_grad():
        made.vision_zoe_model.metric_head.mlp_classifier.linear2.bias[0] += between
    return made


@torch.inference_mode()
def test_a_picture_has_the_depth_it_has_alone_whatever_else_is_in_the_batch(divided: SpatialVLANetwork) -> None:
    zoe = divided.vision_zoe_model
    together = estimate_depth(zoe, pictures())
    assert together.domains is not None
    assert len(together.domains.argmax(dim=-1).unique()) == 2
    alone = [estimate_depth(zoe, picture[None]) for picture in pictures()]
    for row, single in enumerate(alone):
        torch.testing.assert_close(together.metres[row], single.metres[0], rtol=0, atol=1e-5)


@torch.inference_mode()
def test_the_originals_vote_gives_the_minority_another_head(divided: SpatialVLANetwork) -> None:
    zoe = divided.vision_zoe_model
    own, voted = estimate_depth(zoe, pictures()), estimate_depth(zoe, pictures(), vote=True)
    assert own.domains is not None
    minority = own.domains.argmax(dim=-1) != own.domains.sum(dim=0).argmax()
    torch.testing.assert_close(own.raw[~minority], voted.raw[~minority], rtol=0, atol=1e-5)
    assert (own.raw[minority] - voted.raw[minority]).abs().max() > 1e-3


@torch.inference_mode()
def test_a_depth_network_of_one_head_needs_no_vote() -> None:
    values = network().config.depth.to_dict()
    values["bin_configurations"] = values["bin_configurations"][:1]
    made = network(vision_zoe_config=values)
    depth = estimate_depth(made.vision_zoe_model, pictures())
    assert depth.domains is None
    assert depth.metres.shape == (3, 1, SIDE, SIDE)


def test_the_margin_is_a_mirror_and_the_range_is_minus_one_to_one() -> None:
    picture = torch.zeros(1, 3, 64, 64)
    picture[..., :, 10] = 1  # a line; its mirror image lies as far beyond the edge
    seen = depth_input(picture)
    assert seen.shape == (1, 3, DEPTH_SIDE, DEPTH_SIDE)
    scale = (DEPTH_SIDE - 1) / (64 + 2 * MARGIN - 1)
    bright = seen[0, 0, 200] > 0
    for place in (MARGIN + 10, MARGIN - 10):
        assert bright[round(place * scale)]
    torch.testing.assert_close(depth_input(torch.full((1, 3, 64, 64), 0.5)), torch.zeros(1, 3, 384, 384))


@torch.inference_mode()
def test_the_depth_of_the_original_is_reproduced(golden_spatialvla: Path) -> None:
    folder = golden_spatialvla / "checkpoint"
    made = build_spatialvla(SpatialVLAConfig.from_folder(folder), torch.float32)
    weights = read_weights(folder)
    load_weights(made, weights, weights.tensors, assign=True)
    with np.load(golden_spatialvla / "reference.npz") as arrays:
        recorded = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    pixels = recorded["pixel_values"]
    torch.testing.assert_close(depth_input(pixels)[..., ::8, ::8], recorded["zoe_pixel_values_sub"])
    depth = estimate_depth(made.vision_zoe_model, pixels)
    torch.testing.assert_close(depth.metres, recorded["depth"], rtol=0, atol=5e-5)
    torch.testing.assert_close(depth.domains, recorded["domain_logits"], rtol=0, atol=5e-5)
