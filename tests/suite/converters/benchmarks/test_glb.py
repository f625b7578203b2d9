"""Tiles as they are seen: proved on the authors' boards, and on tiles of every convention written here."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probe_kit.errors import SuiteError
from probe_kit.suite.converters.act2answer import read_tile
from probe_kit.suite.converters.candidates import trimmed
from probe_kit.suite.converters.vlthink import upright_board
from tests.conftest import SHARED
from tests.support.act2answer_tiles import THICKNESS, WIDTH, art, write_tile

pytest.importorskip("trimesh", reason="the extra act2answer (trimesh) is not installed")
BOARDS = SHARED / "data" / "act2answer" / "vl-think-boards"
ALONG = [(1, 0), (-1, 0), (0, 1), (0, -1)]


def test_a_tile_of_the_upright_convention_shows_its_picture_as_it_is(tmp_path: Path) -> None:
    """u along mesh +x, v = 0 at mesh +y: what Act2Answer's tools write."""
    picture = art(0)
    tile = read_tile(write_tile(tmp_path / "tile.glb", picture))
    np.testing.assert_array_equal(np.asarray(tile.picture), np.asarray(picture))
    np.testing.assert_allclose(tile.size, (WIDTH, WIDTH, THICKNESS), atol=1e-6)


@pytest.mark.parametrize(
    ("along_u", "down_v"), [(u, v) for u, v in product(ALONG, ALONG) if u[0] * v[0] + u[1] * v[1] == 0]
)
def test_every_way_a_picture_can_lie_on_a_tile_is_read_from_its_mesh(
    tmp_path: Path, along_u: tuple[int, int], down_v: tuple[int, int]
) -> None:
    """All eight, mirrored ones included: every corner of the tile keeps its colour as seen from above."""
    picture = art(1)
    seen = np.asarray(read_tile(write_tile(tmp_path / "tile.glb", picture, along_u, down_v)).picture)
    pixels, side = np.asarray(picture), picture.width
    for x, y in product((-1, 1), (-1, 1)):
        u, v = ((x * d[0] + y * d[1] + 1) // 2 for d in (along_u, down_v))
        column, row = (u * (side - 1), v * (side - 1))
        shown = seen[0 if y > 0 else -1, -1 if x > 0 else 0]
        np.testing.assert_array_equal(shown, pixels[row, column])


def test_the_scenes_turn_of_the_tile_turns_the_picture(tmp_path: Path) -> None:
    picture = np.asarray(art(2))
    path = write_tile(tmp_path / "tile.glb", Image.fromarray(picture))
    for yaw, turns in ((90, 0), (180, 1), (270, 2), (0, 3)):  # quarters against the clock, seen from above
        np.testing.assert_array_equal(np.asarray(read_tile(path, yaw).picture), np.rot90(picture, turns))


def test_the_picture_of_the_top_is_taken_and_not_the_first_of_the_file(tmp_path: Path) -> None:
    picture, decoy = art(3), art(4)
    tile = read_tile(write_tile(tmp_path / "tile.glb", picture, decoy=decoy))
    np.testing.assert_array_equal(np.asarray(tile.picture), np.asarray(picture))


def test_transparency_lies_over_white(tmp_path: Path) -> None:
    clear = Image.new("RGBA", (64, 64), (200, 10, 10, 0))
    seen = np.asarray(read_tile(write_tile(tmp_path / "tile.glb", clear)).picture)
    assert (seen == 255).all()


@pytest.mark.skipif(not BOARDS.is_dir(), reason=f"no real boards at {BOARDS}")
def test_the_authors_boards_are_upright_as_their_scene_turns_them() -> None:
    """They are stored transposed and lie there unturned; VL-Think's converter knows that, this one reads it."""
    boards = sorted(BOARDS.rglob("textured.glb"))
    assert len(boards) == 5
    for board in boards:
        tile = read_tile(board, yaw=0)
        np.testing.assert_allclose(tile.size, (0.11, 0.11, 0.006), atol=1e-6)
        known = upright_board(board)
        ours = trimmed(tile.picture)
        ours.thumbnail((600, 600), Image.Resampling.LANCZOS)
        np.testing.assert_array_equal(np.asarray(ours), np.asarray(known), err_msg=str(board))
        released = np.asarray(read_tile(board).picture)
        np.testing.assert_array_equal(released, np.rot90(np.asarray(tile.picture)), err_msg=str(board))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"factor": [0.5, 1.0, 1.0, 1.0]}, "tinted"),
        ({"repeat": 2.0}, "is not repeated"),
        ({"along_u": (1, 1), "down_v": (1, -1)}, "does not lie along the sides"),
        ({"along_u": (1, 0), "down_v": (1, 0)}, "does not lie along the sides"),
    ],
)
def test_tiles_that_show_no_single_picture_are_refused(
    tmp_path: Path, change: dict[str, object], complaint: str
) -> None:
    path = write_tile(tmp_path / "tile.glb", art(5), **change)  # type: ignore[arg-type]
    with pytest.raises(SuiteError, match=complaint):
        read_tile(path)


def test_files_that_are_no_tiles_are_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.glb"
    broken.write_bytes(write_tile(tmp_path / "tile.glb", art(6)).read_bytes()[:900])
    for path, complaint in ((broken, "is not a binary glTF"), (tmp_path / "absent.glb", "not found")):
        with pytest.raises(SuiteError, match=complaint):
            read_tile(path)
