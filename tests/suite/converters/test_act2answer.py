"""Tiles as they are seen: proved on the authors' boards, and on tiles of every convention written here."""

import json
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from probe_kit.errors import SuiteError, UnknownCategoryError, UsageError
from probe_kit.suite import load_suite, validate_suite
from probe_kit.suite.converters import convert
from probe_kit.suite.converters.act2answer import BoundingBoxWarning, object_of, read_tile
from probe_kit.suite.converters.candidates import trim
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
    pixels_read = np.asarray(read_tile(write_tile(tmp_path / "tile.glb", picture, along_u, down_v)).picture)
    pixels, side = np.asarray(picture), picture.width
    for x, y in product((-1, 1), (-1, 1)):
        u, v = ((x * d[0] + y * d[1] + 1) // 2 for d in (along_u, down_v))
        column, row = (u * (side - 1), v * (side - 1))
        corner = pixels_read[0 if y > 0 else -1, -1 if x > 0 else 0]
        np.testing.assert_array_equal(corner, pixels[row, column])


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
    pixels_read = np.asarray(read_tile(write_tile(tmp_path / "tile.glb", clear)).picture)
    assert (pixels_read == 255).all()


@pytest.mark.slow
@pytest.mark.skipif(not BOARDS.is_dir(), reason=f"no real boards at {BOARDS}")
def test_the_authors_boards_are_upright_as_their_scene_turns_them() -> None:
    """They are stored transposed and lie there unturned; VL-Think's converter knows that, this one reads it."""
    boards = sorted(BOARDS.rglob("textured.glb"))
    assert len(boards) == 5
    for board in boards:
        tile = read_tile(board, yaw=0)
        np.testing.assert_allclose(tile.size, (0.11, 0.11, 0.006), atol=1e-6)
        upright = upright_board(board)
        ours = trim(tile.picture)
        ours.thumbnail((600, 600), Image.Resampling.LANCZOS)
        np.testing.assert_array_equal(np.asarray(ours), np.asarray(upright), err_msg=str(board))
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


pytest.importorskip("trimesh", reason="the extra act2answer (trimesh) is not installed")
REAL = SHARED / "data" / "act2answer" / "test_colors"
PAIRS = [
    {"index": 1, "left": "fox", "right": "cat", "question": "Put cube on the fox.", "answer": "Left"},
    {"index": 0, "left": "cat", "right": "dog", "question": "Put cube on dog", "answer": "right"},
    {"index": 2, "left": "twin", "right": "owl", "question": "Put cube on the left of two owls, as they sit "
     "there today in the old tree behind the house", "answer": "Left", "left_label": "owls", "right_label": "owl"},
]  # fmt: skip
NAMES = ("cat", "dog", "fox", "owl", "twin")


def write_set(folder: Path, box: float = 0.1452) -> Path:
    """Three questions about five tiles; `twin` shows the same picture as `fox` under another name."""
    folder.mkdir(parents=True)
    (folder / "pairs.json").write_text(json.dumps(PAIRS), encoding="utf-8")
    half = [box / 2, box / 2, 0.003]
    record = {"bbox": {"min": [-value for value in half], "max": half}, "scales": [1], "density": 6368}
    (folder / "model_db.json").write_text(
        json.dumps({name: {"name": name, **record} for name in NAMES}), encoding="utf-8"
    )
    for seed, name in enumerate(NAMES):
        write_tile(folder / "shapes" / name / "textured.glb", art(2 if name == "twin" else seed))
    return folder


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("sets") / "living_world_v1")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / original.name))


def test_questions_are_taken_over_as_they_are(folder: Path, tmp_path: Path) -> None:
    suite = convert("act2answer", folder, tmp_path / "suite")
    first, second, third = suite.items
    assert [item.source["source_id"] for item in suite.items] == [f"living_world_v1#{index}" for index in range(3)]
    assert first.instruction == "Put cube on dog"
    assert (first.correct_side, first.target_concept, first.distractor_concept) == ("right", "dog", "cat")
    assert (second.instruction, second.object_phrase, second.object_article) == (
        "Put cube on the fox.",
        "fox",
        "the",
    )
    assert (second.correct_side, second.target_concept) == ("left", "fox")
    assert (third.target_concept, third.distractor_concept, third.side_word) == ("owls", "owl", True)
    assert suite.categories == ("living-world",)
    assert not any(item.redistributable for item in suite.items)
    assert validate_suite(tmp_path / "suite").ok
    assert load_suite(tmp_path / "suite").identity == suite.identity


def test_questions_that_share_a_picture_share_a_group_whatever_its_name(folder: Path, tmp_path: Path) -> None:
    """`twin` is the picture of `fox`, and the cat lies in two questions: all three belong together."""
    suite = convert("act2answer", folder, tmp_path / "suite")
    assert len({item.group_id for item in suite.items}) == 1
    other = json.loads((folder / "pairs.json").read_text(encoding="utf-8"))[:2]
    other[0]["right"] = "owl"
    (folder / "pairs.json").write_text(json.dumps(other), encoding="utf-8")
    apart = convert("act2answer", folder, tmp_path / "apart")
    assert len({item.group_id for item in apart.items}) == 2


def test_the_same_set_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    first, other = (
        convert("act2answer", folder, tmp_path / name, seed=seed) for seed, name in ((0, "a"), (1, "b"))
    )
    assert first.identity == other.identity
    files = [path.relative_to(first.folder) for path in sorted(first.folder.rglob("*")) if path.is_file()]
    assert files
    for file in files:
        assert (first.folder / file).read_bytes() == (other.folder / file).read_bytes(), file


def _change(position: int, **values: Any) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        pairs = json.loads((folder / "pairs.json").read_text(encoding="utf-8"))
        pairs[position].update(values)
        (folder / "pairs.json").write_text(json.dumps(pairs), encoding="utf-8")

    return apply


def _forget(name: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        records = json.loads((folder / "model_db.json").read_text(encoding="utf-8"))
        del records[name]
        (folder / "model_db.json").write_text(json.dumps(records), encoding="utf-8")

    return apply


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (_change(0, answer="Center"), "expected Left or Right"),
        (_change(0, answer=""), "expected Left or Right"),
        (_change(0, answer=None), "expected a str"),
        (_change(0, left="cat"), "lies on both sides"),
        (_change(2, index=3), "index 3 where 2 was expected"),
        (_change(2, index=1), "index 1 where 2 was expected"),
        (_change(2, index="2"), "expected a whole number"),
        (_change(0, question="Put\nit"), "expected one line"),
        (_change(2, right="fox"), "show the same picture"),
        (_forget("dog"), "names the tile 'dog', which .* does not describe"),
        (lambda folder: (folder / "shapes/dog/textured.glb").unlink(), "dog/textured.glb not found"),
        (lambda folder: (folder / "pairs.json").unlink(), "pairs.json is missing"),
        (
            lambda folder: (folder / "pairs.json").write_text("[]", encoding="utf-8"),
            "pairs.json holds no question",
        ),
        (
            lambda folder: (folder / "model_db.json").write_text("[]", encoding="utf-8"),
            "model_db.json holds a JSON list; expected an object",
        ),
    ],
)
def test_a_set_that_the_release_would_misread_is_refused(
    folder: Path, tmp_path: Path, change: Callable[[Path], None], complaint: str
) -> None:
    change(folder)
    with pytest.raises(SuiteError, match=complaint):
        convert("act2answer", folder, tmp_path / "suite")
    assert not (tmp_path / "suite").exists()


def test_a_scored_box_unlike_the_mesh_is_said(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "living_world", box=0.11)
    with pytest.warns(BoundingBoxWarning, match=r"cat is 0\.1452 m wide and scored as 0\.1100 m"):
        suite = convert("act2answer", folder, tmp_path / "suite")
    notes = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))["notes"]
    assert "5 of 5 tiles" in notes[0]


@pytest.mark.parametrize(
    ("name", "slug"), [("test_colors", "color"), ("time_clock_v1", "time"), ("public_info", "public-info")]
)
def test_the_folders_name_tells_the_category(original: Path, tmp_path: Path, name: str, slug: str) -> None:
    folder = Path(shutil.copytree(original, tmp_path / name))
    assert convert("act2answer", folder, tmp_path / "suite", n=1).categories == (slug,)


def test_a_name_that_tells_no_category_needs_one(original: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(original, tmp_path / "symmetry_color_v2"))
    with pytest.raises(UsageError, match="contains color and symmetry; name the category"):
        convert("act2answer", folder, tmp_path / "suite")
    with pytest.raises(UnknownCategoryError):
        convert("act2answer", folder, tmp_path / "suite", categories=["shapes"])
    assert convert("act2answer", folder, tmp_path / "suite", categories=["shape"]).categories == ("shape",)


def test_options_that_cannot_be_meant_are_refused(original: Path, tmp_path: Path) -> None:
    for options, complaint in (({"tile_yaw": 45}, "expected one of 0, 90"), ({"min_side": 3}, "unknown option"),
                               ({"curation": "x.json"}, "takes no curation")):  # fmt: skip
        with pytest.raises(UsageError, match=complaint):
            convert("act2answer", original, tmp_path / "suite", **options)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real set at {REAL}")
def test_the_authors_own_set_with_generated_tiles(tmp_path: Path) -> None:
    """Their `pairs.json` and `model_db.json` byte for byte; their pictures could not be had."""
    folder = Path(shutil.copytree(REAL, tmp_path / "test_colors"))
    for seed, name in enumerate(sorted(json.loads((folder / "model_db.json").read_text(encoding="utf-8")))):
        write_tile(folder / "shapes" / name / "textured.glb", art(seed))
    with pytest.warns(BoundingBoxWarning, match="12 of 12 tiles"):
        suite = convert("act2answer", folder, tmp_path / "suite")
    assert [item.object_phrase for item in suite.items][:3] == ["blue", "red", "green"]
    assert len(suite.items) == 6
    assert sum(item.correct_side == "left" for item in suite.items) == 3
    assert len({item.group_id for item in suite.items}) == 6


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        ("Put cube on blue", ("blue", "none")),
        ("Put cube on the safe image", ("safe image", "the")),
        ("Which is safe?", ("Which is safe?", "none")),
        ("Put cube on the", ("the", "none")),
    ],
)
def test_the_object_is_what_stands_behind_on(question: str, expected: tuple[str, str]) -> None:
    assert object_of(question) == expected
