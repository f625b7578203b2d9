import numpy as np
import pybullet
import pytest

from probe_kit.env.scene import FLOOR_COLOR, TABLE_COLOR
from probe_kit.env.simulation import Camera
from probe_kit.env.spec import CameraSpec


def test_matrices_equal_those_of_pybullet():
    spec = CameraSpec()
    target = np.add(spec.eye, spec.forward)
    view = pybullet.computeViewMatrix(spec.eye, target, (0, 0, 1))
    projection = pybullet.computeProjectionMatrixFOV(spec.fov, spec.width / spec.height, spec.near, spec.far)
    np.testing.assert_allclose(Camera(spec).view_matrix(), view, atol=1e-6)
    np.testing.assert_allclose(Camera(spec).projection_matrix(), projection, atol=1e-6)


def test_the_focal_length_is_that_of_the_bridge_camera():
    assert CameraSpec().focal_length == pytest.approx(623.588, abs=0.001)


@pytest.mark.parametrize(
    ("point", "pixel"),
    [
        ((0.292, -0.006, 0.135), (330, 138)),  # tool of the WidowX at home
        ((0.247, 0.028, 0.015), (259, 292)),  # cube
        ((0.397, 0.183, 0.0), (211, 147)),  # left tile
        ((0.397, -0.127, 0.0), (519, 253)),  # right tile
    ],
)
def test_points_project_to_the_pixels_measured_in_the_reference_camera(point, pixel):
    np.testing.assert_allclose(Camera(CameraSpec()).project(point), pixel, atol=0.7)


def test_the_widened_view_shows_the_same_scene_with_a_margin():
    camera = Camera(CameraSpec())
    point = (0.35, 0.1, 0.02)
    np.testing.assert_allclose(camera.widened().project(point), np.add(camera.project(point), [320, 240]))


def test_rays_go_through_the_points_that_project_there():
    camera = Camera(CameraSpec())
    ray = camera.rays()[100, 200]
    np.testing.assert_allclose(camera.project(camera.spec.eye + 0.4 * ray), [200.5, 100.5], atol=1e-9)


def test_the_rendered_cube_is_where_the_projection_says(shared_env):
    shared_env.reset(seed=0)
    rows, columns = np.nonzero(shared_env.scene.frame().bodies == shared_env.scene.cube)
    spec = shared_env.scene_spec
    expected = shared_env.scene.camera.project((*spec.cube_xy, spec.cube_side / 2))
    # The outline of a cube is not centred on its middle, but close to it.
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=2.0)


def show_table(scene, visible):
    for body, color in ((scene.table, TABLE_COLOR), (scene.floor, FLOOR_COLOR)):
        scene.client.changeVisualShape(body, -1, rgbaColor=color if visible else (0, 0, 0, 0))


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bridge", "vl-think", "frontal"])
def test_the_layered_picture_equals_the_naive_rendering_bit_for_bit(preset, make_env):
    env = make_env(preset)
    env.reset(seed=0)
    for action in ([0, 0, 0, 0, 0, 0, 1], [0.1, 0.1, -0.1, 0.2, 0, 0.3, 0], [0, -0.1, -0.1, 0, 0.4, 0, 0]):
        layered = env.step(np.array(action))[0]["pixels"]["image"]
        show_table(env.scene, True)
        naive = env.scene.frame().rgb
        show_table(env.scene, False)
        np.testing.assert_array_equal(layered, naive)


@pytest.mark.parametrize("level", [0.7, 1.3])
def test_the_light_level_scales_the_brightness_of_the_table(level, make_env):
    plain, changed = make_env(), make_env(light_level=level)
    corner = np.s_[400:, :100]
    means = [env.reset(seed=0)[0]["pixels"]["image"][corner].mean() for env in (plain, changed)]
    assert means[1] / means[0] == pytest.approx(level, abs=0.02)


def test_a_white_picture_does_not_clip_at_the_brightest_light(make_env):
    env = make_env(light_level=1.3)
    env.reset(seed=0)
    frame = env.scene.frame()
    tile = frame.rgb[frame.bodies == env.scene.tiles["left"]]
    assert tile.max() < 255
