"""The robot arm in the physics server: joints, measurements and motor commands."""

from pathlib import Path

import numpy as np

from probe_kit.env.robot.arm_models import ArmModel
from probe_kit.env.robot.kinematics import Pose, SerialChain
from probe_kit.env.rotations import Array, from_rpy, to_rpy
from probe_kit.env.simulation.bullet import BulletClient, import_pybullet
from probe_kit.env.spec import XYZ, PhysicsSpec
from probe_kit.errors import SceneError

POSITION_GAIN = 0.3
VELOCITY_GAIN = 1.0
GEAR_FORCE = 50.0
GEAR_ERP = 0.1


class Arm:
    """An arm loaded into a physics server.

    Joint angles are (n,) radians; an opening is 1 for an open and 0 for a closed gripper.
    Raises SceneError if the description is missing or has other joints than the model.
    """

    def __init__(self, client: BulletClient, model: ArmModel, physics: PhysicsSpec, urdf: Path) -> None:
        self._client = client
        self._physics = physics
        self.model = model
        self.body: int = self._load(urdf)
        self._efforts = [client.getJointInfo(self.body, j)[10] for j in model.joints]
        self._couple_fingers()
        self.chain = self._measure_chain()

    def set_joints(self, q: Array, opening: float) -> None:
        """Put the joints there at rest, without moving through the space between."""
        for joint, angle in zip(self.model.joints, q, strict=True):
            self._client.resetJointState(self.body, joint, angle)
        for finger in self.model.fingers:
            self._client.resetJointState(self.body, finger, self._finger_position(opening))

    def command_gripper(self, opening: float) -> None:
        """Let the fingers close or open until another command comes."""
        for finger in self.model.fingers:
            self._client.setJointMotorControl2(
                self.body,
                finger,
                self._client.POSITION_CONTROL,
                targetPosition=self._finger_position(opening),
                force=self._physics.grip_force,
                maxVelocity=self._physics.finger_speed,
            )

    def command_joints(self, q: Array) -> None:
        """Pull the joints towards q during the next substep."""
        count = len(self.model.joints)
        self._client.setJointMotorControlArray(
            self.body,
            self.model.joints,
            self._client.POSITION_CONTROL,
            targetPositions=q.tolist(),
            forces=self._efforts,
            positionGains=[POSITION_GAIN] * count,
            velocityGains=[VELOCITY_GAIN] * count,
        )

    def joints(self) -> Array:
        """Measured joint angles (n,)."""
        return np.array([state[0] for state in self._client.getJointStates(self.body, self.model.joints)])

    def tool_state(self) -> Array:
        """Measured x, y, z, roll, pitch, yaw (6,) of the tool; the angles are relative to pointing down."""
        pose = self.chain.pose(self.joints())
        return np.concatenate([pose.position, to_rpy(pose.rotation @ np.array(self.model.down).T)])

    def opening(self) -> float:
        """Measured opening of the gripper, 0 closed to 1 open."""
        states = self._client.getJointStates(self.body, self.model.fingers)
        middle = sum(state[0] for state in states) / 2
        span = self.model.opened - self.model.closed
        return float(np.clip((middle - self.model.closed) / span, 0.0, 1.0))

    def tool_down(self, position: XYZ, rpy: XYZ = (0.0, 0.0, 0.0)) -> Pose:
        """The pose with the tool at `position` and the gripper pointing down, but for a turn `rpy`."""
        return Pose(np.array(position), from_rpy(rpy) @ np.array(self.model.down))

    def _load(self, urdf: Path) -> int:
        client, model = self._client, self.model
        if not urdf.is_file():
            raise SceneError(f"there is no arm description {urdf}; check `arm_urdf`.")
        try:
            body: int = client.loadURDF(str(urdf), model.base, useFixedBase=True)
        except import_pybullet().error as error:
            raise SceneError(f"{urdf} cannot be read as a robot ({error}). Give another `arm_urdf`.") from error
        kinds = [client.getJointInfo(body, joint)[2] for joint in range(client.getNumJoints(body))]
        expected = dict.fromkeys(model.joints, client.JOINT_REVOLUTE)
        expected |= dict.fromkeys(model.fingers, client.JOINT_PRISMATIC) | {model.tool: client.JOINT_FIXED}
        if max(expected) >= len(kinds) or any(kinds[joint] != kind for joint, kind in expected.items()):
            raise SceneError(
                f"{urdf} does not describe this arm: expected turning joints {model.joints}, sliding fingers "
                f"{model.fingers} and a fixed tool {model.tool}, in PyBullet's order. Give one of the same arm."
            )
        return body

    def _finger_position(self, opening: float) -> float:
        return self.model.closed + opening * (self.model.opened - self.model.closed)

    def _couple_fingers(self) -> None:
        """Gear the fingers to each other: alone they share the load unevenly and drop the cube 1 cm off."""
        client, (left, right) = self._client, self.model.fingers
        gear = client.createConstraint(
            self.body, left, self.body, right, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
        )
        client.changeConstraint(gear, gearRatio=-1, erp=GEAR_ERP, maxForce=GEAR_FORCE)
        for finger in self.model.fingers:
            # Without the anchor a held cube creeps along the light fingers of the WidowX, up to 28 mm per episode.
            client.changeDynamics(self.body, finger, lateralFriction=self._physics.friction, frictionAnchor=1)

    def _measure_chain(self) -> SerialChain:
        """Read the screws off the loaded robot at q = 0."""
        client, model = self._client, self.model
        self.set_joints(np.zeros(len(model.joints)), 0.0)
        info = [client.getJointInfo(self.body, joint) for joint in model.joints]
        states = [client.getLinkState(self.body, joint, computeForwardKinematics=True) for joint in model.joints]
        tool = client.getLinkState(self.body, model.tool, computeForwardKinematics=True)
        return SerialChain(
            # PyBullet gives the axis in the frame of the link's inertia: its orientation is state[1], not [5].
            axes=np.array([self._matrix(s[1]) @ i[13] for s, i in zip(states, info, strict=True)]),
            points=np.array([state[4] for state in states]),
            tip=Pose(np.array(tool[4]), self._matrix(tool[5])),
            lower=np.array([i[8] for i in info]),
            upper=np.array([i[9] for i in info]),
        )

    def _matrix(self, quaternion: tuple[float, float, float, float]) -> Array:
        return np.array(self._client.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
