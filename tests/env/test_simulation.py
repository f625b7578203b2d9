"""Small pictures of a film are those of a whole drawing, and leave no trace in what a policy gets."""

import re
import sys
from pathlib import Path
from subprocess import run

import numpy as np
import pybullet
import pytest
from PIL import Image

from probe_kit._system.imports import install_command
from probe_kit.env.scene import FLOOR_COLOR, TABLE_COLOR
from probe_kit.env.simulation import (
    TEXTURE_PIXELS,
    BulletClient,
    Camera,
    LayeredFrame,
    TextureCache,
    as_texture,
    load_photo,
    wooden_table,
    write_quad,
)
from probe_kit.env.spec import CameraSpec
from probe_kit.errors import SceneError


def test_this_pybullet_was_compiled_with_numpy():
    assert pybullet.isNumpyEnabled()


def test_a_pybullet_without_numpy_is_announced_with_its_remedy(monkeypatch):
    monkeypatch.setattr(pybullet, "isNumpyEnabled", lambda: 0)
    with pytest.warns(UserWarning, match=re.escape(install_command(rebuild="pybullet"))):
        BulletClient().close()


def test_two_clients_do_not_see_each_others_bodies():
    first_client, other = BulletClient(), BulletClient()
    first_client.createMultiBody(1.0)
    assert (first_client.getNumBodies(), other.getNumBodies()) == (1, 0)
    first_client.close()
    other.close()


def test_closing_twice_is_fine_and_spares_the_others():
    first_client, other = BulletClient(), BulletClient()
    first_client.close()
    first_client.close()
    assert other.getNumBodies() == 0
    other.close()


def test_making_an_environment_loads_neither_the_simulator_nor_torch():
    code = (
        "import sys, probe_kit.env; probe_kit.env.Act2AnswerEnv(); "
        "print({'pybullet', 'torch', 'lerobot'} & set(sys.modules))"
    )
    root = Path(__file__).parents[2]
    assert (
        run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", cwd=root).stdout.strip()
        == "set()"
    )


def test_pictures_arrive_as_arrays():
    client = BulletClient()
    picture = client.getCameraImage(4, 4, renderer=client.ER_TINY_RENDERER)[2]
    assert isinstance(picture, np.ndarray)
    client.close()


SIMULATES = "from probe_kit.env import Act2AnswerEnv; env = Act2AnswerEnv(); env.reset(seed=0); env.close()"


@pytest.mark.slow
def test_the_simulator_starts_in_silence_on_both_streams():
    completed = run([sys.executable, "-c", SIMULATES], capture_output=True, check=True)
    assert (completed.stdout, completed.stderr) == (b"", b"")


@pytest.mark.slow
def test_what_others_say_while_it_is_imported_is_passed_on(tmp_path):
    (tmp_path / "pybullet.py").write_text(
        "import os, sys\nos.write(2, b'pybullet build time: today\\nby C\\n')\nsys.stderr.write('by Python\\n')\n",
        encoding="utf-8",
    )
    code = "from probe_kit.env.simulation import import_pybullet as load; load(); load()"
    completed = run(
        [sys.executable, "-c", code], capture_output=True, check=True, env={"PYTHONPATH": str(tmp_path)}
    )
    assert completed.stderr == b"by C\nby Python\n"


@pytest.mark.slow
def test_it_can_be_imported_by_a_process_without_stderr():
    code = (
        "import os; os.close(2); from probe_kit.env.simulation import BulletClient; BulletClient(); print('there')"
    )
    assert run([sys.executable, "-c", code], stdout=-1, check=True).stdout == b"there\n"


def test_pybullet_is_imported_in_one_place():
    package = Path(__file__).parents[2] / "probe_kit"
    importing = re.compile(r"^\s*(import pybullet\b|from pybullet\b)", re.MULTILINE)
    assert [path for path in package.rglob("*.py") if importing.search(path.read_text(encoding="utf-8"))] == []


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
        naive = env.scene.camera.render(env.scene.client, env.scene.spec.light, env.scene.spec.light_level).rgb
        show_table(env.scene, False)
        np.testing.assert_array_equal(layered, naive)


def frames_of_episodes(env, *, draws_all):
    """Frames of three episodes, some in the exchanged layout and some of an episode that is played again."""
    random = np.random.default_rng(3)
    frames = []

    def look(number=None):
        if draws_all:
            env.scene._home, env.scene._layers._latest = (), None
        frames.append(env.scene.frame(number))

    for seed in range(3):  # the third start that is alike is the first whose arm was drawn before
        env.reset(seed=seed)
        look(0)
        with env.scene.exchanged():
            look()
        for step in range(6):
            env.advance(np.r_[random.uniform(-0.08, 0.08, 3), random.uniform(-0.5, 0.5, 3), 1.0])
            look(step // 2 if seed else None)
            if step % 3 == 0:
                env.scene.small_picture(HEIGHT)
        with env.scene.exchanged():
            look()
    return frames


@pytest.mark.parametrize(
    "preset",
    ["bridge", *(pytest.param(name, marks=pytest.mark.slow) for name in ("act2answer", "vl-think", "frontal"))],
)
def test_what_rests_is_drawn_once_and_no_bit_of_any_frame_differs(preset, make_env):
    layered, drawn_at_once = (
        frames_of_episodes(make_env(preset), draws_all=draws_all) for draws_all in (False, True)
    )
    for frame, expected in zip(layered, drawn_at_once, strict=True):
        np.testing.assert_array_equal(frame.picture, expected.picture)
        np.testing.assert_array_equal(frame.bodies, expected.bodies)
        np.testing.assert_array_equal(frame.flat().depth, expected.flat().depth)


@pytest.mark.slow
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
    tile = frame.picture[frame.bodies == env.scene.tiles["left"]]
    assert tile.max() < 255


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


@pytest.mark.slow
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
                frame.picture[v, u] > 100, np.array(color, bool), err_msg=f"{side} {dx} {dy}"
            )


def test_our_table_is_the_same_every_time_and_not_uniform():
    picture = wooden_table(Camera(CameraSpec()))
    assert picture.shape == (480, 640, 3)
    np.testing.assert_array_equal(picture, wooden_table(Camera(CameraSpec())))
    assert picture.std() > 10


@pytest.mark.slow
def test_our_table_follows_the_camera():
    near, far = CameraSpec(), CameraSpec(eye=(-0.3, -0.16, 0.6))
    assert np.abs(wooden_table(Camera(near)).astype(int) - wooden_table(Camera(far))).mean() > 3


@pytest.mark.slow
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


HEIGHT = 144
STAY = np.array([0, 0, 0, 0, 0, 0, 1.0])
PICTURES = {"left": Image.new("RGB", (8, 8), "red"), "right": Image.new("RGB", (8, 8), "blue")}


def whole_drawing(scene):
    """The small picture with every body drawn."""
    camera = scene.camera.at_height(HEIGHT)
    drawn = camera.render(scene.client, scene.spec.light, scene.spec.light_level)
    return LayeredFrame(drawn, scene.surroundings.at_size(camera.spec)).picture


@pytest.mark.parametrize("preset", ["bridge", "frontal"])
def test_a_small_picture_equals_the_whole_drawing_bit_for_bit(preset, make_env):
    env = make_env(preset)
    env.reset(seed=0)
    for action in (STAY, [0.1, 0.1, -0.1, 0.2, 0, 0.3, 0], [0, -0.1, -0.1, 0, 0.4, 0, 0]):
        env.advance(np.array(action))
        np.testing.assert_array_equal(env.scene.small_picture(HEIGHT), whole_drawing(env.scene))


@pytest.mark.slow
def test_other_pictures_sizes_and_pushed_tiles_are_drawn_anew(make_env):
    env = make_env("act2answer", arm="panda")
    env.reset(seed=0)
    scene = env.scene
    before = scene.small_picture(HEIGHT)
    assert scene.small_picture(HEIGHT // 2).shape == (HEIGHT // 2, HEIGHT * 2 // 3, 3)
    scene.reset(PICTURES, (*scene.spec.cube_xy, 0.1), 0.0)
    changed_picture = scene.small_picture(HEIGHT)
    assert (changed_picture != before).any(-1).sum() > 500
    np.testing.assert_array_equal(changed_picture, whole_drawing(scene))
    x, y, z = scene.tile_state("left").position
    scene._put(scene.tiles["left"], (x + 0.01, y, z), scene.spec.tile_yaw)
    pushed = scene.small_picture(HEIGHT)
    assert (pushed != changed_picture).any(-1).sum() > 50
    np.testing.assert_array_equal(pushed, whole_drawing(scene))


@pytest.mark.slow
def test_tiles_that_settle_on_the_table_are_drawn_within_a_few_pixels(make_env):
    env = make_env("act2answer", arm="panda")
    env.reset(seed=0)
    for _ in range(20):
        env.advance(STAY)
        differs = (env.scene.small_picture(HEIGHT) != whole_drawing(env.scene)).any(-1)
        assert differs.sum() <= 8, f"of {differs.size}"


def alternating_frames(env, count):
    """Frames of a posture of the Panda in which one pixel in 17,000 alternates between two drawings."""
    random = np.random.default_rng(22)
    env.reset(seed=22)
    for _ in range(2):
        env.advance(
            np.r_[random.uniform(-0.08, 0.08, 3), random.uniform(-0.5, 0.5, 3), float(random.random() > 0.5)]
        )
    return [env.scene.frame().picture for _ in range(count)]


@pytest.mark.slow
def test_neither_small_pictures_nor_former_episodes_change_a_bit_of_the_frames_of_a_policy(make_env):
    env = make_env()
    alone = alternating_frames(env, 3)
    assert (alone[0] != alone[1]).any(), "no pixel alternates: choose another posture"
    for frames in (1, 2):
        np.testing.assert_array_equal(alternating_frames(env, frames), alone[:frames])
    between = alternating_frames(env, 1)
    for small in (1, 2):
        for _ in range(small):
            env.scene.small_picture(HEIGHT)
        between.append(env.scene.frame().picture)
    np.testing.assert_array_equal(between, alone)
