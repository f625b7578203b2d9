from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.models.spatialvla import PositionEmbedding3D, back_project, point_places


@pytest.mark.parametrize(("side", "patch", "points"), [(56, 14, 2), (48, 16, 4), (42, 14, 1)])
def test_points_project_back_to_the_middles_of_a_patchs_parts(side: int, patch: int, points: int) -> None:
    """Seen through the camera again, every point lies where it was measured, at the depth of its part."""
    generator = torch.Generator().manual_seed(0)
    camera = torch.tensor([[210.0, 0, 25.8], [0, 123.2, 25.2], [0, 0, 1]])
    metres = 1 + torch.rand((2, 1, side, side), generator=generator)
    found = back_project(metres, camera, patch, points).double()
    part, along = patch // points, side // patch
    for row in range(2):
        for index in range(along**2):
            top, left = index // along * patch, index % along * patch
            for inner in range(points**2):
                y, x = top + inner // points * part, left + inner % points * part
                point = found[row, index, 3 * inner : 3 * inner + 3]
                depth = metres[row, 0, y : y + part, x : x + part].double().mean()
                seen = camera.double() @ point
                assert point[2] == pytest.approx(float(depth), abs=1e-6)
                middle = [x + part / 2, y + part / 2]
                np.testing.assert_allclose((seen[:2] / seen[2]).numpy(), middle, atol=1e-4)


def test_every_row_may_have_its_own_camera() -> None:
    metres = torch.ones(2, 1, 28, 28)
    cameras = torch.stack([torch.diag(torch.tensor([focal, focal, 1.0])) for focal in (10.0, 20.0)])
    both = back_project(metres, cameras, 14, 2)
    torch.testing.assert_close(both[0, :, 0], 2 * both[1, :, 0])
    torch.testing.assert_close(both[1], back_project(metres[:1], cameras[1], 14, 2)[0])


def test_the_code_is_a_value_then_sines_then_cosines_of_doubling_frequency() -> None:
    embedding = PositionEmbedding3D(6, 8, 4)
    points = torch.rand((1, 2, 6), generator=torch.Generator().manual_seed(1)) * 4
    code = embedding.code(points)
    assert code.shape == (1, 2, 6 * 9)
    for axis in range(6):
        placed = (points[0, 1, axis] - (2 if axis % 3 == 2 else 0)) / 2
        angles = [placed * 2**k for k in range(4)]
        expected = torch.stack([placed, *(torch.sin(a) for a in angles), *(torch.cos(a) for a in angles)])
        torch.testing.assert_close(code[0, 1, 9 * axis : 9 * axis + 9], expected)
    assert embedding(points).shape == (1, 2, 8)


def test_the_places_of_the_original_are_reproduced(golden_spatialvla: Path) -> None:
    with np.load(golden_spatialvla / "reference.npz") as arrays:
        places, metres, camera, points = (arrays[name] for name in ("uv_h", "depth", "intrinsic", "xyz"))
    side = metres.shape[-1]
    patch = side // int(points.shape[1] ** 0.5)
    resolution = int((points.shape[2] / 3) ** 0.5)
    np.testing.assert_array_equal(point_places(side, patch, resolution).numpy(), places)
    found = back_project(torch.from_numpy(metres), torch.from_numpy(camera), patch, resolution)
    np.testing.assert_allclose(found.numpy(), points, rtol=0, atol=5e-5)
