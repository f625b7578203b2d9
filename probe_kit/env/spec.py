"""All parameters of the scene in one frozen record, which is stored with every run.

Frame: the world frame is the base frame of the WidowX of BridgeV2. The axis +x points away from the robot, +y to
its left, +z up, and the table top is z = 0.

Units: metres, radians, seconds, kilograms, newtons.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import read_regular
from probe_kit.env.urdf_files import files_of_description
from probe_kit.errors import SceneError
from probe_kit.scene_names import ArmName, Rendering
from probe_kit.suite.items import Side

XY = tuple[float, float]
XYZ = tuple[float, float, float]
Euler = Literal["zyx", "xyz"]

EPSILON_MARGIN = 0.01
"""Metres that the default outcome radius adds to half a tile side (the rule of VL-Think)."""


LARGEST = 10.0
"""Largest metres, kilograms, or times the default light that suit a table top and a camera."""
LARGEST_PICTURE = 8192
_MOST = {"max_steps": 10_000}


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera without distortion; the default is the Bridge third-person view of SimplerEnv.

    Attributes:
        eye: Position in the world, in metres.
        forward: Viewing direction (any length) in the world; +z is up in the picture.
        width: Width of the rendered picture in pixels.
        height: Height of the rendered picture in pixels.
        fov: Vertical field of view in degrees.
        near: Distance of the near clipping plane in metres.
        far: Distance of the far clipping plane in metres.
    """

    eye: XYZ = (0.0, -0.16, 0.36)
    forward: XYZ = (1.0, 0.553, -1.085)
    width: int = 640
    height: int = 480
    fov: float = 42.1004
    near: float = 0.01
    far: float = 10.0

    @property
    def focal_length(self) -> float:
        """The focal length in rendered pixels, the same in both directions."""
        return float(self.height / 2 / np.tan(np.radians(self.fov) / 2))


@dataclass(frozen=True)
class LightSpec:
    """One lamp without shadows, and the share of light of each way of reflection.

    A white tile on the table reflects 0.77 of full scale. So the brightest ablation of the paper (30 % more)
    reaches white without clipping.

    Attributes:
        direction: Direction towards the lamp.
    """

    direction: XYZ = (0.2, -0.6, 1.5)
    ambient: float = 0.45
    diffuse: float = 0.35
    specular: float = 0.05


@dataclass(frozen=True)
class PhysicsSpec:
    """The time of the simulation: 48 substeps at 240 Hz make one action at 5 Hz.

    A strong grip on a light cube needs many solver iterations. 40 N with 30 iterations squeezes the cube out of
    the hand every time, 15 N with 100 never did.
    """

    rate: float = 240.0
    substeps: int = 48
    solver_iterations: int = 100
    grip_force: float = 15.0
    finger_speed: float = 0.12
    friction: float = 1.0


@dataclass(frozen=True)
class LimitSpec:
    """The limits of the controller; anything beyond is clipped and counted.

    For the first four fields, None means no such limit.

    Attributes:
        translation: Largest change of the position per action and axis, in metres.
        rotation: Largest change of the rotation per action and axis, in radians.
        low: Lower corner of the box in which the commanded tool position stays; its floor is raised to the finger
            clearance of the arm. Without `low`, nothing keeps the fingers off the table.
        high: Upper corner of that box.
        ik_error: Most metres that may remain to the requested pose; with more, the arm holds still instead of
            moving.
        ik_turn_error: Most radians that may remain to the requested pose, likewise.
    """

    translation: float | None = 0.10
    rotation: float | None = 0.50
    low: XYZ | None = (0.15, -0.30, 0.0)
    high: XYZ | None = (0.50, 0.30, 0.40)
    ik_error: float = 0.005
    ik_turn_error: float = 0.05

    @classmethod
    def off(cls) -> Self:
        """Return limits without any limit but the reach of the arm."""
        return cls(translation=None, rotation=None, low=None, high=None)

    def contain(self, position: XYZ) -> bool:
        """Whether the box contains a tool position."""
        above = self.low is None or all(a <= b for a, b in zip(self.low, position, strict=True))
        return above and (self.high is None or all(a <= b for a, b in zip(position, self.high, strict=True)))


@dataclass(frozen=True)
class SceneSpec:
    """The whole experiment but the question: places, robot, camera, light, physics and limits.

    Attributes:
        name: Name of the preset that it was made from.
        arm: Name of the arm, `panda` or `widowx`.
        arm_urdf: Description of the arm to load instead of ours; None for ours.
        tile_left: Centre (x, y) of the left tile.
        tile_right: Centre (x, y) of the right tile.
        tile_yaw: Turn of both tiles about +z; at zero the top of a picture points away from the robot.
        tile_side: Side of a tile.
        tile_height: Height of a tile.
        cube_xy: Start of the cube, give or take `start_jitter` per axis, drawn uniformly from the seed of the
            episode.
        cube_yaw: Turn of the cube about +z at the start, give or take `start_jitter_yaw`, drawn likewise.
        cube_color: RGB in [0, 1].
        epsilon: Radius of the outcome zones around the tile centres; None means tile_side / 2 + 0.01.
        home: Tool position at the start; the gripper points down, except for `home_rpy`.
        home_rpy: Roll, pitch, yaw about the world axes by which the gripper is turned from pointing down.
        home_joints: Joint angles of that pose for `arm`; None to search for some.
        home_opening: Opening of the gripper at the start, 1 is open.
        start_grasped: Whether the cube is in the hand at the start.
        closing_steps: Number of actions at rest in which the hand closes around the cube at the start. With 0, the
            cube is put in the middle of the hand. Otherwise it waits at `cube_xy` and `cube_z` until the hand has
            closed, without gravity during the first action, and counts as untouched from then on.
        cube_z: Height of the cube's middle at the start; None for lying on the table.
        forced_closed: Number of actions at an episode's start during which the gripper stays shut, whatever the
            policy commands.
        tile_mass: Mass of each tile; 0 fixes them to the table.
        euler: Convention of the rotation of an action: `zyx` is roll, pitch, yaw about fixed axes, `xyz` is the
            opposite order.
        scoring_side: Tile side of the rule `box`, whatever size the tiles are drawn in. Its box reaches
            scoring_side / 2 + box_margin from the middle of a tile along x and y, and up from box_height over it.
        box_margin: Margin of that box around the tile side.
        box_height: Least height in that box over the middle of a tile.
        max_steps: Actions per episode.
        early_stop: Whether an episode ends when the cube was released and lay still for 5 actions.
        moved: Distance from its start at which the cube counts as moved.
        rendering: Name of the rendering: `raw`, or `visual-matching` to lay robot, cube and tiles over a photo.
        background: Photo behind the scene; None for our own wooden table.
        picture_size: Width and height in pixels of the policy's picture; None for the rendered size.
        light_level: Factor of all light; a photo behind the scene gets darker and brighter with it.

    Raises:
        SceneError: If the zones overlap, or the untouched cube would already lie in one. Also if the home pose is
            outside the limits, or a value makes no sense.
    """

    name: str = "bridge"
    arm: ArmName = "panda"
    arm_urdf: Path | None = None
    tile_left: XY = (0.397, 0.183)
    tile_right: XY = (0.397, -0.127)
    tile_yaw: float = 0.0
    tile_side: float = 0.11
    tile_height: float = 0.006
    cube_xy: XY = (0.247, 0.028)
    cube_yaw: float = 0.0
    cube_side: float = 0.03
    cube_mass: float = 0.027
    cube_color: XYZ = (0.13, 0.70, 0.20)
    start_jitter: float = 0.0
    start_jitter_yaw: float = 0.0
    epsilon: float | None = None
    home: XYZ = (0.292, -0.006, 0.16)
    home_rpy: XYZ = (0.0, 0.0, 0.0)
    home_joints: tuple[float, ...] | None = None
    home_opening: float = 1.0
    start_grasped: bool = False
    closing_steps: int = 0
    cube_z: float | None = None
    forced_closed: int = 0
    tile_mass: float = 0.0
    euler: Euler = "zyx"
    scoring_side: float = 0.11
    box_margin: float = 0.08
    box_height: float = 0.008
    max_steps: int = 60
    early_stop: bool = False
    moved: float = 0.03
    rendering: Rendering = "raw"
    background: Path | None = None
    picture_size: tuple[int, int] | None = None
    camera: CameraSpec = field(default_factory=CameraSpec)
    light: LightSpec = field(default_factory=LightSpec)
    light_level: float = 1.0
    physics: PhysicsSpec = field(default_factory=PhysicsSpec)
    limits: LimitSpec = field(default_factory=LimitSpec)

    def __post_init__(self) -> None:
        self._check_values()
        self._check_zones()

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Self:
        """Return a named scene, with fields replaced: `bridge` (default), `frontal`, `vl-think` or `act2answer`.

        Another arm than the preset's starts from the same pose of its tool, with joint angles of its own.

        Raises:
            SceneError: For an unknown name or field, or for a background that the rendering does not show.
        """
        if name not in PRESETS:
            raise SceneError(f"no scene preset {name!r}; there are {', '.join(PRESETS)}.")
        unknown = sorted(set(changes) - set(cls.__dataclass_fields__))
        if unknown:
            near = get_close_matches(unknown[0], cls.__dataclass_fields__, n=1)
            hint = f"did you mean {near[0]!r}?" if near else "see `help(SceneSpec)` for all of them."
            raise SceneError(f"SceneSpec has no field {unknown[0]!r}; {hint}")
        fields = {**PRESETS[name], **changes}
        other_arm = fields.get("arm", cls.arm) != PRESETS[name].get("arm", cls.arm)
        if other_arm and "home_joints" not in changes:
            fields["home_joints"] = None
        scene = replace(cls(name=name), **fields)
        if scene.background is not None and scene.rendering == "raw":
            raise SceneError(
                f"the background {str(scene.background)!r} would not be seen: the scene's rendering is 'raw'. "
                "Give rendering='visual-matching' (--rendering visual-matching) too, or leave it out"
            )
        return scene

    @property
    def zone_radius(self) -> float:
        """The radius of the outcome zones in metres: `epsilon`, or the rule when it is None."""
        return self.tile_side / 2 + EPSILON_MARGIN if self.epsilon is None else self.epsilon

    @property
    def box_half(self) -> float:
        """Half the side of the box of the rule `box`, in metres."""
        return self.scoring_side / 2 + self.box_margin

    @property
    def cube_start_z(self) -> float:
        """The height of the middle of the cube when it is put down, in metres: `cube_z`, or lying on the table."""
        return self.cube_side / 2 if self.cube_z is None else self.cube_z

    @property
    def picture_shape(self) -> tuple[int, int]:
        """The height and width in pixels of the policy's picture."""
        width, height = self.picture_size or (self.camera.width, self.camera.height)
        return height, width

    @property
    def intrinsics(self) -> NDArray[np.float32]:
        """The pinhole matrix (3, 3) of the policy's picture, in its pixels.

        x points right, y down, and (0, 0) is the upper left corner.
        """
        (height, width), camera = self.picture_shape, self.camera
        across, down = width / camera.width, height / camera.height
        focal = camera.focal_length
        matrix = [[focal * across, 0, width / 2], [0, focal * down, height / 2], [0, 0, 1]]
        return np.array(matrix, np.float32)

    def tile_xy(self, side: Side) -> XY:
        """Return the centre of the tile on `side`."""
        return self.tile_left if side == "left" else self.tile_right

    def to_json(self) -> dict[str, Any]:
        """Return the record as plain JSON values, with the outcome radius that is really used.

        A file is identified by the sha256 of its content, not by its path; an arm's description by that of itself
        and of the meshes, materials and textures that it names.

        Raises:
            SceneError: If a file cannot be read.
        """
        plain = asdict(self) | {"epsilon": self.zone_radius}
        return {
            key: _content_sha256(key, value) if isinstance(value, Path) else value for key, value in plain.items()
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any], files: Mapping[str, Path] = MappingProxyType({})) -> Self:
        """Make the record from the values of `to_json`, as a run stores them.

        Args:
            values: Values that `to_json` returned.
            files: By field, the file that the values name by its hash.

        Raises:
            SceneError: If a file is not given or has other content, or the scene was made without it. Also for a
                field of another version.
        """
        parts = {"camera": CameraSpec, "light": LightSpec, "physics": PhysicsSpec, "limits": LimitSpec}
        unknown = sorted(set(values) - set(cls.__dataclass_fields__))
        if unknown:
            raise SceneError(
                f"a stored scene has the field {unknown[0]!r}, which is unknown to this version; read it with the "
                "version that wrote it"
            )
        fields: dict[str, Any] = {name: _as_tuple(value) for name, value in values.items()}
        with_files = [name for name in ("arm_urdf", "background") if fields.get(name) is not None]
        if without := sorted(set(files) - set(with_files)):
            names = ", ".join(with_files) or "none"
            raise SceneError(f"the scene was made without a file as {without[0]}; it has {names}. Leave it out")
        for name in with_files:
            fields[name] = _file_of(name, str(fields[name]), files)
        fields |= {name: part(**_as_tuples(values[name])) for name, part in parts.items() if name in values}
        return cls(**fields)

    def _check_values(self) -> None:
        positive = {
            "tile_side": self.tile_side,
            "tile_height": self.tile_height,
            "cube_side": self.cube_side,
            "cube_mass": self.cube_mass,
            "epsilon": self.zone_radius,
            "max_steps": self.max_steps,
            "light_level": self.light_level,
            "scoring_side": self.scoring_side,
        }
        for name, value in positive.items():
            if not 0 < value <= _MOST.get(name, LARGEST):
                raise SceneError(
                    f"{name} is {value}; expected a positive number of at most {_MOST.get(name, LARGEST):g}."
                )
        if self.picture_size is not None and not all(1 <= side <= LARGEST_PICTURE for side in self.picture_size):
            raise SceneError(
                f"picture_size is {self.picture_size}; expected 1 to {LARGEST_PICTURE} pixels a side."
            )
        for name in ("closing_steps", "forced_closed", "tile_mass", "box_margin", "box_height"):
            if not getattr(self, name) >= 0:
                raise SceneError(f"{name} is {getattr(self, name)}; expected zero or a positive number.")
        for name, options in (("rendering", Rendering), ("arm", ArmName), ("euler", Euler)):
            choices = get_args(options)
            if getattr(self, name) not in choices:
                raise SceneError(f"{name} {getattr(self, name)!r} does not exist; use {' or '.join(choices)}.")
        if not 0 <= self.home_opening <= 1:
            raise SceneError(f"home_opening is {self.home_opening}; expected 0 (closed) to 1 (open).")
        if self.closing_steps and not self.start_grasped:
            raise SceneError("closing_steps close the hand around the cube; they need `start_grasped=True`.")
        if not self.limits.contain(self.home):
            low, high = self.limits.low, self.limits.high
            raise SceneError(
                f"home {self.home} is outside the workspace {low} to {high}. Change `home` or `limits`."
            )

    def _check_zones(self) -> None:
        radius, gap = self.zone_radius, float(np.hypot(*np.subtract(self.tile_left, self.tile_right)))
        if not 2 * radius < gap:
            raise SceneError(
                f"outcome zones of radius {radius:.3f} m overlap: the tile centres are {gap:.3f} m apart. "
                "Use a smaller `epsilon` or move the tiles apart."
            )
        reach = radius + self.moved + self.start_jitter * np.sqrt(2)
        for tile in (self.tile_left, self.tile_right):
            if float(np.hypot(*np.subtract(self.cube_xy, tile))) <= reach:
                raise SceneError(
                    f"a cube that starts at {self.cube_xy} may lie in the zone of the tile at {tile} without "
                    "having been moved. Use a smaller `epsilon` or `start_jitter`, or start it elsewhere."
                )


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def _as_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _as_tuple(value) for name, value in values.items()}


def _file_of(name: str, expected: str, files: Mapping[str, Path]) -> Path:
    """Return the file that a stored scene names by its hash."""
    if name not in files:
        raise SceneError(f"the scene was made with a file as {name}, {expected[:19]}…; give that file again")
    if (content := _content_sha256(name, files[name])) != expected:
        raise SceneError(
            f"{files[name]} is {content[:19]}…; the scene was made with {expected[:19]}… as {name}. Give that file"
        )
    return files[name]


def _content_sha256(name: str, path: Path) -> str:
    """Return the hash of a scene's file; of an arm's description also over the meshes that it names."""
    try:
        (_, content), *meshes = files_of_description(path) if name == "arm_urdf" else [("", read_regular(path))]
        digest = hashlib.sha256(content)
        for spelled, content in meshes:
            digest.update(f"{spelled}\0{len(content)}\0".encode("utf-8", "surrogateescape"))
            digest.update(content)
        return f"sha256:{digest.hexdigest()}"
    except OSError as error:
        raise SceneError(
            f"{path} cannot be read ({error.strerror}). Give another file, or leave it out."
        ) from error


PRESETS: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "bridge": {},
        "vl-think": {"home": (0.292, -0.006, 0.135)},
        "frontal": {
            "tile_left": (0.285, 0.176),
            "tile_right": (0.435, -0.096),
            "tile_yaw": 0.505,
            "cube_xy": (0.255, -0.019),
            "cube_yaw": 0.505,
            "home": (0.292, 0.0, 0.16),
        },
        "act2answer": {
            "arm": "widowx",
            "tile_side": 0.1452,
            "tile_mass": 0.81,
            "cube_xy": (0.2780, -0.0131),
            "cube_z": 0.1430,
            "cube_color": (0.784, 0.784, 0.784),
            "home": (0.2921, -0.0061, 0.1349),
            "home_rpy": (-0.0045, 0.0568, -0.0190),
            "home_joints": (-0.01840777, 0.0398835, -0.22242722, -0.00460194, -1.36524296, 0.00153398),
            "home_opening": 0.8,
            "start_grasped": True,
            "closing_steps": 10,
            "forced_closed": 15,
            "max_steps": 80,
            "euler": "xyz",
            "rendering": "visual-matching",
            "limits": LimitSpec.off(),
        },
    }
)
"""Changes of each named scene to the default one.

bridge: places of VL-Think, camera of SimplerEnv, and a home pose 25 mm higher than theirs. So the gripper hides
nothing
of either picture in the first frame, the one that probes read.

vl-think: their home pose as well; the gripper then hides 4 % of the left picture.

act2answer: the protocol that was released with the paper, as far as it is available here. The cube is in the hand
already, tiles are larger and can be pushed, and nothing limits an action.

frontal: the same camera, but everything lies symmetric about its vertical plane and is turned towards it. So both
pictures have the same size and shape on screen.
"""
