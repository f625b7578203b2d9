import numpy as np
import pytest
from PIL import Image

from probe_kit.env.simulation import Camera, load_photo, wooden_table
from probe_kit.env.spec import CameraSpec
from probe_kit.errors import SceneError


def test_our_table_is_the_same_every_time_and_not_uniform():
    picture = wooden_table(Camera(CameraSpec()))
    assert picture.shape == (480, 640, 3)
    np.testing.assert_array_equal(picture, wooden_table(Camera(CameraSpec())))
    assert picture.std() > 10


def test_our_table_follows_the_camera():
    near, far = CameraSpec(), CameraSpec(eye=(-0.3, -0.16, 0.6))
    assert np.abs(wooden_table(Camera(near)).astype(int) - wooden_table(Camera(far))).mean() > 3


def test_visual_matching_changes_the_table_and_nothing_on_it(make_env):
    raw, matched = make_env(), make_env(rendering="visual-matching")
    pictures = [env.reset(seed=0)[0]["pixels"]["image"] for env in (raw, matched)]
    on_table = raw.scene.frame().bodies >= 0
    np.testing.assert_array_equal(pictures[0][on_table], pictures[1][on_table])
    table = wooden_table(raw.scene.camera)
    np.testing.assert_array_equal(pictures[1][~on_table], table[~on_table])


def test_a_photo_of_ones_own_is_squeezed_behind_the_scene(make_env, tmp_path):
    Image.new("RGB", (100, 300), (10, 200, 30)).save(tmp_path / "photo.png")
    env = make_env(rendering="visual-matching", background=tmp_path / "photo.png", light_level=0.7)
    corner = env.reset(seed=0)[0]["pixels"]["image"][-5:, :5].reshape(-1, 3)
    assert np.unique(corner, axis=0).tolist() == [[7, 140, 21]]


@pytest.mark.parametrize("content", [None, b"", b"no picture"])
def test_a_missing_or_broken_photo_is_named(content, tmp_path):
    path = tmp_path / "photo.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=r"photo\.png"):
        load_photo(path, 8, 8)
