"""PyBullet's side of the scene: clients, the camera, pictures on tiles, photographed backgrounds, layers.

Pixels covered by the table cost most of the rendering time and never change. So the empty table is drawn once and
hidden from the renderer afterwards. The tiles are drawn once per episode, as long as they rest. Every frame is
composed with these layers by depth. The result is the naive rendering bit for bit; under visual matching, a photo
replaces the colours of the table and all around it.

PyBullet stretches a texture on a box so that only a corner of it shows, and it loads broken files without an
error. So a tile is a box with a quad of our own mesh on top, and every texture is a PNG that this module wrote.
"""

import hashlib
import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from importlib import import_module
from math import ceil
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.imports import install_command
from probe_kit._system.types import Matrix, PictureArray
from probe_kit.env.spec import CameraSpec, LightSpec
from probe_kit.errors import SceneError
from probe_kit.suite.pictures import decode_bytes

_GREETING = b"pybullet build time:"
_importing = Lock()  # the descriptor that is exchanged meanwhile is of the whole process


def import_pybullet() -> Any:
    """Return the module pybullet, without the line on stderr that says when it was compiled.

    Its C code writes that line to the file descriptor on every first import, past `sys.stderr`.
    """
    with _importing:
        if "pybullet" in sys.modules:
            return sys.modules["pybullet"]
        with _without_greeting():
            return import_module("pybullet")


@contextmanager
def _without_greeting() -> Iterator[None]:
    """Hold back all output to file descriptor 2, and pass it on without the greeting."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        stderr = os.dup(2)
    except OSError:  # the process has no stderr; nothing can be seen
        yield
        return
    with TemporaryFile() as buffer:
        os.dup2(buffer.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            buffer.seek(0)
            text = b"".join(line for line in buffer if not line.startswith(_GREETING))
            if text:
                os.write(2, text)


class BulletClient:
    """One PyBullet server without a window; every pybullet function is a method bound to it.

    pybullet is imported here, at the first use, and not by `import probe_kit.env`.
    """

    def __init__(self) -> None:
        pybullet = import_pybullet()
        if not pybullet.isNumpyEnabled():
            warnings.warn(
                "pybullet was compiled without numpy: a picture comes back as nested tuples and costs three times "
                "as much. Build it again beside numpy: "
                f"`{install_command(rebuild='pybullet')}`.",
                stacklevel=2,
            )
        self._pybullet = pybullet
        self._server = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._pybullet, name)
        return partial(member, physicsClientId=self._server) if callable(member) else member

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._server >= 0:
            self._pybullet.disconnect(physicsClientId=self._server)
            self._server = -1


@contextmanager
def without_file_cache(client: BulletClient) -> Iterator[None]:
    """Let PyBullet read files anew in the body, also those that it read before.

    It keeps meshes by name for the whole process, and this setting too: a server in which it stayed off would make
    every later scene of the process read all meshes of its arm again, which takes five times as long.
    """
    client.setPhysicsEngineParameter(enableFileCaching=0)
    try:
        yield
    finally:
        client.setPhysicsEngineParameter(enableFileCaching=1)


# -- camera ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderedFrame:
    """A rendering: colours (H, W, 3), depth buffer (H, W) in [0, 1] and body ids (H, W), -1 for none."""

    rgb: PictureArray
    depth: NDArray[np.float32]
    bodies: NDArray[np.int32]

    def at_size(self, spec: CameraSpec) -> "RenderedFrame":
        """Return the frame with the pixels of `spec`: mean colours, and depth and body of the nearest pixel."""
        size = (spec.width, spec.height)
        rgb = Image.fromarray(self.rgb).resize(size, Image.Resampling.BOX)
        depth, bodies = (
            Image.fromarray(part).resize(size, Image.Resampling.NEAREST) for part in (self.depth, self.bodies)
        )
        return RenderedFrame(np.asarray(rgb), np.asarray(depth), np.asarray(bodies))


@dataclass(frozen=True)
class LayeredFrame:
    """Some bodies that were drawn alone, and all that lies behind them. The nearer surface is visible.

    Attributes:
        front: The bodies.
        behind: All other bodies, and surroundings of body id −1.
    """

    front: RenderedFrame
    behind: RenderedFrame

    @cached_property
    def picture(self) -> PictureArray:
        """The finished picture (H, W, 3)."""
        return self._compose(self.behind.rgb, self.front.rgb)

    @cached_property
    def bodies(self) -> NDArray[np.int32]:
        """The body that is visible in every pixel (H, W), −1 for the surroundings."""
        return self._compose(self.behind.bodies, self.front.bodies)

    def flat(self) -> RenderedFrame:
        """Return both in one frame."""
        return RenderedFrame(self.picture, self._compose(self.behind.depth, self.front.depth), self.bodies)

    @cached_property
    def _in_front(self) -> NDArray[np.intp]:
        """Numbers of the pixels, row by row; a frame is composed with them in half the time that masks take."""
        # The renderer lets the surface that is drawn later win a tie, and what is behind is drawn first.
        return np.flatnonzero((self.front.bodies >= 0) & (self.front.depth <= self.behind.depth))

    def _compose[Pixel: np.generic](self, behind: NDArray[Pixel], front: NDArray[Pixel]) -> NDArray[Pixel]:
        composed = behind.copy()
        row_by_row = (-1, *front.shape[2:])
        composed.reshape(row_by_row)[self._in_front] = front.reshape(row_by_row)[self._in_front]
        return composed


@dataclass(frozen=True)
class Camera:
    """A camera of the given description. Pixel (0, 0) is the upper left corner of the picture."""

    spec: CameraSpec

    @property
    def axes(self) -> Matrix:
        """The rows right, up, forward (3, 3): unit axes of the camera in the world."""
        forward = np.asarray(self.spec.forward) / np.linalg.norm(self.spec.forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, forward), forward])

    def project(self, points: ArrayLike) -> Matrix:
        """Return pixel places (..., 2) as x, y of world points (..., 3) in front of the camera."""
        x, y, z = np.moveaxis((np.asarray(points) - self.spec.eye) @ self.axes.T, -1, 0)
        centre = np.array([self.spec.width, self.spec.height]) / 2
        return np.asarray(centre + self.spec.focal_length * np.stack([x, -y], -1) / z[..., None])

    def rays(self) -> Matrix:
        """Return the viewing direction (H, W, 3) in the world through the middle of every pixel, unnormalised."""
        v, u = np.mgrid[: self.spec.height, : self.spec.width] + 0.5
        across = (u - self.spec.width / 2) / self.spec.focal_length
        down = (v - self.spec.height / 2) / self.spec.focal_length
        return np.asarray(np.stack([across, -down, np.ones_like(across)], -1) @ self.axes)

    def can_see(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether some of the space between world points (..., P, 3) can be in view, (...).

        Args:
            points: Corners of convex bodies.
            margin: Share of width and height by which the view is taken larger.
        """
        x, y, z = np.moveaxis((np.asarray(points) - self.spec.eye) @ self.axes.T, -1, 0)
        depth = (1 + margin) * z / (2 * self.spec.focal_length)
        across, up = self.spec.width * depth, self.spec.height * depth
        beyond = np.stack([x - across, -x - across, y - up, -y - up, -z])
        return np.asarray(~(beyond > 0).all(axis=-1).any(axis=0))

    def magnified(self, factor: int) -> "Camera":
        """Return the same view with `factor` times the pixels in each direction."""
        spec = self.spec
        return Camera(replace(spec, width=factor * spec.width, height=factor * spec.height))

    def at_height(self, height: int) -> "Camera":
        """Return the same view with so many rows of pixels."""
        spec = self.spec
        return Camera(replace(spec, width=round(spec.width * height / spec.height), height=height))

    def widened(self) -> "Camera":
        """Return the same view at the same scale, twice as wide and high: with what lies just outside of it."""
        spec = self.spec
        fov = 2 * float(np.degrees(np.arctan(2 * np.tan(np.radians(spec.fov) / 2))))
        return Camera(replace(spec, width=2 * spec.width, height=2 * spec.height, fov=fov))

    def view_matrix(self) -> list[float]:
        """Return the matrix from world to camera, column-major as in OpenGL."""
        right, up, forward = self.axes
        matrix = np.eye(4)
        matrix[:3, :3] = right, up, -forward
        matrix[:3, 3] = -matrix[:3, :3] @ self.spec.eye
        return [float(x) for x in matrix.T.ravel()]

    def projection_matrix(self) -> list[float]:
        """Return the matrix from camera to clip space, column-major as in OpenGL."""
        spec = self.spec
        f = 1 / np.tan(np.radians(spec.fov) / 2)
        depth = spec.far - spec.near
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1] = f * spec.height / spec.width, f
        matrix[2, 2:] = -(spec.far + spec.near) / depth, -2 * spec.far * spec.near / depth
        matrix[3, 2] = -1
        return [float(x) for x in matrix.T.ravel()]

    def render(self, client: BulletClient, light: LightSpec, level: float) -> RenderedFrame:
        """Draw everything visible in the server behind `client`, with all light scaled by `level`."""
        width, height = self.spec.width, self.spec.height
        _, _, rgba, depth, bodies = client.getCameraImage(
            width,
            height,
            self.view_matrix(),
            self.projection_matrix(),
            lightDirection=light.direction,
            lightColor=(1.0, 1.0, 1.0),
            shadow=0,
            lightAmbientCoeff=light.ambient * level,
            lightDiffuseCoeff=light.diffuse * level,
            lightSpecularCoeff=light.specular * level,
            renderer=client.ER_TINY_RENDERER,
        )
        # np.asarray with reshape is right for both builds of pybullet, with numpy and without.
        return RenderedFrame(
            np.asarray(rgba, np.uint8).reshape(height, width, 4)[..., :3],
            np.asarray(depth, np.float32).reshape(height, width),
            np.asarray(bodies, np.int32).reshape(height, width),
        )


# -- pictures on tiles ----------------------------------------------------------------------------------------

TEXTURE_PIXELS = 256
"""Side of a texture in pixels; a tile covers about 170 pixels of the rendered picture."""
TEXTURE_BUDGET = 128
"""Most textures per loaded scene, 0.6 MB each; PyBullet frees none of them before the scene is reloaded."""


def write_quad(path: Path, side: float) -> None:
    """Write a square of `side` metres in the plane z = 0 as OBJ; the top of its picture points to +x."""
    h = side / 2
    corners = "".join(f"v {x} {y} 0\n" for x, y in ((-h, h), (-h, -h), (h, -h), (h, h)))
    picture = "".join(f"vt {u} {v}\n" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
    path.write_text(f"{corners}{picture}vn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n", encoding="utf-8")


def as_texture(picture: Image.Image) -> NDArray[np.uint8]:
    """Return the pixels (256, 256, 3) of a square picture of any size."""
    return np.asarray(picture.convert("RGB").resize((TEXTURE_PIXELS, TEXTURE_PIXELS), Image.Resampling.LANCZOS))


class TextureCache:
    """Textures of one loaded scene by the hash of their pixels, so that each picture is loaded once."""

    def __init__(self, client: BulletClient, folder: Path, budget: int = TEXTURE_BUDGET) -> None:
        self._client = client
        self._folder = folder
        self._budget = budget
        self._ids: dict[str, int] = {}

    def has_room(self, count: int) -> bool:
        """Whether `count` more textures fit into the budget; if not, reload the scene."""
        return len(self._ids) + count <= self._budget

    def load(self, picture: Image.Image) -> int:
        """Return the texture id of a picture."""
        pixels = as_texture(picture)
        key = hashlib.sha256(pixels.tobytes()).hexdigest()
        if key not in self._ids:
            path = self._folder / f"{key}.png"
            Image.fromarray(pixels).save(path, compress_level=0)  # it is read once and deleted
            self._ids[key] = self._client.loadTexture(str(path))
            path.unlink()
        return self._ids[key]


# -- backgrounds ----------------------------------------------------------------------------------------------

# All colours and numbers of grain are chosen by eye. Pictures, and all that models make of them, depend on each.
PLANK_WIDTH = 0.14
"""Width of a plank, in metres."""
TABLE_END = 0.92
"""Position along x, in metres, at which the table meets a wall."""
DARK_WOOD = np.array([118.0, 78.0, 46.0])
LIGHT_WOOD = np.array([190.0, 146.0, 98.0])
WALL = np.array([196.0, 198.0, 194.0])
SUPERSAMPLING = 2
"""Factor of the pixels in each direction that are drawn and then scaled down, so that seams are smooth."""
ROWS_AT_ONCE = 16
"""Rows of the table that are computed together."""


def load_photo(path: Path, width: int, height: int) -> PictureArray:
    """Read the photo at `path`, squeezed to (height, width, 3).

    Raises:
        SceneError: If it cannot be read.
    """
    remedy = "Give another file, or leave `background` out for our own wooden table."
    try:
        encoded = read_regular(path)
    except OSError as error:
        raise SceneError(f"background {path}: cannot be read ({error.strerror}). {remedy}") from error
    picture = decode_bytes(encoded, f"background {path}:", SceneError, remedy)
    return np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS))


@lru_cache(maxsize=8)
def wooden_table(camera: Camera) -> PictureArray:
    """Draw a table of planks with a wall behind it, (H, W, 3), seen by `camera` in the right perspective."""
    fine = camera.magnified(SUPERSAMPLING)
    # A block of rows fits into a processor's cache.
    blocks = np.array_split(fine.rays(), ceil(fine.spec.height / ROWS_AT_ONCE))
    color = np.concatenate([_ray_colors(np.array(fine.spec.eye), rays) for rays in blocks])
    picture = Image.fromarray(color).resize((camera.spec.width, camera.spec.height), Image.Resampling.LANCZOS)
    return np.asarray(picture)


def _ray_colors(eye: Matrix, rays: Matrix) -> PictureArray:
    """Return the colours (H, W, 3) that rays (H, W, 3) from a place (3,) meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_table = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        to_wall = np.where(rays[..., 0] > 0, (TABLE_END - eye[0]) / rays[..., 0], np.inf)
    nearest = np.minimum(np.minimum(to_table, to_wall), 10.0)  # a ray may meet neither, and is wall
    points = eye + nearest[..., None] * rays
    is_table = to_table < to_wall
    color = np.empty_like(points)
    color[is_table], color[~is_table] = _wood(points[is_table]), _wall(points[~is_table])
    return np.asarray(np.clip(color, 0, 255), np.uint8)


def _wood(points: Matrix) -> Matrix:
    """Return the table's colour at world points (..., 3): planks along y, each with its own grain and tone."""
    x, y = points[..., 0], points[..., 1]
    plank = np.floor(x / PLANK_WIDTH)
    shift = 7.3 * plank
    rings = np.sin(2 * np.pi * (9 * x + 1.6 * _noise(3 * x + shift, 1.5 * y, 1) + shift))
    fibre = _noise(260 * x, 9 * y + shift, 2)
    planks = np.arange(plank.min(initial=0.0), plank.max(initial=0.0) + 1)
    tone = _noise(5.7 * planks, 0 * planks, 3).take((plank - planks[0]).astype(np.int32))
    lightness = 0.45 + 0.16 * rings + 0.30 * (fibre - 0.5) + 0.35 * (tone - 0.5)
    seam = np.abs(x / PLANK_WIDTH - plank - 0.5) > 0.49
    shade = (1.06 - 0.35 * np.hypot(x - 0.3, y - 0.1)) * np.where(seam, 0.62, 1.0)
    return np.asarray((DARK_WOOD + lightness[..., None] * (LIGHT_WOOD - DARK_WOOD)) * shade[..., None])


def _wall(points: Matrix) -> Matrix:
    y, z = points[..., 1], points[..., 2]
    shade = 0.90 + 0.08 * np.tanh(4 * z) + 0.03 * (_noise(3 * y, 3 * z, 4) - 0.5)
    return np.asarray(WALL * shade[..., None])


def _noise(u: Matrix, v: Matrix, seed: int) -> Matrix:
    """Return smooth noise in [0, 1] on the plane: random values on a grid that repeats every 64 cells."""
    grid: NDArray[np.float64] = np.random.default_rng(seed).random((64, 64)).ravel()
    cell_u, cell_v = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
    s, t = _ease(u - cell_u), _ease(v - cell_v)
    row, next_row = cell_u % 64 * 64, (cell_u + 1) % 64 * 64
    column, next_column = cell_v % 64, (cell_v + 1) % 64
    near = (1 - s) * grid.take(row + column) + s * grid.take(next_row + column)
    far = (1 - s) * grid.take(row + next_column) + s * grid.take(next_row + next_column)
    return np.asarray((1 - t) * near + t * far)


def _ease(share: Matrix) -> Matrix:
    return np.asarray(share * share * (3 - 2 * share))


# -- what is drawn ----------------------------------------------------------------------------------------------

INVISIBLE = (0.0, 0.0, 0.0, 0.0)
"""Colour of bodies that the renderer leaves out."""


class VisualShapes:
    """The visual shapes of one body, of which links can be hidden from the renderer.

    The colours of the shapes are those that they have when this is made.

    Attributes:
        body: Id of the body.
        hidden: Links that are hidden; −1 is the base.
    """

    def __init__(self, client: BulletClient, body: int) -> None:
        self._client, self.body = client, body
        # `changeVisualShape` asks for the number of a shape in its link.
        self._colors: dict[int, list[tuple[float, ...]]] = {}
        for shape in client.getVisualShapeData(body):
            self._colors.setdefault(shape[1], []).append(shape[7])
        self.hidden: frozenset[int] = frozenset()

    @property
    def visible(self) -> frozenset[int]:
        """Links with a shape that are not hidden."""
        return frozenset(self._colors) - self.hidden

    def hide(self, links: Iterable[int]) -> None:
        """Hide these links, and show all others."""
        hidden = frozenset(links)
        for link in hidden ^ self.hidden:
            for number, color in enumerate(self._colors[link]):
                look = INVISIBLE if link in hidden else color
                self._client.changeVisualShape(self.body, link, number, rgbaColor=look)
        self.hidden = hidden

    @contextmanager
    def away(self, links: Iterable[int] | None = None) -> Iterator[None]:
        """Hide these links too, None for all; afterwards those are hidden that were before."""
        before = self.hidden
        self.hide(before | (self.visible if links is None else frozenset(links)))
        try:
            yield
        finally:
            self.hide(before)


# -- layers ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Resting:
    """The bodies that rest, as they were when they were last looked at.

    Attributes:
        places: (bodies, 7) their positions and quaternions.
        textures: Textures that they show.
        layer: The scene without its moving bodies; None if it was not drawn yet.
    """

    places: Matrix
    textures: tuple[int, ...]
    layer: RenderedFrame | None


class LayerCamera:
    """A camera that draws the bodies that rest once, and again only when they moved or changed.

    Args:
        client: Server of the scene.
        camera: The camera.
        light: The lamp.
        level: Factor of all light.
        surroundings: The scene without robot, cube and tiles, at the camera's size.
        resting: Bodies that mostly rest.
        moving: Bodies that move, which are drawn later.
        drift: Largest change of place, in metres or parts of a unit quaternion, at which bodies still rest.
    """

    def __init__(
        self,
        client: BulletClient,
        camera: Camera,
        light: LightSpec,
        level: float,
        surroundings: RenderedFrame,
        resting: Iterable[VisualShapes],
        moving: Iterable[VisualShapes],
        drift: float = 0.0,
    ) -> None:
        self.camera = camera
        self._draw = partial(camera.render, client, light, level)
        self._client, self._surroundings, self._drift = client, surroundings, drift
        self._resting, self._moving = tuple(resting), tuple(moving)
        self._latest: _Resting | None = None

    def frame(self, textures: tuple[int, ...]) -> LayeredFrame:
        """Return the scene now, in which the resting bodies show these textures."""
        states = (self._client.getBasePositionAndOrientation(shapes.body) for shapes in self._resting)
        places, latest = np.array([np.concatenate(state) for state in states]), self._latest
        if latest is None or latest.textures != textures or np.abs(latest.places - places).max() > self._drift:
            # Of one picture alone a layer does not pay.
            self._latest = _Resting(places, textures, None)
            return LayeredFrame(self._draw(), self._surroundings)
        layer = latest.layer
        if layer is None:
            with without_bodies(self._moving):
                layer = LayeredFrame(self._draw(), self._surroundings).flat()
            self._latest = replace(latest, layer=layer)
        with without_bodies(self._resting):
            return LayeredFrame(self._draw(), layer)


@contextmanager
def without_bodies(bodies: Iterable[VisualShapes]) -> Iterator[None]:
    """Hide bodies from the renderer in the body of the statement."""
    with ExitStack() as stack:
        for shapes in bodies:
            stack.enter_context(shapes.away())
        yield
