"""Links that the camera does not see are hidden from the renderer, and no bit of a picture changes."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from probe_kit.env import SceneSpec
from probe_kit.env.culling import ViewCulling, mesh_ends
from probe_kit.env.scene import Scene
from probe_kit.env.simulation import BulletClient, Camera, VisualShapes
from probe_kit.env.spec import LightSpec

PICTURES = {side: Image.new("RGB", (16, 16), color) for side, color in (("left", "red"), ("right", "blue"))}
PROTOCOL = replace(SceneSpec().camera, width=160, height=120)
VIEWS = {
    "of the protocol": PROTOCOL,
    "from the side": replace(PROTOCOL, eye=(1.6, 0.5, 0.9), forward=(-1.0, -0.3, -0.4), fov=60),
    "of the upper arm": replace(PROTOCOL, eye=(1.2, 0.0, 0.6), forward=(-1.0, 0.0, 0.2), fov=30),
    "from within the arm": replace(PROTOCOL, eye=(0.2, 0.0, 0.6), forward=(1.0, 0.0, -0.3), fov=70),
}


def play(scene, seed):
    """Pictures of an arm that moves at random, with small ones between, and the joints at the end."""
    random = np.random.default_rng(seed)
    scene.reset(PICTURES, (0.5, 0.0, 0.02), 0.0)
    pictures, joints = [], scene.home_q
    for _ in range(12):
        turn = random.uniform(-0.15, 0.15, joints.size)
        target = np.clip(joints + turn, scene.arm.chain.lower, scene.arm.chain.upper)
        scene.advance(joints, target, random.random())
        joints = target
        if random.random() < 0.4:
            pictures.append(scene.small_picture(48))
        pictures.append(scene.frame().picture)
    return pictures, scene.arm.joints()


@pytest.mark.parametrize(
    "view",
    ["of the protocol", *(pytest.param(name, marks=pytest.mark.slow) for name in list(VIEWS)[1:])],
)
def test_hidden_links_change_no_bit_of_a_picture_or_of_the_motion(view, monkeypatch):
    spec = replace(SceneSpec(), camera=VIEWS[view])
    culled_scene = Scene(spec)
    monkeypatch.setattr("probe_kit.env.culling.mesh_ends", lambda _: None)
    whole_scene = Scene(spec)
    for seed in range(2):
        culled_pictures, culled_joints = play(culled_scene, seed)
        whole_pictures, whole_joints = play(whole_scene, seed)
        for picture, expected_picture in zip(culled_pictures, whole_pictures, strict=True):
            np.testing.assert_array_equal(picture, expected_picture)
        np.testing.assert_array_equal(culled_joints, whole_joints)
    culled_scene.close()
    whole_scene.close()


def test_the_camera_of_the_protocol_works_through_the_hand_alone():
    scene = Scene(SceneSpec())
    scene.reset(PICTURES, (0.5, 0.0, 0.02), 0.0)
    scene.frame()
    arm = scene._arm
    assert arm.visible == {-1, 8, 9, 10}, "base, hand and fingers"
    assert arm.hidden == set(range(7))
    scene.close()


URDF = """<robot name="turntable">
  <link name="base"/>
  <link name="plate">{inertial}<visual><origin xyz="{offset}" rpy="0 0 {turn}"/>
    <geometry><mesh filename="{mesh}" scale="0.001 0.001 0.002"/></geometry></visual></link>
  <joint name="axis" type="continuous"><parent link="base"/><child link="plate"/><axis xyz="0 0 1"/></joint>
</robot>"""
INERTIAL = '<inertial><origin xyz="0.3 0 0"/><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'  # noqa: E501


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_box_of_a_scaled_turned_and_shifted_mesh_holds_all_that_is_drawn_of_it(turn, tmp_path):
    mesh = tmp_path / "block.obj"
    corners = [(x, y, z) for x in (0, 100) for y in (-20, 20) for z in (0, 30)]
    faces = [
        (1, 3, 7),
        (1, 7, 5),
        (2, 6, 8),
        (2, 8, 4),
        (1, 2, 4),
        (1, 4, 3),
        (5, 7, 8),
        (5, 8, 6),
        (1, 5, 6),
        (1, 6, 2),
    ]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "vn 0 0 1\n"
    mesh.write_text(text + "".join(f"f {a}//1 {b}//1 {c}//1\n" for a, b, c in faces), encoding="utf-8")
    urdf = tmp_path / "turntable.urdf"
    urdf.write_text(URDF.format(inertial=INERTIAL, offset="0.2 0.1 0", turn=turn, mesh=mesh), encoding="utf-8")
    client = BulletClient()
    body = client.loadURDF(str(urdf), useFixedBase=True)
    shapes = VisualShapes(client, body)
    culling = ViewCulling(client, shapes)
    camera = Camera(replace(PROTOCOL, eye=(0.3, 0.0, 1.0), forward=(0.01, 0.0, -1.0), fov=25))
    states = set()
    for angle in np.linspace(0, 2 * np.pi, 60):
        client.resetJointState(body, 0, angle)
        shapes.hide([])
        is_drawn = (camera.render(client, LightSpec(), 1.0).bodies == body).any()
        culling.hide_unseen(camera)
        is_hidden = 0 in shapes.hidden
        assert not (is_drawn and is_hidden), f"{angle} rad"
        states.add((bool(is_drawn), is_hidden))
    assert {(True, False), (False, True)} <= states
    client.close()


def test_a_mesh_that_cannot_be_read_as_obj_is_always_drawn(tmp_path):
    for name, content in (("a.obj", b"v 1 2\n"), ("b.stl", b"solid\n"), ("c.obj", b"v one two three\n")):
        (tmp_path / name).write_bytes(content)
        assert mesh_ends(tmp_path / name) is None
    assert mesh_ends(tmp_path / "absent.obj") is None


def test_a_mesh_that_was_edited_is_measured_again(tmp_path):
    path = tmp_path / "block.obj"
    for end in (1.0, 2.0):
        path.write_text(f"v 0 0 0\nv {end} 0 0\n", encoding="utf-8")
        low, high = mesh_ends(path)
        assert (low.tolist(), high.tolist()) == ([0, 0, 0], [end, 0, 0])


def test_a_body_is_in_view_unless_it_lies_beyond_one_side_of_the_picture():
    camera = Camera(PROTOCOL)
    eye, (right, up, forward) = np.array(PROTOCOL.eye), camera.axes
    block = 0.01 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    edge = PROTOCOL.width / 2 / PROTOCOL.focal_length
    for direction, is_seen in (
        (forward, True), (-forward, False), (forward + (edge + 0.005) * right, True),
        (forward + (edge + 0.03) * right, False), (forward - (edge + 0.03) * right, False),
        (forward + up, False), (forward - up, False),
    ):  # fmt: skip
        assert camera.can_see(eye + direction + block) == is_seen
    assert camera.can_see(eye + 1000 * block), "the camera is within the body"
