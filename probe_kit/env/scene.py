"""The table top in the physics server: table, tiles, cube and arm, built once and restored per episode."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from probe_kit.env.arm import Arm
from probe_kit.env.arm_models import ARMS
from probe_kit.env.background import load_photo, wooden_table
from probe_kit.env.bullet import BulletClient
from probe_kit.env.camera import Backdrop, Camera, Frame, Picture
from probe_kit.env.rotations import Array, yaw_quaternion
from probe_kit.env.spec import XYZ, SceneSpec
from probe_kit.env.tiles import TextureCache, write_quad
from probe_kit.errors import SceneError
from probe_kit.suite.items import Side

SIDES: tuple[Side, Side] = ("left", "right")
TABLE_SIZE = (1.30, 1.40, 0.04)
TABLE_CENTRE = (0.25, 0.0, -0.02)
TABLE_COLOR = (0.69, 0.49, 0.32, 1.0)
FLOOR_SIZE = (8.0, 8.0, 0.02)
FLOOR_CENTRE = (0.0, 0.0, -0.75)
FLOOR_COLOR = (0.62, 0.64, 0.66, 1.0)
TILE_COLOR = (0.85, 0.85, 0.83, 1.0)
INVISIBLE = (0.0, 0.0, 0.0, 0.0)
LIMBO = (0.0, 0.0, 5.0)
"""Where the cube waits in the saved state, so far up that it touches nothing."""
GRASP_GAP = 0.003
"""Space between each finger and a cube that starts in the hand, before the fingers close, metres."""
QUAD_LIFT = 0.0005
"""How far the picture lies above its box, metres; enough for the depth buffer to tell them apart."""


@dataclass(frozen=True)
class CubeState:
    """Where the cube is: position (3,), quaternion (4,) as x, y, z, w, and linear speed in m/s."""

    position: Array
    quaternion: Array
    speed: float


class Scene:
    """The bodies of one scene and the simulator that moves them.

    Bodies are created in a fixed order and never afterwards: segmentation ids and saved states depend on it.
    """

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        self.client = BulletClient()
        self.camera = Camera(spec.camera)
        self._folder = tempfile.TemporaryDirectory(prefix="probe-kit-scene-")
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the simulator and its temporary files; a second call does nothing."""
        self.client.close()
        self._folder.cleanup()

    def reset(self, pictures: Mapping[Side, Image.Image], cube_position: XYZ, cube_yaw: float) -> None:
        """Put everything back to its start, with these pictures on the tiles."""
        if not (self._healthy and self.textures.has_room(len(pictures))):
            # restoreState does not heal a state that was once not finite, and only a reload frees textures.
            self._build()
        self.client.restoreState(self._saved)
        # The saved cube floats far above the table: one step lets contacts of the last episode expire.
        self.client.stepSimulation()
        for side in SIDES:
            texture = self.textures.load(pictures[side])
            self.client.changeVisualShape(self.quads[side], -1, textureUniqueId=texture)
        self.client.resetBasePositionAndOrientation(self.cube, cube_position, yaw_quaternion(cube_yaw))
        self.client.resetBaseVelocity(self.cube, (0, 0, 0), (0, 0, 0))
        self.arm.place(self.home_q, 1.0)
        self.arm.command_gripper(1.0)

    def advance(self, q_from: Array, q_to: Array, opening: float) -> bool:
        """Drive the arm from one commanded posture to the next in one action; False if the state broke."""
        self.arm.command_gripper(opening)
        for share in np.linspace(0.0, 1.0, self.spec.physics.substeps + 1)[1:]:
            self.arm.command_joints(q_from + share * (q_to - q_from))
            self.client.stepSimulation()
        self._healthy = bool(
            np.isfinite(self.cube_state().position).all() and np.isfinite(self.arm.joints()).all()
        )
        return self._healthy

    def put_cube_in_hand(self) -> None:
        """Start with the cube held at the home pose: close around it without gravity, then switch that on."""
        client, model = self.client, self.arm.model
        x, y, z = self.spec.home
        around_cube = model.pads + self.spec.cube_side / 2 + GRASP_GAP
        self.arm.place(self.home_q, (around_cube - model.closed) / (model.opened - model.closed))
        client.resetBasePositionAndOrientation(self.cube, (x, y, z - model.hand_drop), yaw_quaternion(0.0))
        client.setGravity(0, 0, 0)
        self.advance(self.home_q, self.home_q, 0.0)
        client.setGravity(0, 0, -9.81)
        self.advance(self.home_q, self.home_q, 0.0)

    def cube_state(self) -> CubeState:
        """Where the cube is now."""
        position, quaternion = self.client.getBasePositionAndOrientation(self.cube)
        velocity, _ = self.client.getBaseVelocity(self.cube)
        return CubeState(np.array(position), np.array(quaternion), float(np.linalg.norm(velocity)))

    def is_grasped(self) -> bool:
        """Whether both fingers touch the cube."""
        contacts = self.client.getContactPoints(bodyA=self.arm.body, bodyB=self.cube)
        return set(self.arm.model.fingers) <= {contact[3] for contact in contacts}

    def is_on_tile(self) -> bool:
        """Whether the cube touches a tile."""
        return any(self.client.getContactPoints(bodyA=self.cube, bodyB=tile) for tile in self.tiles.values())

    def frame(self) -> Frame:
        """Robot, cube and tiles as the camera sees them, without the table."""
        return self.camera.render(self.client, self.spec.light, self.spec.light_level)

    def picture(self, frame: Frame) -> Picture:
        """The finished picture (H, W, 3) of a frame."""
        return self.backdrop.under(frame)

    def tile_visibility(self, frame: Frame) -> dict[Side, float]:
        """Share of each picture that is on screen and that neither robot nor cube hides in `frame`."""
        return {side: float((frame.bodies == self.quads[side]).sum() / self._tile_pixels[side]) for side in SIDES}

    def _build(self) -> None:
        """Load the table, whose picture is kept; the tiles, whose pixels are counted; the cube and the arm."""
        client, spec, folder = self.client, self.spec, Path(self._folder.name)
        client.resetSimulation()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=1 / spec.physics.rate,
            numSolverIterations=spec.physics.solver_iterations,
            deterministicOverlappingPairs=1,
        )
        self.textures = TextureCache(client, folder)
        self.table = self._box(TABLE_SIZE, TABLE_CENTRE, TABLE_COLOR)
        self.floor = self._box(FLOOR_SIZE, FLOOR_CENTRE, FLOOR_COLOR)
        empty = self.frame()
        self.backdrop = Backdrop(self._surroundings(empty), empty.depth)
        for body in (self.table, self.floor):
            client.changeVisualShape(body, -1, rgbaColor=INVISIBLE)
        self._load_tiles()
        self.cube = self._box((spec.cube_side,) * 3, LIMBO, (*spec.cube_color, 1), spec.cube_mass)
        model = ARMS[spec.arm]
        self.arm = Arm(client, model, spec.physics, spec.arm_urdf or model.urdf(folder))
        self.home_q = self._find_home()
        self.arm.place(self.home_q, 1.0)
        self._saved = client.saveState()
        self._healthy = True

    def _find_home(self) -> Array:
        posture, limits = np.array(self.arm.model.posture), self.spec.limits
        solution = self.arm.chain.solve(self.arm.tool_down(self.spec.home), posture, posture)
        if solution.error > limits.ik_error or solution.turn_error > limits.ik_turn_error:
            raise SceneError(f"the {self.spec.arm} cannot reach its home {self.spec.home} with the gripper down.")
        return solution.q

    def _surroundings(self, empty: Frame) -> Picture:
        """Colours behind robot, cube and tiles; a photo gets darker and brighter with the light of the scene."""
        spec = self.spec
        if spec.rendering == "raw":
            return empty.rgb
        if spec.background is None:
            photo = wooden_table(self.camera)
        else:
            photo = load_photo(spec.background, spec.camera.width, spec.camera.height)
        return np.clip(photo * spec.light_level, 0, 255).astype(np.uint8)

    def _load_tiles(self) -> None:
        spec = self.spec
        mesh = Path(self._folder.name) / "tile.obj"
        write_quad(mesh, spec.tile_side)
        size = (spec.tile_side, spec.tile_side, spec.tile_height)
        turn = yaw_quaternion(spec.tile_yaw)
        self.tiles: dict[Side, int] = {}
        self.quads: dict[Side, int] = {}
        for side in SIDES:
            x, y = spec.tile_xy(side)
            self.tiles[side] = self._box(size, (x, y, spec.tile_height / 2), TILE_COLOR, turn=turn)
            shape = self.client.createVisualShape(
                self.client.GEOM_MESH, fileName=str(mesh), rgbaColor=(1, 1, 1, 1), specularColor=(0, 0, 0)
            )
            self.quads[side] = self.client.createMultiBody(
                0, -1, shape, (x, y, spec.tile_height + QUAD_LIFT), turn
            )
        bodies = self.camera.widened().render(self.client, spec.light, spec.light_level).bodies
        self._tile_pixels = {side: int((bodies == self.quads[side]).sum()) for side in SIDES}

    def _box(
        self,
        size: XYZ,
        centre: XYZ,
        color: tuple[float, float, float, float],
        mass: float = 0.0,
        turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
    ) -> int:
        client, half = self.client, [edge / 2 for edge in size]
        collision = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        visual = client.createVisualShape(
            client.GEOM_BOX, halfExtents=half, rgbaColor=color, specularColor=(0, 0, 0)
        )
        body: int = client.createMultiBody(mass, collision, visual, centre, turn)
        client.changeDynamics(body, -1, lateralFriction=self.spec.physics.friction)
        return body
