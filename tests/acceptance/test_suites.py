"""Suites from a table, drawn and converted; `suite validate` on good and bad ones."""

import csv
import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

import probe_kit as pk
from tests.acceptance.product import probe_kit

COLOURS = ("red", "green")


def draw(path: Path, colour: str, seed: int) -> None:
    """A polygon of this colour, of another outline for every seed."""
    corners = np.random.default_rng(seed).uniform(40, 220, (7, 2)).tolist()
    image = Image.new("RGB", (260, 260), "white")
    ImageDraw.Draw(image).polygon([(x, y) for x, y in corners], fill=colour)
    image.save(path)


def table(folder: Path, pairs: int, both_ways: bool) -> Path:
    """A table of questions about a red and a green shape; with `both_ways`, each pair is also asked reversed."""
    folder.mkdir()
    lines = []
    for number in range(pairs):
        for offset, colour in enumerate(COLOURS):
            draw(folder / f"{colour}-{number}.png", colour, 2 * number + offset)
        orders = (COLOURS, COLOURS[::-1]) if both_ways else (COLOURS,)
        for right, wrong in orders:
            words = f"Put the cube on the {right} shape"
            lines.append([words, f"{right}-{number}.png", f"{wrong}-{number}.png", f"pair-{number}", "tint"])
    with (folder / "questions.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([["instruction", "correct", "wrong", "group", "category"], *lines])
    return folder / "questions.csv"


@pytest.fixture(scope="module")
def balanced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("balanced")
    csv_file = table(folder / "table", 12, both_ways=True)
    probe_kit("suite", "from-csv", csv_file, "--out", folder / "suite", "--license", "CC0-1.0")
    return folder / "suite"


def test_a_table_becomes_a_suite_whose_correct_picture_lies_on_the_named_side(balanced: Path) -> None:
    suite = pk.load_suite(balanced)
    listed = probe_kit("suite", "show", "--counts", balanced, "--json").json()
    assert "24" in json.dumps(listed)
    assert len(suite.items) == 24
    assert Counter(item.correct_side for item in suite.items) == {"left": 12, "right": 12}
    assert {item.category for item in suite.items} == {"tint"}
    lines = (balanced / "items" / "metadata.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 24
    for item in suite.items:
        with Image.open(item.picture(item.correct_side)) as picture:
            present = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20) or ()}
        colour = "red" if "red" in item.instruction else "green"
        assert Image.new("RGB", (1, 1), colour).getpixel((0, 0)) in present
    groups = Counter(item.group_id for item in suite.items)
    assert set(groups.values()) == {2}, "a pair of pictures asked both ways stays in one fold"


def test_a_suite_of_ones_own_is_played_in_both_layouts(balanced: Path, tmp_path: Path) -> None:
    settings = ("--suite", balanced, "--items", "2", "--max-steps", "1", "--env-workers", "0")
    probe_kit("extract", "--model", "idle", *settings, "--out", tmp_path / "run")
    run = pk.open_run(tmp_path / "run")
    sides = run.episodes.groupby("item_id")["side_correct"].apply(sorted)
    assert len(sides) == 2
    assert all(pair == ["left", "right"] for pair in sides)
    items = {item.item_id: item for item in pk.load_suite(balanced).items}
    original = run.episodes[run.episodes["layout"] == "original"].set_index("item_id")["side_correct"]
    assert all(side == items[name].correct_side for name, side in original.items())


def test_validate_accepts_questions_asked_both_ways_and_finds_the_leak_of_those_that_are_not(
    balanced: Path, tmp_path: Path
) -> None:
    accepted = probe_kit("suite", "validate", balanced, "--baselines", "--json").json()
    assert accepted["ok"]
    csv_file = table(tmp_path / "table", 12, both_ways=False)
    leaking = tmp_path / "leaking"
    probe_kit("suite", "from-csv", csv_file, "--out", leaking, "--license", "CC0-1.0")
    probe_kit("suite", "validate", leaking)  # its format is right
    answer = probe_kit("suite", "validate", leaking, "--baselines", code=1)
    assert "pixels" in answer.text
    assert "tint" in answer.text.casefold()


def break_picture(suite: Path) -> None:
    picture = next(suite.rglob("*.png"))
    picture.write_bytes(picture.read_bytes()[:-20])


def lose_picture(suite: Path) -> None:
    next(suite.rglob("*.png")).unlink()


def turn_answer(suite: Path) -> None:
    """Exchange left and right of one item by hand."""
    metadata = suite / "items" / "metadata.jsonl"
    first, *others = metadata.read_text(encoding="utf-8").splitlines()
    item = json.loads(first)
    item["correct_side"] = {"left": "right", "right": "left"}[item["correct_side"]]
    metadata.write_text("\n".join((json.dumps(item), *others)) + "\n", encoding="utf-8")


def name_side(suite: Path) -> None:
    metadata = suite / "items" / "metadata.jsonl"
    text = metadata.read_text(encoding="utf-8")
    metadata.write_text(text.replace("Put the cube on the red", "Put the cube on the left red"), encoding="utf-8")


@pytest.mark.parametrize("damage", [break_picture, lose_picture, turn_answer, name_side])
def test_a_suite_that_was_changed_by_hand_is_invalid_and_is_not_played(
    damage: object, balanced: Path, tmp_path: Path
) -> None:
    suite = Path(shutil.copytree(balanced, tmp_path / "suite"))
    assert callable(damage)
    damage(suite)
    answer = probe_kit("suite", "validate", suite, code=1)
    assert "E" in answer.text
    refused = probe_kit(
        "extract", "--model", "idle", "--suite", suite, "--max-steps", "1", "--out", tmp_path / "run", code=1
    )
    assert "SuiteError" in refused.err
    assert not (tmp_path / "run").exists()


def test_the_embedded_suite_is_drawn_alike_twice_and_is_valid(tmp_path: Path) -> None:
    for name in ("first", "second"):
        probe_kit("suite", "build", tmp_path / name, "--categories", "color", "--n", "12")
    pictures = [
        {str(path.relative_to(tmp_path / name)): path.read_bytes() for path in (tmp_path / name).rglob("*.png")}
        for name in ("first", "second")
    ]
    assert pictures[0] == pictures[1]
    assert len(pictures[0]) >= 12
    suites = [pk.load_suite(tmp_path / name) for name in ("first", "second")]
    assert str(suites[0].identity) == str(suites[1].identity)
    assert [item.instruction for item in suites[0].items] == [item.instruction for item in suites[1].items]
    assert Counter(item.correct_side for item in suites[0].items) == {"left": 6, "right": 6}
    probe_kit("suite", "validate", tmp_path / "first")
    words = set(probe_kit("models", "--words").out.split())
    used = {word for item in suites[0].items for word in item.instruction.lower().split()}
    assert used <= words


def test_a_benchmark_is_converted_with_the_answered_picture_as_the_target(tmp_path: Path) -> None:
    """MLLM-CompBench's own layout, with pictures of ours."""
    root, records = tmp_path / "compbench", []
    for number in range(12):
        names = [f"fer-2013/test/happy/im{number}_{side}.png" for side in "ab"]
        for offset, name in enumerate(names):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            pixels = np.random.default_rng(2 * number + offset).integers(0, 256, (6, 6, 3), dtype=np.uint8)
            Image.fromarray(pixels).resize((48, 48), Image.Resampling.BICUBIC).save(root / name)
        question = "Based on these images, which person is more smiling?"
        answer = "Left" if number % 3 else "Right"
        records.append({"image_1": names[0], "image_2": names[1], "question": question, "answer": answer})
    labels = root / "Labeled_data" / "fer2013_label"
    labels.mkdir(parents=True)
    (labels / "fer2013_0_720_rebalanced.json").write_text(json.dumps(records), encoding="utf-8")
    typed = ("mllm-compbench", "--root", root, "--out", tmp_path / "suite", "--categories", "emotion")
    probe_kit("suite", "convert", *typed)
    suite = pk.load_suite(tmp_path / "suite")
    assert Counter(item.instruction.rpartition("on ")[2] for item in suite.items) == {
        "the more smiling person": 6,
        "the less smiling person": 6,
    }
    by_files = {
        frozenset((record["image_1"], record["image_2"])): record[
            "image_1" if record["answer"] == "Left" else "image_2"
        ]
        for record in records
    }
    for item in suite.items:
        images = {"left": item.left_image_id, "right": item.right_image_id}
        (answered,) = [
            answer
            for pair, answer in by_files.items()
            if all(any(image.endswith(name) for name in pair) for image in images.values())
        ]
        assert images[item.correct_side].endswith(answered) == ("more" in item.instruction)
    probe_kit("suite", "validate", tmp_path / "suite")
    broken = labels / "fer2013_0_720_rebalanced.json"
    broken.write_text(json.dumps(records)[:-40], encoding="utf-8")
    answer = probe_kit("suite", "convert", *typed[:3], "--out", tmp_path / "no", "--categories", "emotion", code=1)
    assert "SuiteError" in answer.err
    assert broken.name in answer.text
    assert not (tmp_path / "no").exists()
