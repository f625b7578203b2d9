"""A tile of Act2Answer as the camera sees it: the texture of its upper face, rotated as the mesh requires."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import SuiteError
from probe_kit.suite.pictures import rgb_of

RELEASE_YAW = 90
"""Degrees by which Act2Answer turns its tiles: mesh +x lies to the viewer's right, mesh +y away from him."""
YAWS = (0, 90, 180, 270)
_UP = 0.99  # of a unit normal
_LEVEL = 0.05  # of the tile's thickness: what counts as its top
_STRAIGHT = 0.02  # of the picture: how far a texture may be from lying along the tile's sides
_UNREADABLE = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, NotImplementedError, OSError, struct.error,
    Image.DecompressionBombError,
)  # fmt: skip


@dataclass(frozen=True)
class Tile:
    """picture: RGB on white, as seen from in front of the tile. size: its x, y and z extent in metres."""

    picture: Image.Image
    size: tuple[float, float, float]


@dataclass(frozen=True)
class _Top:
    """Corners of what faces up: xy (N, 2) metres, uv (N, 2) with v downwards as in glTF; and their material."""

    xy: NDArray[np.float64]
    uv: NDArray[np.float64]
    material: Any


def read_tile(path: Path, yaw: int = RELEASE_YAW) -> Tile:
    """The tile in a binary glTF. yaw: degrees by which the scene turns it about z, of `YAWS`.

    Raises SuiteError if it cannot be read, if nothing faces up, and if what does has no picture, more than one, or
    one that is tinted, repeated or askew. Raises MissingExtraError without trimesh.
    """
    trimesh = require("trimesh", "act2answer")
    if not path.is_file():
        raise SuiteError(f"{path} not found; check out the assets of the set, GLB files included.")
    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = list(_meshes(scene))
    except _UNREADABLE as problem:
        raise SuiteError(f"{path} is not a binary glTF ({problem!r}). Check out the assets again.") from problem
    if not meshes:
        raise SuiteError(f"{path} holds no mesh. Check out the assets again.")
    every = np.concatenate([points for points, _ in meshes])
    low, high = every.min(axis=0), every.max(axis=0)
    top = _top(meshes, float(low[2]), float(high[2]), path)
    width, depth, height = (float(extent) for extent in high - low)
    return Tile(_render_top(top, yaw, path), (width, depth, height))


def _meshes(scene: Any) -> Iterator[tuple[NDArray[np.float64], Any]]:
    """Corners in the scene's frame, with scale and turn of their node, and the mesh."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if len(getattr(mesh, "faces", ())):
            points = np.asarray(mesh.vertices, np.float64)
            yield points @ transform[:3, :3].T + transform[:3, 3], mesh


def _top(meshes: list[tuple[NDArray[np.float64], Any]], low: float, high: float, path: Path) -> _Top:
    """Return the surface that faces up at the tile's top."""
    upward = []
    for points, mesh in meshes:
        corners = points[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        steep = np.divide(normals[:, 2], lengths, out=np.zeros_like(lengths), where=lengths > 0)
        level = corners[:, :, 2].mean(axis=1) >= high - _LEVEL * max(high - low, 1e-9)
        if (vertices := np.unique(mesh.faces[(steep > _UP) & level])).size:
            upward.append((points[vertices, :2], vertices, mesh))
    if len(upward) != 1:
        what = f"{len(upward)} meshes face up at its top" if upward else "nothing faces up at its top"
        raise SuiteError(f"{path}: {what}; expected one with one picture.")
    xy, vertices, mesh = upward[0]
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or getattr(mesh.visual, "material", None) is None:
        raise SuiteError(f"{path}: what faces up has no texture; expected a picture as baseColorTexture.")
    return _Top(xy, np.asarray(uv, np.float64)[vertices] * (1, -1) + (0, 1), mesh.visual.material)


def _render_top(top: _Top, yaw: int, path: Path) -> Image.Image:
    texture = _texture(top.material, path)
    slope = _slope(top, path)
    pixels = np.asarray(_cut(texture, top.uv, path))
    if abs(slope[0, 0]) < abs(slope[0, 1]):  # u runs along y
        pixels, slope = np.swapaxes(pixels, 0, 1), slope[::-1]
    if slope[0, 0] < 0:
        pixels = pixels[:, ::-1]
    if slope[1, 1] > 0:  # rows run downwards, y away
        pixels = pixels[::-1]
    turns = (RELEASE_YAW - yaw) // 90
    picture = Image.fromarray(np.ascontiguousarray(np.rot90(pixels, -turns)))
    across, away = np.ptp(top.xy, axis=0)[:: 1 if turns % 2 == 0 else -1]
    longer = max(picture.size)
    size = (round(longer * across / max(across, away)), round(longer * away / max(across, away)))
    return picture if picture.size == size else picture.resize(size, Image.Resampling.BICUBIC)


def _texture(material: Any, path: Path) -> Image.Image:
    texture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if texture is None:
        raise SuiteError(f"{path}: what faces up has no texture; expected a picture as baseColorTexture.")
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None and (np.asarray(factor)[:3] != 255).any():
        raise SuiteError(f"{path}: its texture is tinted by baseColorFactor {list(factor)}; expected white.")
    return rgb_of(texture, f"{path}, texture:", "Check out the assets again.")


def _slope(top: _Top, path: Path) -> NDArray[np.float64]:
    """(2, 2): how much of the picture's width and height (u, v) passes along the tile's x and y."""
    design = np.column_stack([top.xy, np.ones(len(top.xy))])
    fitted, _, rank, _ = np.linalg.lstsq(design, top.uv, rcond=None)
    off = float(np.abs(design @ fitted - top.uv).max())
    slope: NDArray[np.float64] = (fitted[:2] * np.ptp(top.xy, axis=0)[:, None]).T
    # Along the sides, every row has one large entry, and not the same column.
    small, large = np.sort(np.abs(slope), axis=1).T
    of_width, of_height = np.abs(slope).argmax(axis=1)
    if rank < design.shape[1] or off > _STRAIGHT or (small > _STRAIGHT * large).any() or of_width == of_height:
        raise SuiteError(
            f"{path}: the picture does not lie along the sides of what faces up (texture coordinates per side "
            f"{slope.round(3).tolist()}, off by {off:.3f}); expected one picture, upright or turned by quarters."
        )
    return slope


def _cut(texture: Image.Image, uv: NDArray[np.float64], path: Path) -> Image.Image:
    """The part of the texture that is shown."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    if (low < -_STRAIGHT).any() or (high > 1 + _STRAIGHT).any():
        raise SuiteError(
            f"{path}: texture coordinates run from {low.round(3).tolist()} to {high.round(3).tolist()}; expected "
            "0 to 1: a picture that is not repeated."
        )
    size = np.array(texture.size)
    left, upper = np.round(low.clip(0, 1) * size).astype(int)
    right, lower = np.round(high.clip(0, 1) * size).astype(int)
    return texture.crop((int(left), int(upper), int(right), int(lower)))
