import numpy as np
import pytest
from PIL import Image

from probe_kit.env import SceneSpec
from probe_kit.env.scene import Scene
from probe_kit.env.spec import CameraSpec, LimitSpec
from probe_kit.errors import SceneError

PLAIN = {"left": Image.new("RGB", (8, 8), "red"), "right": Image.new("RGB", (8, 8), "blue")}
START = (*SceneSpec().cube_xy, SceneSpec().cube_side / 2)


@pytest.fixture
def scene(shared_env):
    shared_env.reset(seed=0)
    return shared_env.scene


@pytest.fixture
def own_scene():
    scene = Scene(SceneSpec())
    yield scene
    scene.close()


def test_the_cube_rests_where_it_was_put(scene):
    scene.reset(PLAIN, START, 0.3)
    scene.advance(scene.home_q, scene.home_q, 1.0)
    cube = scene.cube_state()
    np.testing.assert_allclose(cube.position, START, atol=5e-4)
    assert cube.speed < 1e-3


def test_the_cube_weighs_what_the_spec_says(scene):
    assert scene.client.getDynamicsInfo(scene.cube, -1)[0] == scene.spec.cube_mass


def test_reset_brings_back_joints_cube_and_pictures(scene):
    scene.reset(PLAIN, START, 0.0)
    before = scene.frame().picture
    far = scene.home_q + 0.2
    scene.advance(scene.home_q, far, 0.0)
    scene.reset({"left": PLAIN["right"], "right": PLAIN["left"]}, (0.2, 0.0, 0.1), 1.0)
    assert (scene.frame().picture != before).any()
    scene.reset(PLAIN, START, 0.0)
    np.testing.assert_array_equal(scene.frame().picture, before)


@pytest.mark.parametrize("side", ["left", "right"])
def test_tile_visibility_is_the_share_of_pixels_that_nothing_hides(scene, side):
    scene.reset(PLAIN, START, 0.0)
    assert scene.tile_visibility(scene.frame()) == {"left": 1.0, "right": 1.0}
    scene.reset(PLAIN, (*scene.spec.tile_xy(side), 0.03), 0.0)
    hidden = scene.tile_visibility(scene.frame())[side]
    assert 0.75 < hidden < 0.98


@pytest.mark.slow
def test_a_picture_that_leaves_the_screen_counts_as_partly_hidden(make_env):
    turned = CameraSpec(forward=(1.0, 0.85, -1.085))
    visibility = make_env(camera=turned).reset(seed=0)[1]["tile_visibility"]
    assert visibility["left"] == 1.0
    assert 0.3 < visibility["right"] < 0.9


def test_touching_is_seen(scene):
    scene.reset(PLAIN, (*scene.spec.tile_left, 0.022), 0.0)
    scene.advance(scene.home_q, scene.home_q, 1.0)
    assert scene.is_on_tile()
    assert not scene.is_grasped()


def test_a_cube_that_starts_in_the_hand_is_held(own_scene):
    own_scene.reset(PLAIN, START, 0.0)
    own_scene.put_cube_in_hand()
    assert own_scene.is_grasped()
    np.testing.assert_allclose(own_scene.cube_state().position, own_scene.spec.home, atol=2e-3)


def test_a_state_that_is_not_finite_is_noticed_and_healed(own_scene):
    own_scene.reset(PLAIN, START, 0.0)
    own_scene.client.resetBasePositionAndOrientation(own_scene.cube, (np.nan,) * 3, (0, 0, 0, 1))
    assert not own_scene.advance(own_scene.home_q, own_scene.home_q, 1.0)
    own_scene.reset(PLAIN, START, 0.0)
    assert own_scene.advance(own_scene.home_q, own_scene.home_q, 1.0)
    np.testing.assert_allclose(own_scene.cube_state().position, START, atol=5e-4)


@pytest.mark.slow
def test_a_spent_texture_budget_reloads_the_scene(own_scene):
    own_scene.reset(PLAIN, START, 0.0)
    before = own_scene.frame().picture
    spent = own_scene.textures
    spent._budget = 3
    for shade in range(0, 250, 50):
        own_scene.reset({"left": Image.new("L", (8, 8), shade), "right": PLAIN["right"]}, START, 0.0)
    assert own_scene.textures is not spent
    assert len(spent._ids) <= 3
    assert len(own_scene.textures._ids) >= 5, "of the scene loaded after it"
    own_scene.reset(PLAIN, START, 0.0)
    np.testing.assert_array_equal(own_scene.frame().picture, before)


def test_a_home_out_of_reach_is_refused():
    spec = SceneSpec(home=(2.0, 0.0, 0.2), limits=LimitSpec(high=(3.0, 3.0, 3.0)))
    with pytest.raises(SceneError, match="cannot reach its home"):
        Scene(spec)


def resident_megabytes():
    with open("/proc/self/statm", encoding="utf-8") as statm:  # noqa: PTH123
        return int(statm.read().split()[1]) * 4096 / 2**20


@pytest.mark.slow
def test_a_reload_frees_the_textures(own_scene):
    """Of 300 textures the server alone would keep 60 MB; an attack measured 0.4 MB per episode."""

    def load_and_reload(first: int) -> None:
        for shade in range(first, first + 100):
            own_scene.textures.load(Image.new("RGB", (64, 64), (shade % 256, shade // 256, 90)))
        own_scene._reload()

    for warming in range(2):
        load_and_reload(100 * warming)
    before = resident_megabytes()
    for start in (200, 300, 400):
        load_and_reload(start)
    assert resident_megabytes() - before < 30.0


@pytest.mark.slow
def test_memory_stays_flat_over_a_whole_study_of_pictures_never_seen_before(own_scene):
    def reset(count: int) -> None:
        for number in range(count):
            sides = {side: Image.new("RGB", (64, 64), (number % 256, number // 256, 9)) for side in PLAIN}
            sides["right"].putpixel((0, 0), (255, 255, 255))
            own_scene.reset(sides, START, 0.0)

    reset(600)
    before = resident_megabytes()
    reset(3440)
    assert resident_megabytes() - before < 30.0
