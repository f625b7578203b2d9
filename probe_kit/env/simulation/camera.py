"""The camera: matrices, projection, TinyRenderer frames, and the cached image of the empty table.

Pixels covered by the table cost most of the rendering time and never change. So the empty table is drawn once
(the *backdrop*), hidden from the renderer afterwards, and every frame is composed with it by depth. The result is
the naive rendering bit for bit; under visual matching a photo takes the place of the backdrop's colours.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from probe_kit.env.rotations import Array
from probe_kit.env.simulation.bullet import BulletClient
from probe_kit.env.spec import CameraSpec, LightSpec

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """A rendering: colours (H, W, 3), depth buffer (H, W) in [0, 1] and body ids (H, W), -1 for none."""

    rgb: Picture
    depth: NDArray[np.float32]
    bodies: NDArray[np.int32]


@dataclass(frozen=True)
class Camera:
    """A camera of the given description. Pixel (0, 0) is the upper left corner of the picture."""

    spec: CameraSpec

    @property
    def axes(self) -> Array:
        """Rows right, up, forward (3, 3): unit axes of the camera in the world."""
        forward = np.asarray(self.spec.forward) / np.linalg.norm(self.spec.forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, forward), forward])

    def project(self, points: ArrayLike) -> Array:
        """Pixel places (..., 2) as x, y of world points (..., 3) in front of the camera."""
        x, y, z = np.moveaxis((np.asarray(points) - self.spec.eye) @ self.axes.T, -1, 0)
        centre = np.array([self.spec.width, self.spec.height]) / 2
        return np.asarray(centre + self.spec.focal_length * np.stack([x, -y], -1) / z[..., None])

    def rays(self) -> Array:
        """Viewing direction (H, W, 3) in the world through the middle of every pixel, not normalised."""
        v, u = np.mgrid[: self.spec.height, : self.spec.width] + 0.5
        across = (u - self.spec.width / 2) / self.spec.focal_length
        down = (v - self.spec.height / 2) / self.spec.focal_length
        return np.asarray(np.stack([across, -down, np.ones_like(across)], -1) @ self.axes)

    def magnified(self, factor: int) -> "Camera":
        """The same view with `factor` times the pixels in each direction."""
        spec = self.spec
        return Camera(replace(spec, width=factor * spec.width, height=factor * spec.height))

    def at_height(self, height: int) -> "Camera":
        """The same view with so many rows of pixels."""
        spec = self.spec
        return Camera(replace(spec, width=round(spec.width * height / spec.height), height=height))

    def widened(self) -> "Camera":
        """The same view at the same scale, twice as wide and high: with what lies just outside of it."""
        spec = self.spec
        fov = 2 * float(np.degrees(np.arctan(2 * np.tan(np.radians(spec.fov) / 2))))
        return Camera(replace(spec, width=2 * spec.width, height=2 * spec.height, fov=fov))

    def view_matrix(self) -> list[float]:
        """World to camera, column-major as OpenGL wants it."""
        right, up, forward = self.axes
        matrix = np.eye(4)
        matrix[:3, :3] = right, up, -forward
        matrix[:3, 3] = -matrix[:3, :3] @ self.spec.eye
        return [float(x) for x in matrix.T.ravel()]

    def projection_matrix(self) -> list[float]:
        """Camera to clip space, column-major as OpenGL wants it."""
        spec = self.spec
        f = 1 / np.tan(np.radians(spec.fov) / 2)
        depth = spec.far - spec.near
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1] = f * spec.height / spec.width, f
        matrix[2, 2:] = -(spec.far + spec.near) / depth, -2 * spec.far * spec.near / depth
        matrix[3, 2] = -1
        return [float(x) for x in matrix.T.ravel()]

    def render(self, client: BulletClient, light: LightSpec, level: float) -> Frame:
        """Draw what is visible in the server behind `client`, with all light scaled by `level`."""
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
        return Frame(
            np.asarray(rgba, np.uint8).reshape(height, width, 4)[..., :3],
            np.asarray(depth, np.float32).reshape(height, width),
            np.asarray(bodies, np.int32).reshape(height, width),
        )


@dataclass(frozen=True)
class Backdrop:
    """The scene without robot, cube and tiles: colours (H, W, 3) and depth buffer (H, W)."""

    rgb: Picture
    depth: NDArray[np.float32]

    def at_size(self, spec: CameraSpec) -> "Backdrop":
        """The same with the pixels of `spec`: mean colours, and the depth of the nearest pixel."""
        size = (spec.width, spec.height)
        rgb = Image.fromarray(self.rgb).resize(size, Image.Resampling.BOX)
        depth = Image.fromarray(self.depth).resize(size, Image.Resampling.NEAREST)
        return Backdrop(np.asarray(rgb), np.asarray(depth))

    def under(self, frame: Frame) -> Picture:
        """The picture (H, W, 3) of `frame` composed with the backdrop: the nearer surface is visible."""
        # The renderer lets the surface that is drawn later win a tie, and the table is drawn first.
        in_front = (frame.bodies >= 0) & (frame.depth <= self.depth)
        picture = self.rgb.copy()
        picture[in_front] = frame.rgb[in_front]
        return picture
