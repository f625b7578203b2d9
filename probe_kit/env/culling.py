"""View-frustum culling: meshes of the arm that lie outside of the camera's view are hidden from the renderer.

PyBullet's software renderer works through all triangles of a mesh, wherever it lies. The Panda has 102,000 of
them, and the camera of the protocol sees its hand alone, which has 8,300. Pictures are the same bit for bit.
"""

import os
from collections.abc import Callable
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.types import Matrix
from probe_kit.env.simulation import BulletClient, Camera, VisualShapes

MARGIN = 0.02
"""Share of the picture's width and height by which the view is taken larger: small pictures round their width."""


class ViewCulling:
    """The links of one body with a fixed base that are drawn, out of all.

    A link is hidden while the box around its meshes lies outside of the view. Links with other shapes than meshes
    in OBJ files have few triangles and are always drawn.

    PyBullet normalises the normals of a mesh in place whenever it draws them. The last bit of some alternates, and
    with it a colour by 1 of 255. So the drawings of every link are counted.
    """

    def __init__(self, client: BulletClient, shapes: VisualShapes) -> None:
        self._client, self._shapes = client, shapes
        boxes = _mesh_boxes(client, shapes.body)
        self._links, self._boxes = list(boxes), np.array(list(boxes.values()))
        self._drawings = dict.fromkeys(shapes.visible, 0)

    def hide_unseen(self, camera: Camera) -> None:
        """Hide the links outside of the camera's view, and show the others."""
        if self._links:
            in_view = camera.can_see(self._corners(), MARGIN)
            self._shapes.hide(
                link for link, is_in_view in zip(self._links, in_view, strict=True) if not is_in_view
            )

    def count_drawing(self) -> None:
        """Count one drawing of every link that is not hidden."""
        for link in self._shapes.visible:
            self._drawings[link] += 1

    def align(self, number: int, draw: Callable[[], object]) -> None:
        """Let the drawings of all links that are shown have the parity of `number`: draw the others once more."""
        aligned = [link for link in self._shapes.visible if (self._drawings[link] - number) % 2 == 0]
        if len(aligned) < len(self._shapes.visible):
            with self._shapes.away(aligned):
                draw()
                self.count_drawing()

    def _corners(self) -> Matrix:
        """Return the corners (L, 8, 3) of the links' boxes in the world."""
        states = self._client.getLinkStates(self._shapes.body, self._links, computeForwardKinematics=True)
        turns = np.array([self._client.getMatrixFromQuaternion(state[5]) for state in states]).reshape(-1, 3, 3)
        positions = np.array([state[4] for state in states])
        return np.asarray(self._boxes @ turns.swapaxes(1, 2) + positions[:, None])


def _mesh_boxes(client: BulletClient, body: int) -> dict[int, Matrix]:
    """Return the corners (8, 3) of the box around each link's meshes, in its frame; none for other shapes.

    The base, which has few triangles in all arms, is left out: PyBullet names the pose of its centre of mass.
    """
    corners: dict[int, list[Matrix]] = {}
    always_drawn = {-1}
    for _, link, kind, scale, file, position, turn, *_ in client.getVisualShapeData(body):
        ends = mesh_ends(Path(os.fsdecode(file))) if kind == client.GEOM_MESH else None
        if ends is None:
            always_drawn.add(link)
        else:
            rotation = np.array(client.getMatrixFromQuaternion(turn)).reshape(3, 3)
            corners.setdefault(link, []).append(_box(*ends) * scale @ rotation.T + position)
    ends_of = {link: np.concatenate(parts) for link, parts in corners.items() if link not in always_drawn}
    return {link: _box(points.min(axis=0), points.max(axis=0)) for link, points in ends_of.items()}


def _box(low: Matrix, high: Matrix) -> Matrix:
    return np.array(list(product(*zip(low, high, strict=True))))


def mesh_ends(path: Path) -> tuple[Matrix, Matrix] | None:
    """Return the least and the largest x, y, z (3,) of an OBJ file's vertices; None if it cannot be read so."""
    try:
        return _ends_of_version(path, path.stat().st_mtime_ns)
    except (OSError, ValueError):
        return None


@lru_cache(maxsize=64)
def _ends_of_version(path: Path, _: int) -> tuple[Matrix, Matrix]:
    lines = read_regular(path).splitlines()
    points = np.array([line.split()[1:4] for line in lines if line.startswith(b"v ")], dtype=float)
    if points.shape[1:] != (3,):
        raise ValueError("vertices have three coordinates")
    return points.min(axis=0), points.max(axis=0)
