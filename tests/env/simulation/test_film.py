"""Small pictures of a film are those of a whole drawing, and leave no trace in what a policy gets."""

import numpy as np
import pytest
from PIL import Image

HEIGHT = 144
STAY = np.array([0, 0, 0, 0, 0, 0, 1.0])
PICTURES = {"left": Image.new("RGB", (8, 8), "red"), "right": Image.new("RGB", (8, 8), "blue")}


def whole_drawing(scene):
    """The small picture with every body drawn."""
    camera = scene.camera.at_height(HEIGHT)
    return scene.backdrop.at_size(camera.spec).under(
        camera.render(scene.client, scene.spec.light, scene.spec.light_level)
    )


@pytest.mark.parametrize("preset", ["bridge", "frontal"])
def test_a_small_picture_equals_the_whole_drawing_bit_for_bit(preset, make_env):
    env = make_env(preset)
    env.reset(seed=0)
    for action in (STAY, [0.1, 0.1, -0.1, 0.2, 0, 0.3, 0], [0, -0.1, -0.1, 0, 0.4, 0, 0]):
        env.advance(np.array(action))
        np.testing.assert_array_equal(env.scene.small_picture(HEIGHT), whole_drawing(env.scene))


def test_other_pictures_sizes_and_pushed_tiles_are_drawn_anew(make_env):
    env = make_env("act2answer", arm="panda")
    env.reset(seed=0)
    scene = env.scene
    before = scene.small_picture(HEIGHT)
    assert scene.small_picture(HEIGHT // 2).shape == (HEIGHT // 2, HEIGHT * 2 // 3, 3)
    scene.reset(PICTURES, (*scene.spec.cube_xy, 0.1), 0.0)
    shown = scene.small_picture(HEIGHT)
    assert (shown != before).any(-1).sum() > 500
    np.testing.assert_array_equal(shown, whole_drawing(scene))
    x, y, z = scene.tile_state("left").position
    scene._put(scene.tiles["left"], (x + 0.01, y, z), scene.spec.tile_yaw)
    pushed = scene.small_picture(HEIGHT)
    assert (pushed != shown).any(-1).sum() > 50
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
    return [env.scene.frame().rgb for _ in range(count)]


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
        between.append(env.scene.frame().rgb)
    np.testing.assert_array_equal(between, alone)
