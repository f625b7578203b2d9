from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import arm
from probe_kit.env.arm import write_urdf
from probe_kit.env.simulation import BulletClient
from probe_kit.errors import SceneError


@pytest.fixture
def robot(tmp_path):
    pytest.importorskip("rtbdata")
    client = BulletClient()
    yield client, client.loadURDF(str(write_urdf(tmp_path)), useFixedBase=True)
    client.close()


def test_the_home_pose_of_simplerenv_puts_the_tool_where_it_was_measured(robot):
    client, body = robot
    # SimplerEnv's description turns the forearm the other way round: elbow, roll, wrist and rotate change sign.
    home = (-0.01840777, 0.0398835, -0.22242722, 0.00460194, -1.36524296, -0.00153398)
    for joint, angle in enumerate(home):
        client.resetJointState(body, joint, angle)
    position = client.getLinkState(body, 8, computeForwardKinematics=True)[4]
    np.testing.assert_allclose(position, [0.292, -0.006, 0.135], atol=2e-3)


def test_it_has_six_turning_joints_and_two_fingers(robot):
    client, body = robot
    kinds = [client.getJointInfo(body, joint)[2] for joint in range(client.getNumJoints(body))]
    assert kinds == [client.JOINT_REVOLUTE] * 6 + [client.JOINT_PRISMATIC] * 2 + [client.JOINT_FIXED]


def test_every_link_that_should_be_seen_has_a_mesh(robot):
    client, body = robot
    drawn = {shape[1] for shape in client.getVisualShapeData(body) if Path(shape[4].decode()).is_file()}
    assert drawn == set(range(-1, 8))


def test_missing_meshes_are_announced_with_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(arm, "find_spec", lambda _: None)
    with pytest.raises(SceneError, match=r"Install `rtb-data"):
        write_urdf(tmp_path)


def test_another_version_of_the_meshes_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(arm, "MESH_FOLDER", Path("elsewhere"))
    pytest.importorskip("rtbdata")
    with pytest.raises(SceneError, match="not version 2"):
        write_urdf(tmp_path)
