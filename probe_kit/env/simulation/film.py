"""Pictures of few pixels for films: what rests is drawn once, and only what moves is drawn for every picture."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from probe_kit.env.rotations import Array
from probe_kit.env.simulation.bullet import BulletClient
from probe_kit.env.simulation.camera import Backdrop, Camera, Frame, Picture
from probe_kit.env.spec import LightSpec

INVISIBLE = (0.0, 0.0, 0.0, 0.0)
"""Colour of what the renderer leaves out."""
REST = 2e-4
"""How far resting bodies may drift, metres or parts of a unit quaternion: under a tenth of a film's pixel."""


@dataclass(frozen=True)
class _Resting:
    """The scene without its moving bodies. places: (bodies, 7) positions and quaternions; pictures: textures."""

    backdrop: Backdrop
    places: Array
    pictures: tuple[int, ...]


class FilmCamera:
    """Draws one scene with fewer pixels. resting, moving: its bodies; those that move are drawn later.

    The colours of all bodies are those that they have when this is made.
    """

    def __init__(
        self, client: BulletClient, backdrop: Backdrop, resting: Iterable[int], moving: Iterable[int]
    ) -> None:
        self._client, self._empty = client, backdrop
        self._resting, self._moving = tuple(resting), tuple(moving)
        self._colors = {body: _colors(client, body) for body in (*self._resting, *self._moving)}
        self._drawn: _Resting | None = None

    def picture(self, camera: Camera, light: LightSpec, level: float, pictures: tuple[int, ...]) -> Picture:
        """The finished picture (h, w, 3). pictures: textures that the resting bodies show."""
        backdrop = self._backdrop(camera, light, level, pictures)
        with self._without(self._resting):
            return backdrop.under(camera.render(self._client, light, level))

    def _backdrop(self, camera: Camera, light: LightSpec, level: float, pictures: tuple[int, ...]) -> Backdrop:
        states = (self._client.getBasePositionAndOrientation(body) for body in self._resting)
        places = np.array([np.concatenate(state) for state in states])
        drawn, shape = self._drawn, (camera.spec.height, camera.spec.width)
        if (
            drawn is None
            or drawn.backdrop.depth.shape != shape
            or drawn.pictures != pictures
            or np.abs(drawn.places - places).max() > REST
        ):
            with self._without(self._moving):
                frame = camera.render(self._client, light, level)
            self._drawn = drawn = _Resting(_over(self._empty.at_size(camera.spec), frame), places, pictures)
        return drawn.backdrop

    @contextmanager
    def _without(self, bodies: Iterable[int]) -> Iterator[None]:
        for body in bodies:
            for link, number, _ in self._colors[body]:
                self._client.changeVisualShape(body, link, number, rgbaColor=INVISIBLE)
        try:
            yield
        finally:
            for body in bodies:
                for link, number, color in self._colors[body]:
                    self._client.changeVisualShape(body, link, number, rgbaColor=color)


def _colors(client: BulletClient, body: int) -> list[tuple[int, int, tuple[float, ...]]]:
    """Link, number of the shape in its link, and colour of every visual shape: what `changeVisualShape` takes."""
    colors: list[tuple[int, int, tuple[float, ...]]] = []
    for shape in client.getVisualShapeData(body):
        number = sum(link == shape[1] for link, *_ in colors)
        colors.append((shape[1], number, shape[7]))
    return colors


def _over(backdrop: Backdrop, frame: Frame) -> Backdrop:
    """The backdrop with the bodies of a frame in front of it."""
    nearer = np.where(frame.bodies >= 0, np.minimum(frame.depth, backdrop.depth), backdrop.depth)
    return Backdrop(backdrop.under(frame), nearer)
