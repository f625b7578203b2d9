import json
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import pytest

from probe_kit.env import LimitSpec, SceneSpec
from probe_kit.env.spec import PRESETS
from probe_kit.errors import SceneError


@pytest.mark.parametrize(("side", "radius"), [(0.11, 0.065), (0.154, 0.087), (0.088, 0.054)])
def test_the_zone_radius_follows_the_tile_size(side, radius):
    assert SceneSpec(tile_side=side).zone_radius == pytest.approx(radius)


def test_a_fixed_epsilon_does_not_follow_the_tile_size():
    assert SceneSpec(tile_side=0.154, epsilon=0.06).zone_radius == 0.06


def test_overlapping_zones_are_refused_with_both_numbers():
    with pytest.raises(SceneError, match=r"radius 0\.155 m overlap.*0\.310 m apart"):
        SceneSpec(epsilon=0.155)
    SceneSpec(epsilon=0.1549)


def test_a_cube_that_starts_in_a_zone_is_refused():
    with pytest.raises(SceneError, match="without having been moved"):
        SceneSpec(cube_xy=(0.33, 0.15))
    with pytest.raises(SceneError, match="start_jitter"):
        SceneSpec(start_jitter=0.1)


@pytest.mark.parametrize(
    "changes",
    [
        {"tile_side": 0.0},
        {"cube_mass": -1.0},
        {"max_steps": 0},
        {"epsilon": float("nan")},
        {"light_level": 0.0},
        {"rendering": "raytraced"},
        {"arm": "ur5"},
        {"home": (0.6, 0.0, 0.2)},
        {"euler": "yxz"},
        {"home_opening": 1.2},
        {"tile_mass": -1.0},
        {"forced_closed": -1},
        {"scoring_side": 0.0},
        {"closing_steps": 3},
    ],
)
def test_values_that_make_no_sense_are_refused(changes):
    with pytest.raises(SceneError, match=next(iter(changes))):
        SceneSpec(**changes)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_valid_and_carries_its_name(name):
    assert SceneSpec.preset(name).name == name


def test_the_default_scene_is_the_bridge_preset():
    assert SceneSpec() == SceneSpec.preset("bridge")


def test_a_preset_takes_changes_and_names_what_it_does_not_know():
    assert SceneSpec.preset("frontal", tile_side=0.154).tile_yaw == SceneSpec.preset("frontal").tile_yaw
    with pytest.raises(SceneError, match="bridge, vl-think, frontal"):
        SceneSpec.preset("sideways")
    with pytest.raises(SceneError, match="did you mean 'tile_side'"):
        SceneSpec.preset("bridge", tile_size=0.1)


def test_the_record_is_json_and_tells_what_differs():
    spec = SceneSpec()
    stored = json.loads(json.dumps(spec.to_json(), allow_nan=False))
    assert stored["epsilon"] == spec.zone_radius
    assert stored != replace(spec, max_steps=80).to_json()


def test_the_record_names_every_field():
    assert set(SceneSpec().to_json()) == {field.name for field in fields(SceneSpec)}


def test_another_arm_takes_the_pose_of_the_preset_and_not_its_joints():
    panda, widowx = (SceneSpec.preset("act2answer", arm=arm) for arm in ("panda", "widowx"))
    assert widowx.home_joints is not None
    assert panda.home_joints is None
    assert (panda.home, panda.home_rpy) == (widowx.home, widowx.home_rpy)


def test_the_box_of_the_release_does_not_follow_the_tile_that_is_drawn():
    for side in (0.1452, 0.2033, 0.1162):
        spec = SceneSpec.preset("act2answer", tile_side=side)
        assert (spec.box_half, spec.box_height) == (pytest.approx(0.135), 0.008)
        assert spec.zone_radius == pytest.approx(side / 2 + 0.01)


def test_limits_that_are_off_take_any_home():
    assert LimitSpec.off().contain((9.0, 9.0, -9.0))
    assert not LimitSpec().contain((0.3, 0.0, -0.01))


def test_the_record_names_a_photo_by_what_it_shows_and_not_by_where_it_lies(tmp_path):
    kitchen, copy, garden = (tmp_path / name for name in ("kitchen.jpg", "copy.jpg", "garden.jpg"))
    for path, content in ((kitchen, b"table"), (copy, b"table"), (garden, b"lawn")):
        path.write_bytes(content)
    record = SceneSpec(background=kitchen).to_json()
    assert record == SceneSpec(background=copy).to_json() != SceneSpec(background=garden).to_json()
    assert str(tmp_path) not in json.dumps(record)
    with pytest.raises(SceneError, match=r"missing\.jpg cannot be read"):
        SceneSpec(background=tmp_path / "missing.jpg").to_json()


def test_a_background_that_no_rendering_shows_is_refused(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    with pytest.raises(SceneError, match="would not be seen: the scene's rendering is 'raw'"):
        SceneSpec.preset("bridge", background=photo)
    assert SceneSpec.preset("bridge", background=photo, rendering="visual-matching").background == photo


def test_the_record_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        SceneSpec().epsilon = 0.08


@pytest.mark.parametrize("name", PRESETS)
def test_a_stored_scene_is_built_again(name: str) -> None:
    """As it comes back from JSON, in which tuples are lists."""
    spec = SceneSpec.preset(name, light_level=0.7, picture_size=(224, 224))
    stored = json.loads(json.dumps(spec.to_json()))
    again = SceneSpec.from_json(stored)
    assert again.to_json() == spec.to_json()
    assert again == replace(spec, epsilon=spec.zone_radius)


def test_a_scene_with_a_file_needs_that_file_again(tmp_path: Path) -> None:
    photo, other = tmp_path / "photo.png", tmp_path / "other.png"
    photo.write_bytes(b"one")
    other.write_bytes(b"two")
    spec = SceneSpec(background=photo)
    stored = json.loads(json.dumps(spec.to_json()))
    assert SceneSpec.from_json(stored, {"background": photo}).background == photo
    with pytest.raises(SceneError, match="give that file again"):
        SceneSpec.from_json(stored)
    with pytest.raises(SceneError, match="Give that file"):
        SceneSpec.from_json(stored, {"background": other})
    with pytest.raises(SceneError, match="made without a file as arm_urdf; it has background"):
        SceneSpec.from_json(stored, {"background": photo, "arm_urdf": photo})
    with pytest.raises(SceneError, match="made without a file as background; it has none"):
        SceneSpec.from_json(SceneSpec().to_json(), {"background": photo})


def test_a_scene_of_a_later_version_is_refused() -> None:
    with pytest.raises(SceneError, match="gravity"):
        SceneSpec.from_json({**SceneSpec().to_json(), "gravity": 1.6})
