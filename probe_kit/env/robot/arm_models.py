"""The supported arms: URDF file, joints, and grasp of the cube."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from probe_kit.env.robot.widowx import write_urdf
from probe_kit.env.spec import XYZ
from probe_kit.scene_names import ArmName


@dataclass(frozen=True)
class ArmModel:
    """The constants of one arm: joints, links, fingers and limits.

    urdf: finds the description file on this machine, or writes it into the folder it is given.
    base: where it stands in the world. joints, fingers, tool: link indices in PyBullet's order.
    closed, opened: finger joint positions in metres; both fingers move alike.
    down: rotation (3, 3) of the tool link when the gripper points down and its fingers open along y.
    posture: joint angles the arm starts from when it looks for its home pose, and drifts back to.
    clearance: lowest tool height at which the finger tips stay off the table.
    hand_drop: how far the middle of a held object hangs below the tool.
    pads: finger joint position at which the pads would meet.
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
