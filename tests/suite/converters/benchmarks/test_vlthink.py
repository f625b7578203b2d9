import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import SuiteError
from probe_kit.suite import load_picture, validate_suite
from probe_kit.suite.converters import convert
from probe_kit.suite.converters.vlthink import upright_board

REAL = Path(os.environ.get("PROBE_KIT_SHARED", Path(__file__).parents[5] / "shared")) / "data" / "vl-think"


@pytest.fixture
def real() -> Path:
    if not REAL.is_dir():
        pytest.skip(f"no VL-Think sample at {REAL} (set PROBE_KIT_SHARED); it is not part of the repository")
    return REAL


def board(root: Path, group: str, name: str) -> np.ndarray:
    folder = root / "ManiSkill/mani_skill/assets/carrot" / f"more_{group}" / "shapes"
    (path,) = folder.glob(f"*{name}/textured.glb")
    return np.asarray(upright_board(path).convert("L"), np.float64)


def test_boards_come_out_upright(vlthink_root: Path) -> None:
    """The look-alike has a red post at the left and a black bar at the top."""
    folder = vlthink_root / "ManiSkill/mani_skill/assets/carrot/more_traffic/shapes"
    pixels = np.asarray(upright_board(folder / "000_stopgiveway" / "textured.glb"), np.int64)
    reddish = (pixels[..., 0] - pixels[..., 2]) > 100
    rows, columns = np.nonzero(reddish)
    assert np.ptp(rows) > 2 * np.ptp(columns)
    assert columns.mean() < pixels.shape[1] / 2


@pytest.mark.parametrize(
    ("name", "axis", "tip"), [("left", 1, 0), ("right", 1, -1), ("up", 0, 0), ("down", 0, -1)]
)
def test_real_arrows_point_where_their_names_say(real: Path, name: str, axis: int, tip: int) -> None:
    """An arrow's head is broad: the half with the tip holds more ink."""
    ink = 255 - board(real, "arrows", f"arrow_{name}")
    halves = np.array_split(ink, 2, axis=axis)
    assert halves[tip].sum() > 1.2 * halves[-1 if tip == 0 else 0].sum()


def test_real_hearts_stand_on_their_tip(real: Path) -> None:
    upper, lower = np.array_split(255 - board(real, "shape", "heart_black"), 2, axis=0)
    assert upper.sum() > 1.3 * lower.sum()


def test_every_two_signs_are_asked_both_ways(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert len(suite.items) == 5 * 4
    roles = Counter(item.target_concept for item in suite.items)
    assert roles == Counter(item.distractor_concept for item in suite.items)
    assert "Put the cube on the stop sign" in {item.instruction for item in suite.items}, "aliased label"
    assert validate_suite(suite.folder, baselines=True).ok


def test_signs_named_after_a_side_are_marked_and_can_be_left_out(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert {item.object_phrase for item in suite.items if item.side_word} == {"no left turn sign"}
    without = convert("vl-think", vlthink_root, tmp_path / "without", categories=["traffic"], side_words=False)
    assert not any("left" in item.instruction for item in without.items)
    assert len(without.items) == 4 * 3


@pytest.mark.slow
def test_real_colours_are_eight_and_eleven_when_repainted(real: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", real, tmp_path / "eight", categories=["color"])
    assert len({item.target_concept for item in suite.items}) == 8
    recolored = convert("vl-think", real, tmp_path / "eleven", categories=["color"], recolor=True)
    assert len({item.target_concept for item in recolored.items}) == 11
    assert {item.construction for item in recolored.items} == {"cross_item", "recolored"}


def test_real_signs_of_the_laundry_are_made_on_request(real: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", real, tmp_path / "s", categories=["public-info"], n=20, extra_boards=["laundry"])
    assert suite.card["counts"] == {"public-info": 20}
    assert min(load_picture(suite.items[0].picture("left")).size) >= 224


def test_a_board_that_is_no_gltf_is_named(vlthink_root: Path, tmp_path: Path) -> None:
    (path,) = vlthink_root.rglob("*noentry/textured.glb")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SuiteError, match=r"noentry.textured\.glb is not a glTF with an embedded picture"):
        convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])
    assert not (tmp_path / "suite").exists()


def test_a_missing_board_is_named_with_its_key(vlthink_root: Path, tmp_path: Path) -> None:
    (path,) = vlthink_root.rglob("*danger/textured.glb")
    path.unlink()
    with pytest.raises(SuiteError, match=r"image not found for board 003_danger of .*model_db\.json"):
        convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"])


def test_a_tree_without_boards_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SuiteError, match=r"no boards for color, public-info, traffic .*more_shape"):
        convert("vl-think", tmp_path, tmp_path / "suite")
