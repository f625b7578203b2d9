"""The table-top scene in the physics server: table, tiles, cube and arm, built once and restored per episode."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.types import Matrix, PictureArray
from probe_kit.env.arm import ARMS, Arm
from probe_kit.env.culling import ViewCulling
from probe_kit.env.rotations import Pose, to_vector, yaw_quaternion
from probe_kit.env.simulation import (
    INVISIBLE,
    BulletClient,
    Camera,
    LayerCamera,
    LayeredFrame,
    RenderedFrame,
    TextureCache,
    VisualShapes,
    load_photo,
    without_bodies,
    without_file_cache,
    wooden_table,
    write_quad,
)
from probe_kit.env.spec import XY, XYZ, CameraSpec, LightSpec, SceneSpec
from probe_kit.errors import SceneError
from probe_kit.suite.items import Side, other_side

SIDES: tuple[Side, Side] = ("left", "right")
TABLE_SIZE = (1.30, 1.40, 0.04)
TABLE_CENTRE = (0.25, 0.0, -0.02)
TABLE_COLOR = (0.69, 0.49, 0.32, 1.0)
FLOOR_SIZE = (8.0, 8.0, 0.02)
FLOOR_CENTRE = (0.0, 0.0, -0.75)
FLOOR_COLOR = (0.62, 0.64, 0.66, 1.0)
TILE_COLOR = (0.85, 0.85, 0.83, 1.0)
"""Sizes and centres (x, y, z) are in metres in the frame of the robot's base; colours are RGBA."""
LIMBO = (0.0, 0.0, 5.0)
"""Position of the cube in the saved state, so far up that it touches nothing."""
TILE_LIMBO: Mapping[Side, XYZ] = MappingProxyType({"left": (0.0, 1.0, 5.0), "right": (0.0, -1.0, 5.0)})
"""Positions of tiles that can be pushed in the saved state."""
GRAVITY = (0.0, 0.0, -9.81)
HOME_POSITION_ERROR, HOME_ROTATION_ERROR = 0.001, 0.01
"""Largest distance of the tool from `home` at `home_joints`, in metres and radians."""
GRASP_GAP = 0.003
"""Space between each finger and a cube that starts in the hand, before the fingers close, in metres."""
QUAD_LIFT = 0.0005
"""Height of the picture above its box, in metres; enough for the depth buffer to separate them."""
_EMPTY_TABLES: dict[tuple[CameraSpec, LightSpec, float], RenderedFrame] = {}
"""Frames of the empty tables of this process's scenes; an equal scene need not draw it again."""
_TILE_PIXELS: dict[tuple[CameraSpec, float, float, float, tuple[XY, ...]], dict[Side, int]] = {}
"""Pixels of the tiles' pictures in these scenes."""
_MOST_CACHED = 8
"""Most entries of each of the two caches."""
SMALL_DRIFT = 2e-4
"""Drift at which tiles still rest in small pictures: metres, or parts of a unit quaternion; under 0.1 pixels."""


@dataclass(frozen=True)
class BodyState:
    """The state of the cube or a tile.

    Attributes:
        position: (3,) middle of the body, in metres.
        quaternion: (4,) x, y, z, w.
        speed: Linear speed in m/s.
    """

    position: Matrix
    quaternion: Matrix
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
        self._closed: tuple[tuple[int, float, bytes, bytes], int] | None = None
        self._home: tuple[float, ...] = ()
        self._saved: int
        self._frames = 0
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
        """Return everything to its start, with these pictures on the tiles."""
        if not (self._healthy and self.textures.has_room(len(pictures))):
            self._reload()
        self.client.restoreState(self._saved)
        # The saved cube floats far above the table: one step lets contacts of the last episode expire.
        self.client.stepSimulation()
        self.show(pictures)
        self._frames = 0
        if self.spec.tile_mass > 0:
            for side in SIDES:
                self._put(self.tiles[side], self._tile_start(side), self.spec.tile_yaw)
        self._put(self.cube, cube_position, cube_yaw)
        self.arm.set_joints(self.home_q, self.spec.home_opening)
        self._home = self.arm.posture()
        self.arm.command_gripper(self.spec.home_opening)

    def show(self, pictures: Mapping[Side, Image.Image]) -> None:
        """Put these pictures on the tiles; nothing moves."""
        self._show({side: self.textures.load(pictures[side]) for side in SIDES})

    @contextmanager
    def exchanged(self) -> Iterator[None]:
        """Exchange the two pictures; nothing else differs, because pictures have no weight."""
        before = self._shown
        self._show({side: before[other_side(side)] for side in SIDES})
        try:
            yield
        finally:
            self._show(before)

    def advance(self, q_from: Matrix, q_to: Matrix, opening: float) -> bool:
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
        """Start with the cube held at the home pose: close around it without gravity, then switch gravity on."""
        client, model = self.client, self.arm.model
        x, y, z = self.spec.home
        around_cube = model.pads + self.spec.cube_side / 2 + GRASP_GAP
        self.arm.set_joints(self.home_q, (around_cube - model.closed) / (model.opened - model.closed))
        client.resetBasePositionAndOrientation(self.cube, (x, y, z - model.hand_drop), yaw_quaternion(0.0))
        self.close_hand(2)

    def close_hand(self, actions: int) -> None:
        """Close the hand at the home pose for so many actions, without gravity during the first.

        With gravity, a cube that waits in the air falls 12 mm before the fingers reach it. The call must follow
        `reset`, with nothing moved since. Closing around a cube in the same place is simulated once. Afterwards
        the resulting state is restored, and is the same bit for bit.
        """
        cube = self.cube_state()
        start = (actions, self.arm.opening(), cube.position.tobytes(), cube.quaternion.tobytes())
        if self._closed is not None and self._closed[0] == start:
            self.client.restoreState(self._closed[1])
            self._home = self.arm.posture()  # from now on every episode that starts so shares its drawing
            self.arm.command_gripper(0.0)
            self.arm.command_joints(self.home_q)
            return
        self.client.setGravity(0, 0, 0)
        for _ in range(actions):
            self.advance(self.home_q, self.home_q, 0.0)
            self.client.setGravity(*GRAVITY)
        if self._closed is not None:
            self.client.removeState(self._closed[1])
        self._closed = (start, self.client.saveState())

    def cube_state(self) -> BodyState:
        """Return the present state of the cube."""
        return self._state(self.cube)

    def tile_state(self, side: Side) -> BodyState:
        """Return the present state of the tile that started on `side`."""
        return self._state(self.tiles[side])

    def tile_xy(self, side: Side) -> XY:
        """Return the present middle of that tile in the plane."""
        if self.spec.tile_mass == 0:
            return self.spec.tile_xy(side)
        x, y, _ = self.tile_state(side).position
        return (float(x), float(y))

    def finger_contacts(self) -> tuple[bool, bool]:
        """Return whether the left and whether the right finger touches the cube."""
        contacts = self.client.getContactPoints(bodyA=self.arm.body, bodyB=self.cube)
        touching = {contact[3] for contact in contacts}
        left, right = self.arm.model.fingers
        return left in touching, right in touching

    def is_grasped(self) -> bool:
        """Whether both fingers touch the cube."""
        return all(self.finger_contacts())

    def touches_tile(self, side: Side) -> bool:
        """Whether the cube touches the tile that started on `side`."""
        return bool(self.client.getContactPoints(bodyA=self.cube, bodyB=self.tiles[side]))

    def is_on_tile(self) -> bool:
        """Whether the cube touches a tile."""
        return any(self.touches_tile(side) for side in SIDES)

    def frame(self, number: int | None = None) -> LayeredFrame:
        """Draw what the camera sees.

        Frame n of an episode always has the same parity of drawings before it, whatever former episodes and small
        pictures drew: see `ViewCulling`. An arm at its home looks the same in every episode, and is drawn once.

        Args:
            number: The number that the frame has in an episode that is played again; None for the next one.
        """
        if self.spec.tile_mass > 0:
            self._lay_pictures()
        number = self._frames if number is None else number
        self._frames = number + 1
        posture = self.arm.posture()
        if posture != self._home:
            self._prepare_arm(number)
            return self._layers.frame(self._textures)
        arm = _drawn_once(self._arms_at_home, (posture, number % 2), partial(self._draw_arm, number))
        with self._arm.away():
            return LayeredFrame(arm, self._layers.frame(self._textures).flat())

    def _draw_arm(self, number: int) -> RenderedFrame:
        """Draw the arm alone, as in frame `number` of an episode."""
        self._prepare_arm(number)
        with without_bodies([self._cube, *self._resting]):
            return self._draw(self.camera)

    def _draw(self, camera: Camera) -> RenderedFrame:
        return camera.render(self.client, self.spec.light, self.spec.light_level)

    def _prepare_arm(self, number: int) -> None:
        """Hide what the camera does not see of the arm, and let its next drawing be that of frame `number`."""
        self._culling.hide_unseen(self.camera)
        self._culling.align(number, partial(self._draw, self.camera.at_height(1)))
        self._culling.count_drawing()

    def small_picture(self, height: int) -> PictureArray:
        """Return the finished picture (height, w, 3), drawn with fewer pixels, so that edges are less smooth."""
        if self.spec.tile_mass > 0:
            self._lay_pictures()
        if height not in self._small_layers:
            self._small_layers[height] = self._layer_camera(self.camera.at_height(height), SMALL_DRIFT)
        layers = self._small_layers[height]
        self._culling.hide_unseen(layers.camera)
        self._culling.count_drawing()
        return layers.frame(self._textures).picture

    @property
    def _textures(self) -> tuple[int, ...]:
        return tuple(self._shown.values())

    def tile_visibility(self, frame: LayeredFrame) -> dict[Side, float]:
        """Return the share of each picture that is on screen and that neither robot nor cube hides in `frame`."""
        return {side: float((frame.bodies == self.quads[side]).sum() / self._tile_pixels[side]) for side in SIDES}

    def tile_masks(self, frame: LayeredFrame) -> dict[Side, NDArray[np.bool_]]:
        """Return masks (H, W) of where each tile's picture is seen in the frame."""
        return {side: np.asarray(frame.bodies == self.quads[side]) for side in SIDES}

    def _build(self) -> None:
        """Load the table, whose picture is kept; the tiles, whose pixels are counted; the cube and the arm."""
        client, spec, folder = self.client, self.spec, Path(self._folder.name)
        client.resetSimulation()
        client.setGravity(*GRAVITY)
        client.setPhysicsEngineParameter(
            fixedTimeStep=1 / spec.physics.rate,
            numSolverIterations=spec.physics.solver_iterations,
            deterministicOverlappingPairs=1,
        )
        self.textures = TextureCache(client, folder)
        self.table = self._box(TABLE_SIZE, TABLE_CENTRE, TABLE_COLOR)
        self.floor = self._box(FLOOR_SIZE, FLOOR_CENTRE, FLOOR_COLOR)
        look = spec.camera, spec.light, spec.light_level
        self.surroundings = self._around(_drawn_once(_EMPTY_TABLES, look, partial(self._draw, self.camera)))
        for body in (self.table, self.floor):
            client.changeVisualShape(body, -1, rgbaColor=INVISIBLE)
        self._load_tiles()
        self.cube = self._box((spec.cube_side,) * 3, LIMBO, (*spec.cube_color, 1), spec.cube_mass)
        model = ARMS[spec.arm]
        # An edited mesh of a user's arm would be drawn as it was before.
        with nullcontext() if spec.arm_urdf is None else without_file_cache(client):
            self.arm = Arm(client, model, spec.physics, spec.arm_urdf or model.urdf(folder))
        self._resting = [VisualShapes(client, body) for body in (*self.tiles.values(), *self.quads.values())]
        self._cube, self._arm = (VisualShapes(client, body) for body in (self.cube, self.arm.body))
        self._layers = self._layer_camera(self.camera)
        self._small_layers: dict[int, LayerCamera] = {}
        self._culling = ViewCulling(client, self._arm)
        self._arms_at_home: dict[tuple[tuple[float, ...], int], RenderedFrame] = {}
        self._frames = 0
        self.home_q = self._find_home()
        self.arm.set_joints(self.home_q, spec.home_opening)
        if spec.tile_mass > 0:
            # Contacts of tiles survive restoreState: without this an episode depends on the one before.
            for side in SIDES:
                self._put(self.tiles[side], TILE_LIMBO[side], spec.tile_yaw)
        self._saved = client.saveState()
        self._closed = None
        self._healthy = True

    def _reload(self) -> None:
        """Load everything into a new server.

        restoreState does not repair a state that was once not finite, and resetSimulation keeps a copy of every
        texture (0.2 MB). Only the end of a server frees all of its memory.
        """
        self.client.close()
        self.client = BulletClient()
        self._build()

    def _find_home(self) -> Matrix:
        spec, posture, limits = self.spec, np.array(self.arm.model.posture), self.spec.limits
        home = self.arm.tool_down(spec.home, spec.home_rpy)
        if spec.home_joints is not None:
            return self._checked_home(np.array(spec.home_joints), home)
        solution = self.arm.chain.solve(home, posture, posture)
        if solution.error > limits.ik_error or solution.turn_error > limits.ik_turn_error:
            raise SceneError(f"the {spec.arm} cannot reach its home {spec.home} with the gripper down.")
        return solution.q

    def _checked_home(self, q: Matrix, home: Pose) -> Matrix:
        spec, count = self.spec, len(self.arm.model.joints)
        if q.shape != (count,):
            raise SceneError(
                f"home_joints has {q.size} angles; the {spec.arm} has {count} joints. Give one for each."
            )
        pose = self.arm.chain.pose(q)
        apart = float(np.linalg.norm(pose.position - home.position))
        turned = float(np.linalg.norm(to_vector(pose.rotation @ home.rotation.T)))
        if apart > HOME_POSITION_ERROR or turned > HOME_ROTATION_ERROR:
            raise SceneError(
                f"home_joints bring the tool of the {spec.arm} to {pose.position.round(4).tolist()}, "
                f"{1000 * apart:.1f} mm and {turned:.3f} rad from home {spec.home} with home_rpy {spec.home_rpy}. "
                "Change one of them."
            )
        return q

    def _layer_camera(self, camera: Camera, drift: float = 0.0) -> LayerCamera:
        spec, surroundings = self.spec, self.surroundings
        if camera is not self.camera:
            surroundings = surroundings.at_size(camera.spec)
        moving = self._cube, self._arm
        return LayerCamera(
            self.client, camera, spec.light, spec.light_level, surroundings, self._resting, moving, drift
        )

    def _around(self, empty: RenderedFrame) -> RenderedFrame:
        """Return what is behind robot, cube and tiles; a photo is scaled with the light of the scene."""
        spec, rgb = self.spec, empty.rgb
        if spec.rendering != "raw":
            if spec.background is None:
                photo = wooden_table(self.camera)
            else:
                photo = load_photo(spec.background, spec.camera.width, spec.camera.height)
            rgb = np.clip(photo * spec.light_level, 0, 255).astype(np.uint8)
        # Contiguous, so that a copy for every frame takes a tenth of the time.
        return RenderedFrame(np.ascontiguousarray(rgb), empty.depth, np.full_like(empty.bodies, -1))

    def _load_tiles(self) -> None:
        spec = self.spec
        mesh = Path(self._folder.name) / "tile.obj"
        write_quad(mesh, spec.tile_side)
        size = (spec.tile_side, spec.tile_side, spec.tile_height)
        turn = yaw_quaternion(spec.tile_yaw)
        self.tiles: dict[Side, int] = {}
        self.quads: dict[Side, int] = {}
        for side in SIDES:
            x, y, z = self._tile_start(side)
            self.tiles[side] = self._box(size, (x, y, z), TILE_COLOR, spec.tile_mass, turn)
            shape = self.client.createVisualShape(
                self.client.GEOM_MESH, fileName=str(mesh), rgbaColor=(1, 1, 1, 1), specularColor=(0, 0, 0)
            )
            self.quads[side] = self.client.createMultiBody(
                0, -1, shape, (x, y, spec.tile_height + QUAD_LIFT), turn
            )
        places = tuple(spec.tile_xy(side) for side in SIDES)
        lie = (spec.camera, spec.tile_side, spec.tile_height, spec.tile_yaw, places)
        self._tile_pixels = _drawn_once(_TILE_PIXELS, lie, self._count_tile_pixels)

    def _count_tile_pixels(self) -> dict[Side, int]:
        """Count the pixels of each picture with nothing in front of it, on screen or just outside."""
        bodies = self._draw(self.camera.widened()).bodies
        return {side: int((bodies == self.quads[side]).sum()) for side in SIDES}

    def _tile_start(self, side: Side) -> XYZ:
        return (*self.spec.tile_xy(side), self.spec.tile_height / 2)

    def _show(self, textures: Mapping[Side, int]) -> None:
        self._shown = textures
        for side, texture in textures.items():
            self.client.changeVisualShape(self.quads[side], -1, textureUniqueId=texture)

    def _lay_pictures(self) -> None:
        """Move the pictures with tiles that were pushed; they touch nothing, so that this changes no motion."""
        lift = self.spec.tile_height / 2 + QUAD_LIFT
        for side in SIDES:
            state = self.tile_state(side)
            up = np.array(self.client.getMatrixFromQuaternion(state.quaternion)).reshape(3, 3)[:, 2]
            position = (state.position + lift * up).tolist()
            self.client.resetBasePositionAndOrientation(self.quads[side], position, state.quaternion.tolist())

    def _put(self, body: int, position: XYZ, yaw: float) -> None:
        self.client.resetBasePositionAndOrientation(body, position, yaw_quaternion(yaw))
        self.client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))

    def _state(self, body: int) -> BodyState:
        position, quaternion = self.client.getBasePositionAndOrientation(body)
        velocity, _ = self.client.getBaseVelocity(body)
        return BodyState(np.array(position), np.array(quaternion), float(np.linalg.norm(velocity)))

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


def _drawn_once[Key, Seen](drawings: dict[Key, Seen], key: Key, draw: Callable[[], Seen]) -> Seen:
    """Return the rendering for `key`, drawn on first use; renderings are the same bit for bit."""
    if key not in drawings:
        if len(drawings) == _MOST_CACHED:
            drawings.clear()
        drawings[key] = draw()
    return drawings[key]
