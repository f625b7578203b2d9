"""A URDF of the WidowX-250S, generated from the table below and the meshes of the `rtb-data` package.

PyBullet reads URDF but not xacro, which is all that package has. Lengths in metres, angles in radians, masses in
kilograms. The gripper's bar and propeller belong to one rigid link here, and inertia is left to PyBullet.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from math import pi, radians
from pathlib import Path

from probe_kit.env.spec import XYZ
from probe_kit.errors import SceneError

MESH_FOLDER = Path("xacro/trossen_descriptions/meshes/meshes_wx250s")
GREY = "0.13 0.13 0.13 1"
EFFORT = 100.0
FINGER_EFFORT = 10.0
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

    Raises SceneError if the meshes are not installed.
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
