""""""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from probe_kit.env import ENV_ID, Act2AnswerEnv, SceneSpec
from probe_kit.env.act2answer import Question
from probe_kit.env.arm import ARMS
from probe_kit.errors import ActionError, EpisodeOverError, SceneError, SuiteError


def color(question, side):
    return question.pictures[side].getpixel((5, 5))


def test_the_original_layout_lays_the_pictures_as_the_item_says(item):
    question = Question.from_item(item, "original")
    assert (color(question, "left"), color(question, "right")) == ((255, 0, 0), (0, 255, 255))
    assert question.side_correct == "left"


def test_the_swapped_layout_exchanges_pictures_and_correct_side(item):
    question = Question.from_item(item, "swapped")
    assert (color(question, "left"), color(question, "right")) == ((0, 255, 255), (255, 0, 0))
    assert question.side_correct == "right"
    assert question.name == "color-0001:s"


def test_a_missing_picture_is_named(item):
    (item.folder / "cyan.png").unlink()
    with pytest.raises(SuiteError, match=r"cyan\.png"):
        Question.from_item(item, "original")


@pytest.mark.parametrize("rubbish", [b"", b"not a picture", b"\x89PNG\r\n\x1a\n" + bytes(60)])
def test_a_corrupt_picture_is_refused(item, rubbish):
    (item.folder / "red.png").write_bytes(rubbish)
    with pytest.raises(SuiteError, match=r"red\.png"):
        Question.from_item(item, "original")


def test_a_truncated_picture_is_refused(item):
    from PIL import Image

    noise = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    Image.fromarray(noise).save(item.folder / "red.png")
    picture_bytes = (item.folder / "red.png").read_bytes()
    (item.folder / "red.png").write_bytes(picture_bytes[: len(picture_bytes) // 2])
    with pytest.raises(SuiteError, match=r"red\.png"):
        Question.from_item(item, "original")


@pytest.mark.parametrize(("mode", "ink"), [("L", 90), ("RGBA", (9, 9, 9, 0)), ("P", 3)])
def test_pictures_of_other_modes_and_odd_names_become_rgb(item, mode, ink):
    from PIL import Image

    Image.new(mode, (30, 50), ink).save(item.folder / "größe ü.png")
    question = Question.from_item(replace(item, left_file_name="größe ü.png"), "original")
    assert question.pictures["left"].mode == "RGB"
    assert question.pictures["left"].size == (50, 50)


def test_an_unknown_layout_is_refused(item):
    with pytest.raises(SceneError, match="original, swapped"):
        Question.from_item(item, "mirrored")
    with pytest.raises(SceneError, match="original, swapped"):
        Question.built_in("mirrored")


def test_the_built_in_question_swaps_too():
    assert Question.built_in("original").side_correct == "left"
    assert Question.built_in("swapped").side_correct == "right"
    assert color(Question.built_in("swapped"), "right") == color(Question.built_in("original"), "left")


def test_a_picture_with_other_pixels_than_the_item_says_is_refused(item):
    """A suite is named after its pixels: a file exchanged together with its own hash would keep that name."""
    with pytest.raises(SuiteError, match=r"red\.png: has other pixels than its suite says"):
        Question.from_item(replace(item, left_pixels_sha256="ab" * 32), "original")
    with pytest.raises(SuiteError, match=r"red\.png: has other pixels"):
        Question.from_item(replace(item, left_pixels_sha256="ab" * 32), "swapped")


STAY_OPEN = np.array([0, 0, 0, 0, 0, 0, 1.0])


def test_an_untouched_cube_is_out_of_bounds_and_never_moved(make_env):
    env = make_env(max_steps=3)
    env.reset(seed=0)
    while not env.trial.over:
        env.advance(STAY_OPEN)
    outcome = env.outcome()
    assert outcome.zone == "oob"
    assert outcome.never_moved
    assert (outcome.steps, outcome.truncation_reason) == (3, "max_steps")


def test_a_cube_that_leaves_the_table_ends_the_episode(shared_env):
    shared_env.reset(seed=0)
    scene = shared_env.scene
    scene.client.resetBasePositionAndOrientation(scene.cube, (0.25, 0.9, 0.0), (0, 0, 0, 1))
    steps = 0
    truncated = False
    while not truncated:
        _, terminated, truncated, info = shared_env.advance(STAY_OPEN)
        steps += 1
    assert not terminated
    assert steps < 4
    assert (info["truncation_reason"], info["outcome"]) == ("cube_fell", "oob")
    assert shared_env.outcome().cube_moved


def test_a_broken_simulator_ends_the_episode_and_the_next_one_is_fine(make_env):
    env = make_env()
    env.reset(seed=0)
    env.scene.client.resetBasePositionAndOrientation(env.scene.cube, (np.nan,) * 3, (0, 0, 0, 1))
    _, _, truncated, info = env.advance(STAY_OPEN)
    assert truncated
    assert (info["truncation_reason"], info["outcome"]) == ("non_finite", "oob")
    _, info = env.reset(seed=0)
    np.testing.assert_allclose(info["cube_xy"], env.scene_spec.cube_xy)


def test_clipped_actions_are_counted(shared_env):
    shared_env.reset(seed=0)
    for shift in (0.0, 0.5, 0.02, 0.5):
        shared_env.advance(np.array([0, shift, 0, 0, 0, 0, 1.0]))
    assert shared_env.outcome().clipped == 2


def test_pushing_the_cube_moves_it(shared_env):
    shared_env.reset(seed=0)
    for action in [(-0.08, 0.028, 0), (0, 0, -0.10), (0, 0, -0.04), *[(0.05, 0, 0)] * 2]:
        shared_env.advance(np.array([*action, 0, 0, 0, 0.0]))
    outcome = shared_env.outcome()
    assert outcome.cube_moved
    assert not outcome.is_grasped


@pytest.mark.slow
def test_early_stop_ends_five_actions_after_the_release(make_env, play):
    late, early = play(make_env(), seed=0), play(make_env(early_stop=True), seed=0)
    assert (late.steps, late.truncation_reason) == (60, "max_steps")
    assert early.steps < 30
    assert early.truncation_reason is None
    np.testing.assert_allclose(early.cube_xy, late.cube_xy, atol=1e-4)


def test_early_stop_waits_for_a_cube_that_was_never_grasped(make_env):
    env = make_env(early_stop=True, max_steps=12)
    env.reset(seed=0)
    ends = [env.advance(STAY_OPEN)[1:3] for _ in range(12)]
    assert ends == [(False, False)] * 11 + [(False, True)]


@pytest.mark.slow
def test_the_flags_follow_the_cube_through_an_episode(make_env):
    from probe_kit.env import ScriptedExpert

    env = make_env(early_stop=True)
    env.reset(seed=0)
    expert = ScriptedExpert(env)
    expert.reset()
    infos = []
    while not env.trial.over:
        infos.append(env.advance(expert.act())[3])
    grasped = [info["is_grasped"] for info in infos]
    assert not grasped[0]
    assert any(grasped)
    assert not grasped[-1]
    assert infos[-1]["on_tile"]
    assert max(info["cube_z"] for info in infos) > 0.1


STAY = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
INFO_KEYS = {
    "outcome",
    "is_success",
    "cube_xy",
    "cube_z",
    "distance_correct",
    "distance_wrong",
    "tile_xy_correct",
    "tile_xy_wrong",
    "side_correct",
    "side_placed",
    "layout",
    "is_grasped",
    "cube_moved",
    "on_tile",
    "steps",
    "clipped",
    "ik_error",
    "truncation_reason",
}


@pytest.mark.filterwarnings("error")
def test_gymnasium_finds_nothing_to_complain_about():
    env = gym.make(ENV_ID, disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=False)
    env.close()


def test_gymnasium_makes_it_with_another_scene():
    with gym.make(ENV_ID, spec=SceneSpec.preset("frontal")) as env:
        assert env.unwrapped.scene_spec.name == "frontal"


def test_observations_are_in_their_space(shared_env):
    observation, _ = shared_env.reset(seed=0)
    assert shared_env.observation_space.contains(observation)
    assert observation["pixels"]["image"].shape == (480, 640, 3)
    assert observation["agent_pos"].dtype == np.float32
    np.testing.assert_allclose(observation["agent_pos"], [*shared_env.scene_spec.home, 0, 0, 0, 0, 1], atol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        pytest.param(
            {"tile_mass": 0.05, "start_grasped": True, "picture_size": (128, 96)}, marks=pytest.mark.slow
        ),
    ],
)
def test_exchanged_pictures_are_the_other_layouts_bit_for_bit_and_leave_no_trace(make_env, changes):
    """At the start and after the same actions; on tiles that can be pushed as well."""
    watched, other, alone = make_env(**changes), make_env(**changes), make_env(**changes)
    for env, layout in ((watched, "original"), (other, "swapped"), (alone, "original")):
        env.reset(seed=3, options={"layout": layout})
    for action in (None, np.array([0.03, 0.04, -0.05, 0, 0, 0.1, 0]), np.array([0, 0.04, -0.05, 0, 0, 0.1, 0])):
        if action is not None:
            for env in (watched, other, alone):
                env.advance(action)
        observed, rendered = watched.observe_exchanged()
        expected = other.observe()
        np.testing.assert_array_equal(observed["pixels"]["image"], expected["pixels"]["image"])
        np.testing.assert_array_equal(rendered, other.render())
        np.testing.assert_array_equal(observed["agent_pos"], expected["agent_pos"])
        assert (rendered != watched.render()).any()
        np.testing.assert_array_equal(watched.render(), alone.render())
    assert watched.outcome().to_json() == alone.outcome().to_json()


@pytest.mark.slow
def test_step_is_advance_and_observe(make_env):
    stepped, advanced = make_env(), make_env()
    action = np.array([0.03, 0.02, -0.05, 0, 0, 0.1, 0])
    stepped.reset(seed=0)
    advanced.reset(seed=0)
    for _ in range(3):
        observation, reward, terminated, truncated, info = stepped.step(action)
        cheap = advanced.advance(action)
    assert cheap[:3] == (reward, terminated, truncated)
    np.testing.assert_array_equal(cheap[3]["cube_xy"], info["cube_xy"])
    np.testing.assert_array_equal(advanced.observe()["pixels"]["image"], observation["pixels"]["image"])


def test_a_picture_is_drawn_once_and_only_on_demand(shared_env, monkeypatch):
    shared_env.reset(seed=0)
    drawn = []
    scene = shared_env.scene
    monkeypatch.setattr(scene, "frame", lambda frame=scene.frame: drawn.append(1) or frame())
    shared_env.advance(STAY)
    assert drawn == []
    shared_env.observe()
    shared_env.render()
    assert drawn == [1]


def test_changing_a_returned_picture_changes_nothing_else(shared_env):
    observation, _ = shared_env.reset(seed=0)
    before = shared_env.render()
    observation["pixels"]["image"][:] = 0
    shared_env.render()[:] = 7
    np.testing.assert_array_equal(shared_env.render(), before)


def test_the_picture_for_the_policy_can_be_smaller_than_the_rendered_one(make_env):
    env = make_env(picture_size=(224, 224))
    observation, _ = env.reset(seed=0)
    assert observation["pixels"]["image"].shape == (224, 224, 3)
    assert env.observation_space.contains(observation)
    assert env.render().shape == (480, 640, 3)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    "tile_side", [pytest.param(0.088, marks=pytest.mark.slow), pytest.param(0.11, marks=pytest.mark.slow), 0.154]
)
@pytest.mark.parametrize("preset", ["bridge", "frontal"])
def test_both_pictures_are_fully_seen_in_the_first_frame(preset, tile_side, arm, make_env):
    visibility = make_env(preset, arm=arm, tile_side=tile_side).reset(seed=0)[1]["tile_visibility"]
    assert min(visibility.values()) >= 0.99


@pytest.mark.slow
def test_a_cube_that_starts_elsewhere_hides_no_picture_either(make_env):
    env = make_env(start_jitter=0.02, start_jitter_yaw=0.8)
    for seed in range(5):
        assert min(env.reset(seed=seed)[1]["tile_visibility"].values()) >= 0.99


def test_the_gripper_hides_part_of_the_left_picture_at_the_home_of_vl_think(make_env):
    visibility = make_env("vl-think").reset(seed=0)[1]["tile_visibility"]
    assert visibility["left"] == pytest.approx(0.963, abs=0.005)
    assert visibility["right"] == 1.0


def test_both_pictures_have_the_same_size_on_screen_in_the_frontal_scene(make_env):
    env = make_env("frontal")
    env.reset(seed=0)
    pixels = env.scene._tile_pixels
    assert pixels["left"] == pytest.approx(pixels["right"], rel=0.005)


def test_the_item_and_its_layout_arrive_on_the_table(shared_env, item):
    image, info = shared_env.reset(seed=0, options={"item": item, "layout": "swapped"})
    assert shared_env.task_description == "Put the cube on the red picture"
    assert (shared_env.task, info["side_correct"], info["layout"]) == ("color-0001:s", "right", "swapped")
    assert info["tile_xy_correct"].tolist() == list(shared_env.scene_spec.tile_right)
    u, v = shared_env.scene.camera.project((*shared_env.scene_spec.tile_right, 0.006)).astype(int)
    red, green, blue = image["pixels"]["image"][v, u].astype(int)
    assert red > 2 * max(green, blue)


def test_the_info_has_the_same_keys_at_every_step(shared_env):
    _, info = shared_env.reset(seed=0)
    assert set(info) == INFO_KEYS | {"tile_visibility"}
    assert info["outcome"] is None
    assert set(shared_env.advance(STAY)[3]) == INFO_KEYS


def test_lerobot_finds_the_length_of_an_episode(make_env):
    assert make_env(max_steps=17)._max_episode_steps == 17


def test_a_bad_action_moves_nothing(shared_env):
    shared_env.reset(seed=0)
    before = shared_env.scene.arm.joints()
    for bad in (np.full(7, np.nan), np.zeros(6)):
        with pytest.raises(ActionError):
            shared_env.step(bad)
    np.testing.assert_array_equal(shared_env.scene.arm.joints(), before)
    assert shared_env.advance(STAY)[3]["steps"] == 1


def test_a_bad_action_is_a_value_error():
    assert issubclass(ActionError, ValueError)


def test_stepping_before_reset_or_after_the_end_is_an_error(make_env):
    env = make_env(max_steps=1)
    with pytest.raises(EpisodeOverError, match="call `reset` first"):
        env.step(STAY)
    env.reset(seed=0)
    env.advance(STAY)
    with pytest.raises(EpisodeOverError, match="ended after 1 step"):
        env.step(STAY)
    env.reset()
    env.advance(STAY)


def test_there_is_no_outcome_before_the_first_action(make_env):
    env = make_env()
    with pytest.raises(EpisodeOverError):
        env.outcome()
    env.reset(seed=0)
    with pytest.raises(EpisodeOverError, match="no action was executed"):
        env.outcome()


def test_a_missing_picture_stops_the_reset_and_leaves_the_environment_usable(shared_env, item):
    shared_env.reset(seed=0)
    shared_env.advance(STAY)
    (item.folder / "red.png").unlink()
    with pytest.raises(SuiteError, match=r"red\.png"):
        shared_env.reset(options={"item": item})
    assert shared_env.advance(STAY)[3]["steps"] == 2
    assert shared_env.task == "built-in:o"


def test_an_item_that_is_none_is_refused(shared_env):
    with pytest.raises(SceneError, match="is a str; expected an Item"):
        shared_env.reset(options={"item": "color-0001"})


def test_unknown_options_are_refused(shared_env):
    with pytest.raises(SceneError, match="'itme'"):
        shared_env.reset(options={"itme": None})


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(SceneError, match="rgb_array"):
        Act2AnswerEnv(render_mode="human")


def test_closing_twice_is_fine_and_use_after_it_is_an_error(make_env):
    env = make_env()
    env.reset(seed=0)
    env.close()
    env.close()
    for use in (lambda: env.reset(), lambda: env.step(STAY), lambda: env.render(), lambda: env.outcome()):
        with pytest.raises(EpisodeOverError):
            use()


def test_closing_an_environment_that_was_never_used_is_fine():
    Act2AnswerEnv().close()


@pytest.mark.slow
def test_two_environments_in_one_process_are_independent(make_env):
    moving, still = make_env(), make_env()
    moving.reset(seed=0)
    observation, _ = still.reset(seed=0)
    moving.advance(np.array([0, 0.1, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(still.observe()["agent_pos"], observation["agent_pos"])
    moving.close()
    still.advance(STAY)


def test_a_worker_process_gives_the_same_observations_as_the_parent(shared_env):
    envs = gym.vector.AsyncVectorEnv([Act2AnswerEnv], context="forkserver")
    (image,) = envs.reset(seed=[0])[0]["pixels"]["image"].copy()
    envs.close()
    np.testing.assert_array_equal(image, shared_env.reset(seed=0)[0]["pixels"]["image"])


@pytest.mark.slow
def test_the_documented_line_makes_the_environment_without_an_import_of_ours():
    page = (Path(__file__).parents[2] / "docs" / "environment.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert "import probe_kit" not in example
    code = f"{example}\nprint(type(env.unwrapped).__name__, observation.keys() == env.observation_space.keys())"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False)
    assert (completed.returncode, completed.stdout) == (0, "Act2AnswerEnv True\n"), completed.stderr
