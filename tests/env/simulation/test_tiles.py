import numpy as np
import pytest
from PIL import Image

from probe_kit.env.simulation import TEXTURE_PIXELS, BulletClient, TextureCache, as_texture, write_quad


@pytest.fixture
def client():
    client = BulletClient()
    yield client
    client.close()


def test_the_quad_is_a_square_of_the_given_side(tmp_path):
    write_quad(tmp_path / "quad.obj", 0.11)
    lines = (tmp_path / "quad.obj").read_text(encoding="utf-8").splitlines()
    corners = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.11, 0.11, 0.0])


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA"])
@pytest.mark.parametrize("size", [1, 64, 900])
def test_every_picture_becomes_a_texture_of_one_size(mode, size):
    assert as_texture(Image.new(mode, (size, size))).shape == (TEXTURE_PIXELS, TEXTURE_PIXELS, 3)


def test_equal_pictures_share_a_texture_and_different_ones_do_not(client, tmp_path):
    cache = TextureCache(client, tmp_path)
    red, copy, blue = (
        Image.new("RGB", (9, 9), "red"),
        Image.new("RGB", (9, 9), "red"),
        Image.new("RGB", (9, 9), "blue"),
    )
    assert cache.load(red) == cache.load(copy) != cache.load(blue)


def test_the_budget_counts_distinct_pictures(client, tmp_path):
    cache = TextureCache(client, tmp_path, budget=2)
    for color in ("red", "red", "blue"):
        assert cache.has_room(1)
        cache.load(Image.new("RGB", (9, 9), color))
    assert not cache.has_room(1)


def test_no_file_is_left_behind(client, tmp_path):
    TextureCache(client, tmp_path).load(Image.new("RGB", (9, 9), "red"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("preset", ["bridge", "frontal"])
def test_pictures_lie_upright_and_unmirrored(preset, make_env):
    picture = Image.new("RGB", (2, 2))
    picture.putdata([(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)])
    picture = picture.resize((64, 64), Image.Resampling.NEAREST)
    env = make_env(preset)
    env.reset(seed=0)
    scene, spec = env.scene, env.scene_spec
    scene.reset({"left": picture, "right": picture}, (*spec.cube_xy, 0.015), 0.0)
    frame = scene.frame()
    for side in ("left", "right"):
        turn = np.array(
            [[np.cos(spec.tile_yaw), -np.sin(spec.tile_yaw)], [np.sin(spec.tile_yaw), np.cos(spec.tile_yaw)]]
        )
        for dx, dy, color in ((1, 1, (1, 0, 0)), (1, -1, (0, 1, 0)), (-1, 1, (0, 0, 1)), (-1, -1, (1, 1, 1))):
            x, y = np.add(spec.tile_xy(side), turn @ [0.02 * dx, 0.02 * dy])
            u, v = scene.camera.project((x, y, spec.tile_height)).astype(int)
            np.testing.assert_array_equal(
                frame.rgb[v, u] > 100, np.array(color, bool), err_msg=f"{side} {dx} {dy}"
            )
