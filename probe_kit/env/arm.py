"""The arm: its URDF, the arm in the simulation, and the conversion of actions to joint angles.

The WidowX-250S is generated from a table and the meshes of the `rtb-data` package. PyBullet reads URDF but not
xacro, which is all that package has. Lengths are in metres, angles in radians, masses in kilograms. The gripper's
bar and propeller belong to one rigid link here, and inertia is left to PyBullet.

Actions follow the Bridge convention of SimplerEnv. Deltas accumulate on the pose that was last *commanded*, not on
the measured one, so that tracking errors do not add up. The rotation delta turns about the fixed axes of the
world, through the tool.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from math import pi, radians
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from probe_kit._system.types import Matrix
from probe_kit.env.rotations import Pose, SerialChain, from_euler_xyz, from_rpy, to_rpy
from probe_kit.env.simulation import BulletClient, import_pybullet
from probe_kit.env.spec import XYZ, Euler, LimitSpec, PhysicsSpec
from probe_kit.errors import ActionError, SceneError
from probe_kit.scene_names import ArmName

MESH_FOLDER = Path("xacro/trossen_descriptions/meshes/meshes_wx250s")
GREY = "0.13 0.13 0.13 1"
EFFORT = 100.0
"""Largest torque of a joint in the description, in N m."""
FINGER_EFFORT = 10.0
"""Largest force of a finger in the description, in N."""
ORIGIN: XYZ = (0.0, 0.0, 0.0)
QUARTER: XYZ = (0.0, 0.0, pi / 2)


@dataclass(frozen=True)
class _Link:
    """A link, its meshes, and the joint that carries it."""

    name: str
    mass: float
    meshes: tuple[str, ...] = ()
    mesh_xyz: XYZ = ORIGIN
    mesh_rpy: XYZ = ORIGIN
    parent: str = ""
    joint: str = "revolute"
    axis: XYZ = ORIGIN
    xyz: XYZ = ORIGIN
    rpy: XYZ = ORIGIN
    limits: tuple[float, float] = (-pi, pi)


Z: XYZ = (0.0, 0.0, 1.0)
Y: XYZ = (0.0, 1.0, 0.0)
X: XYZ = (1.0, 0.0, 0.0)
RIGHTWARDS: XYZ = (0.0, -1.0, 0.0)
FINGER_LIMITS = (0.015, 0.037)

LINKS = (
    _Link("base", 0.539, ("1-Base",), mesh_rpy=QUARTER),
    _Link("shoulder", 0.481, ("2-Shoulder",), (0, 0, -0.003), QUARTER, "base", axis=Z, xyz=(0, 0, 0.0716)),
    _Link(
        "upper_arm", 0.431, ("3-UA",), ORIGIN, QUARTER, "shoulder", axis=Y, xyz=(0, 0, 0.03865),
        limits=(radians(-108), radians(114)),
    ),
    _Link(
        "upper_forearm", 0.235, ("4-UF",), parent="upper_arm", axis=Y, xyz=(0.04975, 0, 0.25), rpy=(pi, 0, 0),
        limits=(radians(-92), radians(123)),
    ),
    _Link("lower_forearm", 0.221, ("5-LF",), parent="upper_forearm", axis=X, xyz=(0.175, 0, 0)),
    _Link(
        "wrist", 0.085, ("6-Wrist",), ORIGIN, (0, pi, pi / 2), "lower_forearm", axis=Y, xyz=(0.075, 0, 0),
        limits=(radians(-123), radians(100)),
    ),
    _Link(
        "gripper", 0.113, ("7-Gripper", "8-Gripper-Prop", "9-Gripper-Bar"), (-0.02, 0, 0), QUARTER, "wrist",
        axis=X, xyz=(0.065, 0, 0), rpy=(-pi, 0, 0),
    ),
    _Link(
        "left_finger", 0.016, ("10-Finger",), (0, 0.005, 0), (pi, pi, 0), "gripper", "prismatic", Y,
        (0.066, 0, 0), limits=FINGER_LIMITS,
    ),
    _Link(
        "right_finger", 0.016, ("10-Finger",), (0, -0.005, 0), (0, pi, 0), "gripper", "prismatic", RIGHTWARDS,
        (0.066, 0, 0), limits=FINGER_LIMITS,
    ),
    _Link("tool", 0.001, parent="gripper", joint="fixed", xyz=(0.093575, 0, 0)),
)  # fmt: skip


def write_urdf(folder: Path) -> Path:
    """Write the description into `folder` and return its path.

    Raises:
        SceneError: If the meshes are not installed.
    """
    meshes = _find_meshes()
    parts = [_link_xml(link, meshes) + (_joint_xml(link) if link.parent else "") for link in LINKS]
    path = folder / "widowx.urdf"
    path.write_text(f'<robot name="widowx">\n{"".join(parts)}</robot>\n', encoding="utf-8")
    return path


def _find_meshes() -> Path:
    package = find_spec("rtbdata")
    if package is None or package.origin is None:
        raise SceneError(
            "the WidowX needs the meshes of the package `rtb-data`, which comes with probe_kit and is not here. "
            "Install `rtb-data>=2,<3`, give a description of your own with `arm_urdf`, or use the arm `panda`."
        )
    folder = Path(package.origin).parent / MESH_FOLDER
    if not folder.is_dir():
        raise SceneError(f"{folder} does not exist; this `rtb-data` is not version 2. Install `rtb-data>=2,<3`.")
    return folder


def _link_xml(link: _Link, meshes: Path) -> str:
    origin = _origin(link.mesh_xyz, link.mesh_rpy)
    material = f'<material name="grey"><color rgba="{GREY}"/></material>'
    shapes = "".join(
        f'    <{kind}>{origin}<geometry><mesh filename="{meshes}/WXSA-250-M-{mesh}.stl" '
        f'scale="0.001 0.001 0.001"/></geometry>{material}</{kind}>\n'
        for mesh in link.meshes
        for kind in ("visual", "collision")
    )
    inertia = f'<mass value="{link.mass}"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
    return f'  <link name="{link.name}">\n    <inertial>{inertia}</inertial>\n{shapes}  </link>\n'


def _joint_xml(link: _Link) -> str:
    effort = FINGER_EFFORT if link.joint == "prismatic" else EFFORT
    lower, upper = link.limits
    return (
        f'  <joint name="{link.name}_joint" type="{link.joint}"><parent link="{link.parent}"/>'
        f'<child link="{link.name}"/>{_origin(link.xyz, link.rpy)}<axis xyz="{_numbers(link.axis)}"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{pi}"/></joint>\n'
    )


def _origin(xyz: XYZ, rpy: XYZ) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _numbers(vector: XYZ) -> str:
    return " ".join(f"{value:.9g}" for value in vector)


# -- kinds of arms --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArmModel:
    """The constants of one arm: joints, links, fingers and limits.

    Attributes:
        urdf: Function that finds the description file on this machine, or writes it into the folder that it is
            given.
        base: Position of the base in the world, in metres.
        joints: Link indices of the joints, in PyBullet's order.
        fingers: Link indices of the two fingers.
        tool: Link index of the tool.
        closed: Finger joint position of the closed gripper in metres; both fingers move alike.
        opened: Finger joint position of the open gripper in metres.
        down: Rotation (3, 3) of the tool link when the gripper points down and its fingers open along y.
        posture: Joint angles in radians from which the search for the home pose starts, and to which a redundant
            arm drifts.
        clearance: Lowest tool height, in metres, at which the finger tips stay off the table.
        hand_drop: Metres by which the middle of a held object hangs below the tool.
        pads: Finger joint position, in metres, at which the pads would meet.
    """

    urdf: Callable[[Path], Path]
    base: XYZ
    joints: tuple[int, ...]
    fingers: tuple[int, int]
    tool: int
    closed: float
    opened: float
    down: tuple[XYZ, XYZ, XYZ]
    posture: tuple[float, ...]
    clearance: float
    hand_drop: float = 0.0
    pads: float = 0.0


def _panda_urdf(_: Path) -> Path:
    import pybullet_data

    return Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"


# The base stands 0.30 m behind the frame of the WidowX, so that both arms work in the same place.
PANDA = ArmModel(
    urdf=_panda_urdf,
    base=(-0.30, 0.0, 0.0),
    joints=(0, 1, 2, 3, 4, 5, 6),
    fingers=(9, 10),
    tool=11,
    closed=0.0,
    opened=0.04,
    down=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    posture=(-0.0053, 0.3487, -0.0049, -2.0587, 0.0025, 2.4074, 0.7736),
    clearance=0.010,
)

# Its finger tips reach 19 mm below the tool, so that it holds things lower than the Panda does.
WIDOWX = ArmModel(
    urdf=write_urdf,
    base=(0.0, 0.0, 0.0),
    joints=(0, 1, 2, 3, 4, 5),
    fingers=(6, 7),
    tool=8,
    closed=0.015,
    opened=0.037,
    down=((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    posture=(-0.0184, 0.0399, -0.2224, 0.0046, -1.3652, -0.0015),
    clearance=0.0225,
    hand_drop=0.0075,
    pads=0.011,
)

ARMS: Mapping[ArmName, ArmModel] = MappingProxyType({"panda": PANDA, "widowx": WIDOWX})


# -- the arm in the simulation --------------------------------------------------------------------------------

POSITION_GAIN = 0.3
VELOCITY_GAIN = 1.0
"""Gains of PyBullet's position control, without unit: shares of an error that one simulation step corrects."""
GEAR_FORCE = 50.0
GEAR_ERP = 0.1
"""Force, in N, and share of an error corrected in a step, of the gear by which one finger mirrors the other."""


class Arm:
    """An arm loaded into a physics server.

    Joint angles are (n,) radians; an opening is 1 for an open and 0 for a closed gripper.

    Raises:
        SceneError: If the description is missing, cannot be read, or has other joints than the model.
    """

    def __init__(self, client: BulletClient, model: ArmModel, physics: PhysicsSpec, urdf: Path) -> None:
        self._client = client
        self._physics = physics
        self.model = model
        self.body: int = self._load(urdf)
        self._efforts = [client.getJointInfo(self.body, j)[10] for j in model.joints]
        self._couple_fingers()
        self.chain = self._measure_chain()

    def set_joints(self, q: Matrix, opening: float) -> None:
        """Set the joints to these angles at rest, without moving through the space between."""
        for joint, angle in zip(self.model.joints, q, strict=True):
            self._client.resetJointState(self.body, joint, angle)
        for finger in self.model.fingers:
            self._client.resetJointState(self.body, finger, self._finger_position(opening))

    def command_gripper(self, opening: float) -> None:
        """Command the fingers to an opening, until another command comes."""
        for finger in self.model.fingers:
            self._client.setJointMotorControl2(
                self.body,
                finger,
                self._client.POSITION_CONTROL,
                targetPosition=self._finger_position(opening),
                force=self._physics.grip_force,
                maxVelocity=self._physics.finger_speed,
            )

    def command_joints(self, q: Matrix) -> None:
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

    def joints(self) -> Matrix:
        """Return the measured joint angles (n,)."""
        return np.array([state[0] for state in self._client.getJointStates(self.body, self.model.joints)])

    def posture(self) -> tuple[float, ...]:
        """Return the positions of all joints, also of fingers and of joints that nothing drives."""
        joints = range(self._client.getNumJoints(self.body))
        return tuple(state[0] for state in self._client.getJointStates(self.body, joints))

    def tool_state(self) -> Matrix:
        """Return the measured x, y, z, roll, pitch, yaw (6,) of the tool.

        The angles are relative to pointing down.
        """
        pose = self.chain.pose(self.joints())
        return np.concatenate([pose.position, to_rpy(pose.rotation @ np.array(self.model.down).T)])

    def opening(self) -> float:
        """Return the measured opening of the gripper, 0 closed to 1 open."""
        states = self._client.getJointStates(self.body, self.model.fingers)
        middle = sum(state[0] for state in states) / 2
        span = self.model.opened - self.model.closed
        return float(np.clip((middle - self.model.closed) / span, 0.0, 1.0))

    def tool_down(self, position: XYZ, rpy: XYZ = (0.0, 0.0, 0.0)) -> Pose:
        """Return the pose with the tool at `position` and the gripper pointing down, except for a turn `rpy`."""
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
        """Gear the fingers to each other: alone, they share the load unevenly and drop the cube 1 cm off."""
        client, (left, right) = self._client, self.model.fingers
        gear = client.createConstraint(
            self.body, left, self.body, right, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
        )
        client.changeConstraint(gear, gearRatio=-1, erp=GEAR_ERP, maxForce=GEAR_FORCE)
        for finger in self.model.fingers:
            # Without the anchor a held cube creeps along the light fingers of the WidowX, up to 28 mm per episode.
            client.changeDynamics(self.body, finger, lateralFriction=self._physics.friction, frictionAnchor=1)

    def _measure_chain(self) -> SerialChain:
        """Read the screws of the loaded robot at q = 0."""
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

    def _matrix(self, quaternion: tuple[float, float, float, float]) -> Matrix:
        return np.array(self._client.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


# -- actions --------------------------------------------------------------------------------------------------

ACTION_SIZE = 7
OPEN_ABOVE = 0.5


@dataclass(frozen=True)
class Move:
    """The motion of the arm for one action.

    Attributes:
        q_from: (n,) commanded joints before the action, in radians.
        q_to: (n,) commanded joints after the action, in radians.
        opening: Commanded opening of the gripper, 1 open, 0 closed.
        clipped: Whether a limit changed the action.
        ik_error: Metres that remain to the requested position.
        shift: (3,) metres by which the commanded pose really moved, in the convention of the action.
        turn: (3,) radians by which the commanded pose really turned, in the convention of the action.
    """

    q_from: Matrix
    q_to: Matrix
    opening: float
    clipped: bool
    ik_error: float
    shift: Matrix
    turn: Matrix


def check_action(action: ArrayLike) -> Matrix:
    """Return the action as float64 (7,).

    Raises:
        ActionError: If it is not numeric, has another shape or is not finite.
    """
    try:
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"action {action!r} is not numeric; expected 7 finite numbers.") from error
    if values.shape != (ACTION_SIZE,):
        raise ActionError(
            f"action has shape {values.shape}; expected (7,): xyz delta, roll-pitch-yaw delta, gripper. "
            "Pass one action of a chunk at a time."
        )
    if not np.isfinite(values).all():
        raise ActionError(
            f"action {values.tolist()} is not finite (NaN or infinity); the environment did not move."
        )
    return values


class DeltaController:
    """A controller that keeps the commanded tool pose `target` and joints `q`, and moves both action by action.

    Args:
        arm: Arm in the simulation.
        limits: Limits of actions, workspace and inverse kinematics.
        q: (n,) commanded joints at the start, in radians.
        euler: Convention of the rotation of an action, see `SceneSpec`.
    """

    def __init__(self, arm: Arm, limits: LimitSpec, q: Matrix, euler: Euler = "zyx") -> None:
        self._arm = arm
        self._limits = limits
        floor = (-np.inf, -np.inf, arm.model.clearance)
        self._low = None if limits.low is None else np.maximum(limits.low, floor)
        self._rotation = from_euler_xyz if euler == "xyz" else from_rpy
        self.q = q
        self.target: Pose = arm.chain.pose(q)

    def command(self, action: Matrix) -> Move:
        """Advance the commanded pose by a checked action (7,), or hold it if the new one is out of reach."""
        limits = self._limits
        shift, turn = _within(action[:3], limits.translation), _within(action[3:6], limits.rotation)
        position = self.target.position + shift
        if self._low is not None or limits.high is not None:
            position = np.clip(position, self._low, limits.high)
        shift = position - self.target.position
        pose = Pose(position, self._rotation(turn) @ self.target.rotation)
        clipped = not np.allclose(shift, action[:3], atol=1e-9) or bool((turn != action[3:6]).any())

        q_from = self.q
        solution = self._arm.chain.solve(pose, q_from, np.array(self._arm.model.posture))
        if solution.error <= limits.ik_error and solution.turn_error <= limits.ik_turn_error:
            self.q, self.target = solution.q, pose
        else:
            shift, turn = np.zeros(3), np.zeros(3)
        opening = 1.0 if action[6] > OPEN_ABOVE else 0.0
        return Move(q_from, self.q, opening, clipped, solution.error, shift, turn)


def _within(values: Matrix, largest: float | None) -> Matrix:
    return values if largest is None else np.clip(values, -largest, largest)
